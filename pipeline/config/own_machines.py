"""Machines of other folders: the file that ``machine.file`` names, and the folder of ``--config-dir``.

They are read here, the paths in them made absolute (each is relative to the folder of the file that it stands in), and
put into Hydra's store, beside the files of ``conf/``.
"""

from __future__ import annotations

import hashlib
import os
import re
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from pipeline.config.loader import CONF
from pipeline.config.measured import AS_MODELLED
from pipeline.errors import ConfigError, nearest

_PATHS = (
    *("rotor.file", "runs_file", "recordings.file", "recordings.known", "recordings.conditions_file", "run_up.file"),
    *("recordings.runs.*.file", "recordings.runs.*.files.*", "laws.bearings.*.table"),
    *("bearings.table", "bearings.nodes.*.table"),
)
"""Keys of a machine that hold a path."""
_DATA_PATHS = ("data.vibration", "data.excitation", "data.known")


def make_absolute(path: str | Path, folder: Path | None = None) -> Path:
    """``path`` from ``folder`` (the working folder), with the user's home in place of ``~``."""
    return Path(os.path.abspath((folder or Path()) / Path(path).expanduser()))


def store_machine(path: Path) -> str:
    """Put a machine file into Hydra's store; its name there, which has the hash of path and content in it.

    Its key ``data`` names vibration that was processed elsewhere, and takes the place of the configuration's own.
    """
    from hydra.core.config_store import ConfigStore

    content = _read_yaml(path, "machine.file")
    if "defaults" in content:
        raise ConfigError(
            f"a machine file must be complete in itself, but '{path}' has a defaults list: write its keys out, or put "
            "the file into FOLDER/machine and give --config-dir=FOLDER machine=NAME"
        )
    if set(content) == {"machine"}:
        raise ConfigError(
            f"a machine file must have keys such as rotor and bearings at its top, but '{path}' has them "
            "below 'machine': leave that line out"
        )
    if "file" in content:
        raise ConfigError(f"machine.file must be given on the command line alone, but '{path}' has a key 'file'")
    name = f"{clean_name(path)}-{hashlib.sha256(str(path).encode() + path.read_bytes()).hexdigest()[:8]}"
    data = {key: content.pop(key) for key in ("data",) if key in content}
    node = {"machine": _resolve_paths(content, _PATHS, path.parent) | {"file": str(path)}}
    node |= _resolve_paths(data, _DATA_PATHS, path.parent)
    ConfigStore.instance().store(name, node, group="machine", package="_global_", provider=str(path))
    return name


def clean_name(path: Path) -> str:
    """The name of a file as an experiment may have it: letters, digits, hyphens, underscores."""
    return re.sub(r"[^A-Za-z0-9_-]+", "_", path.stem)


def store_folder(folder: Path) -> None:
    """Put every file of ``folder`` that lies in a group of ``conf/`` into Hydra's store. Raises ConfigError."""
    from hydra.core.config_store import ConfigStore

    if not folder.is_dir():
        raise ConfigError(f"--config-dir must be a folder, but '{folder}' is none")
    groups = sorted(path.name for path in CONF.iterdir() if path.is_dir())
    paths = [path for group in groups for path in sorted((folder / group).rglob("*.yaml"))]
    if not paths:
        raise ConfigError(
            f"--config-dir must be a folder with machines in machine/ or experiments in experiment/, but '{folder}' "
            "has none: move the files there, or name one machine with machine.file=FILE"
        )
    for path in paths:
        name = path.relative_to(folder).with_suffix("").as_posix()  # such as machine/mine
        group, _, option = name.rpartition("/")
        if (CONF / f"{name}.yaml").exists():
            raise ConfigError(
                f"a file of --config-dir must have a name of its own, but conf/ has {name}.yaml too: rename '{path}'"
            )
        content = _read_yaml(path, f"a file of --config-dir in {group}/")
        keys = _PATHS if group == "machine" else (*(f"machine.{key}" for key in _PATHS), *_DATA_PATHS)
        if group.startswith(("machine", "experiment")):
            content = _resolve_paths(content, keys, path.parent)
        package = re.search(r"^# *@package +(\S+)", path.read_text(encoding="utf-8"), re.MULTILINE)
        ConfigStore.instance().store(
            option, content, group=group, package=package[1] if package else None, provider=str(path)
        )


# --- YAML ----------------------------------------------------------------------------------------


def _count_nodes(node: Any, known: dict[int, int]) -> int:
    """How many values a YAML node has once its aliases are written out."""
    if id(node) not in known:
        inside = node.value if isinstance(getattr(node, "value", None), list) else ()
        pairs = (pair if isinstance(pair, tuple) else (pair,) for pair in inside)
        known[id(node)] = 1 + sum(_count_nodes(child, known) for pair in pairs for child in pair)
    return known[id(node)]


def _read_yaml(path: Path, what: str, most: int = 100_000) -> dict[str, Any]:
    """The keys of a YAML file, as Hydra would read them. Raises ConfigError."""
    import yaml
    from omegaconf import DictConfig, OmegaConf
    from omegaconf.errors import OmegaConfBaseException

    if path.is_dir():
        inside = [file.name for file in path.glob("*.yaml")]
        more = f": name one of its files ({', '.join(sorted(inside)[:5])})" if inside else ""
        raise ConfigError(f"{what} must be a file, but '{path}' is a folder{more}")
    try:
        text = path.read_text(encoding="utf-8")
        if _count_nodes(yaml.compose(text, yaml.SafeLoader), {}) > most:
            raise ValueError(f"its aliases make more than {most} values")
        read = OmegaConf.create(text)
    except FileNotFoundError:
        beside = sorted(file.name for file in path.parent.glob("*.yaml"))
        hint = f": {nearest(path.name, beside)}" if beside else ""
        raise ConfigError(
            f"{what} must name a machine file, but there is no file '{path}'{hint}; correct the path, or write one "
            "with stage=new"
        ) from None
    except UnicodeDecodeError:
        raise ConfigError(f"{what} must be YAML in UTF-8, but '{path}' is not: is it a machine file?") from None
    except OSError as error:
        raise ConfigError(f"{what} must be readable, but '{path}' is not: {error.strerror}") from None
    except yaml.YAMLError as error:
        mark, problem = getattr(error, "problem_mark", None), getattr(error, "problem", None)
        place = f"line {mark.line + 1}, column {mark.column + 1}: {problem}" if mark else " ".join(str(error).split())
        raise ConfigError(
            f"{what} must be YAML, but '{path}' is not: {place}; a text with brackets, a comma or a colon (a column's "
            "name) must stand in quotes"
        ) from None
    except AssertionError:  # a number
        read = None
    except (OmegaConfBaseException, ValueError, RecursionError) as error:
        raise ConfigError(f"{what} must be YAML with plain keys, but '{path}' is not: {error}") from None
    plain = OmegaConf.to_container(read, resolve=False) if isinstance(read, DictConfig) else None
    if not isinstance(plain, dict) or all(value is None for value in plain.values()):
        raise ConfigError(f"{what} must have keys with values, such as `rotor:`, but '{path}' has none")
    asked = re.search(r"\$\{[^{}]*:[^}]*\}", str(plain))
    if asked:  # such as ${oc.env:NAME}: what is read there would stand in every result
        raise ConfigError(
            f"{what} must refer to its own keys alone, but '{path}' has {asked[0]}: write the value itself"
        )
    return {str(key): value for key, value in plain.items()}


# --- paths ---------------------------------------------------------------------------------------


def _resolve_paths(node: Any, keys: Sequence[str], folder: Path, place: str = "") -> Any:
    """A copy of what stands at the dotted ``place`` of a file, with the paths of these keys absolute."""
    if isinstance(node, dict | list):
        items = list(node.items() if isinstance(node, dict) else enumerate(node))
        made = {key: _resolve_paths(inside, keys, folder, f"{place}.{key}".lstrip(".")) for key, inside in items}
        return made if isinstance(node, dict) else list(made.values())
    is_path = any(re.fullmatch(key.replace(".", r"\.").replace("*", r"[^.]+"), place) for key in keys)
    if not is_path or not isinstance(node, str) or node in ("", AS_MODELLED) or "${" in node:
        return node
    if place.endswith(".table") and not Path(node).suffix:
        return node  # the name of a table that comes with the package
    return str(make_absolute(node, folder))
