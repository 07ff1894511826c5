"""What `dvc repro` compares, in few hashes: the code that a stage imports, room by room, and an experiment's sections.

dvc.yaml lists no file of code: its stage ``code`` runs this program, which finds what each stage imports. A section of
a configuration is a hash too, so that dvc.lock has a line on it and not all of its values.
"""

from __future__ import annotations

import ast
import hashlib
import json
import sys
from collections import defaultdict
from collections.abc import Iterator
from functools import cache
from pathlib import Path
from typing import Any

import yaml

from pipeline.files import write_json

ROOT = Path(__file__).resolve().parents[1]

HARMLESS = (
    "pipeline/tracking/",
    "pipeline/reporting/console.py",
    "pipeline/errors.py",
    "pipeline/py.typed",
    "pipeline/stages/machine_file.yaml",
)
"""What a stage imports for its messages and records alone, and what `new` writes: no file of an experiment follows from
these."""


def hash_code(root: Path = ROOT) -> dict[str, dict[str, str]]:
    """Stage -> room -> hash of the files of that room which the stage needs; ``pipeline`` has those of no room.

    A script of a study, which runs on the package, is there as ``study_`` and its name.
    """
    programs = {path.stem: path for path in root.glob("pipeline/stages/[a-z]*.py")}
    programs |= {f"study_{path.stem}": path for path in root.glob("studies/*/*.py") if path.stem == path.parent.name}
    return {name: _hash_rooms(root, list_needed(path, root)) for name, path in sorted(programs.items())}


def _hash_rooms(root: Path, files: frozenset[Path]) -> dict[str, str]:
    rooms: defaultdict[str, dict[str, str]] = defaultdict(dict)
    for path in files:
        name = path.relative_to(root)
        room = name.parts[1] if name.parts[0] == "pipeline" and len(name.parts) > 2 else name.parts[0]
        rooms[room][name.as_posix()] = hashlib.sha256(path.read_bytes()).hexdigest()
    return {room: _hash(hashes) for room, hashes in sorted(rooms.items())}


def list_needed(program: Path, root: Path = ROOT) -> frozenset[Path]:
    """All that a stage or a script imports, directly or not, and the data files beside that.

    Other stages are run by name, not imported.
    """
    seen: set[Path] = set()
    todo = [program]
    while todo:
        path = todo.pop()
        if path not in seen and not _is_harmless(path, root):
            seen.add(path)
            todo += _list_imported(path, root)
    folders = {path.parent for path in seen}
    return frozenset(seen | {path for path in _list_data(root) if _find_code(path) in folders})


def _is_harmless(path: Path, root: Path) -> bool:
    return path.relative_to(root).as_posix().startswith(HARMLESS)


@cache
def _list_imported(path: Path, root: Path) -> frozenset[Path]:
    """The files that a file imports, wherever in it: of the package, and beside a script; not what types alone need."""
    names: set[str] = set()
    todo: list[ast.AST] = [ast.parse(path.read_text(encoding="utf-8"))]
    while todo:
        node = todo.pop()
        if isinstance(node, ast.If) and isinstance(node.test, ast.Name) and node.test.id == "TYPE_CHECKING":
            todo += node.orelse
            continue
        if isinstance(node, ast.Import):
            names |= {alias.name for alias in node.names}
        elif isinstance(node, ast.ImportFrom) and node.module:
            names |= {node.module, *(f"{node.module}.{alias.name}" for alias in node.names)}
        todo += ast.iter_child_nodes(node)
    places = [root.joinpath(*name.split(".")) for name in names if name.startswith("pipeline.")]
    if path.is_relative_to(root / "studies"):
        places += [path.with_name(name) for name in names if "." not in name]
    files = [file for place in places for file in (place.with_suffix(".py"), place / "__init__.py")]
    return frozenset(file for file in files if file.is_file())


@cache
def _list_data(root: Path) -> tuple[Path, ...]:
    """The files of the package that are no code, such as tables and templates."""
    left_out = (".py", ".pyc", "~", ".swp", ".DS_Store")
    files = (path for path in root.glob("pipeline/**/*") if path.is_file() and not path.name.endswith(left_out))
    return tuple(path for path in files if not _is_harmless(path, root))


def _find_code(data: Path) -> Path:
    """The folder of code that a data file belongs to."""
    return next(folder for folder in data.parents if any(folder.glob("*.py")))


def hash_sections(configuration: Path) -> dict[str, Any]:
    """Key -> hash of its value in a ``config.yaml``; ``machine`` has a hash for each of its own."""
    sections = yaml.safe_load(configuration.read_text(encoding="utf-8"))
    machine = {key: _hash(value) for key, value in sections.pop("machine").items()}
    return {key: _hash(value) for key, value in sections.items()} | {"machine": machine}


def _hash(value: object) -> str:
    return hashlib.sha256(json.dumps(value, sort_keys=True).encode()).hexdigest()[:12]


def write_configurations(folder: Path) -> Iterator[Path]:
    """Write ``config.yaml`` of every experiment below ``folder``, and ``sections.json`` beside it."""
    from pipeline.config.compose import compose_config
    from pipeline.config.loader import list_options
    from pipeline.stages.configure import write_configuration

    for name in list_options("experiment"):
        config = compose_config(["stage=configure", f"experiment={name}", f"output='{folder / name}'"])
        path = write_configuration(config)
        yield write_json(path.with_name("sections.json"), hash_sections(path))


if __name__ == "__main__":
    command, place = sys.argv[1], Path(sys.argv[2])
    if command == "code":
        print(f"code of each stage in '{write_json(place, hash_code())}'")
    else:
        print(f"{len(list(write_configurations(place)))} configurations in '{place}'")
