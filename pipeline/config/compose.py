"""From ``conf/``, a machine file and overrides to a checked :class:`~pipeline.config.schema.Config`.

Its errors, and pydantic's, leave here as :class:`~pipeline.errors.ConfigError`: the law, what came, the next step.
What was composed before comes from the cache, without Hydra and pint, whose import takes a second.
"""

from __future__ import annotations

import importlib.metadata
import itertools
import json
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Any

from pipeline.cache import hash_parts, keep, look_up
from pipeline.config import loader
from pipeline.config.messages import explain_schema_errors, quote_value, suggest
from pipeline.errors import ConfigError

if TYPE_CHECKING:
    from pipeline.config.schema import Config

_CACHED = "configurations"
_PACKAGES = ("hydra-core", "pydantic", "pint")
_PACKAGE = Path(__file__).parents[1]
_ROOMS = ("config", "laws", "rotor", "data", "ingest")
"""Those that have sections of the schema."""


def compose_config(overrides: Sequence[str] = (), folder: Path | None = None) -> Config:
    """The configuration that ``python -m pipeline OVERRIDES`` would run its only stage with."""
    (config,) = compose_stages(overrides, folder)
    return config


def compose_stages(overrides: Sequence[str] = (), folder: Path | None = None) -> list[Config]:
    """The configurations, one a stage, that ``python -m pipeline OVERRIDES`` would run one after the other.

    ``folder`` is that of ``--config-dir``.
    """
    key = _identify(overrides, folder)
    content = look_up(_CACHED, key) if key else None
    configs = _read(content or b"")
    if not configs:
        configs = _validate_stages(compose_mapping(overrides, folder))
        content = json.dumps([config.model_dump(mode="json") for config in configs]).encode()
        if key and not configs[0].machine.runs_file and _read(content) == configs:
            keep(_CACHED, key, content)
    return [_complete(config, overrides, folder) for config in configs]


def validate_stages(mapping: Mapping[str, Any], overrides: Sequence[str]) -> list[Config]:
    """``mapping`` as a Config for each of its stages, with the values that its study promoted; ``overrides`` win."""
    return [_complete(config, overrides, None) for config in _validate_stages(mapping)]


def _complete(config: Config, overrides: Sequence[str], folder: Path | None) -> Config:
    from pipeline.config.choice import name_choice
    from pipeline.config.promotion import apply_promoted

    return apply_promoted(config, overrides).model_copy(update={"chosen_by": name_choice(config, overrides, folder)})


def _identify(overrides: Sequence[str], folder: Path | None) -> str:
    """Identity of all that a configuration is composed from: ``conf``, the schema, the packages, the overrides, and the
    files outside ``conf`` that they name. Empty where one of them can't be read."""
    from pipeline.config.own_machines import list_files

    rooms = [path for room in _ROOMS for path in sorted((_PACKAGE / room).glob("*.py"))]
    schema = [*rooms, _PACKAGE / "coefficients.py", _PACKAGE / "unknowns.py"]
    try:
        outside = list_files(overrides, folder)
        files = {path: path.read_bytes() for path in (*sorted(loader.CONF.rglob("*.yaml")), *schema, *outside)}
    except (OSError, ValueError):
        return ""
    if "$" in "".join(overrides) or any(b"$" in files[path] for path in outside):  # the environment resolves it
        return ""
    contents = (content_bytes for path, content in files.items() for content_bytes in (str(path), content))
    return hash_parts(*contents, *map(importlib.metadata.version, _PACKAGES), json.dumps(list(overrides)))


def _read(content: bytes) -> list[Config]:
    """The configurations of a command; none where the entry is damaged, or there is none."""
    from pipeline.config.schema import Config

    try:
        return [Config.model_validate(mapping) for mapping in json.loads(content)]
    except (ValueError, TypeError):  # pydantic's errors are ValueErrors
        return []


def _validate_stages(mapping: Mapping[str, Any]) -> list[Config]:
    complete = _insert_runs(mapping)
    return [validate(dict(complete) | {"stage": stage}) for stage in list_stages(mapping)]


def list_stages(mapping: Mapping[str, Any]) -> list[str]:
    """The stages of a command, in the order given. Raises ConfigError for an unknown one, and one given twice."""
    given = mapping.get("stage")
    stages: list[Any] = given if isinstance(given, list) and given else [given]
    for stage in stages:
        _require_stage(stage)
    if len(set(stages)) < len(stages):
        raise ConfigError(f"stage must name each stage once, but got {quote_value(given)}")
    if len(stages) > 1 and "new" in stages:  # before a machine file is written, nothing can read it
        raise ConfigError(f"stage=new must be a command of its own, but got {quote_value(given)}")
    return stages


def _require_stage(stage: object) -> None:
    from pipeline.config.stage_names import STAGES

    if not isinstance(stage, str) or stage not in STAGES:
        raise ConfigError(f"stage must be one of the stages, but got {quote_value(stage)}{suggest(str(stage), STAGES)}")


def _insert_runs(mapping: Mapping[str, Any]) -> Mapping[str, Any]:
    """``mapping`` with the speeds and runs of ``machine.runs_file``, such as ``stage=design`` writes."""
    import yaml

    section = mapping.get("machine")
    if not isinstance(section, Mapping) or not (file := section.get("runs_file")):
        return mapping
    try:
        read = yaml.safe_load(Path(str(file)).read_text(encoding="utf-8"))
    except (OSError, ValueError, yaml.YAMLError) as error:
        raise ConfigError(
            f"machine.runs_file must be speeds and runs such as stage=design writes, but '{file}' can't be read as "
            f"such: {error}"
        ) from None
    if not isinstance(read, dict) or set(read) != {"speeds", "runs"}:
        came = ", ".join(map(str, read)) if isinstance(read, dict) and read else quote_value(read)
        raise ConfigError(f"machine.runs_file must have speeds and runs and nothing else, but '{file}' has {came}")
    return dict(mapping) | {"machine": dict(section) | read}


def compose_mapping(overrides: Sequence[str] = (), folder: Path | None = None) -> dict[str, Any]:
    """The composed configuration, interpolations resolved, before the schema has seen it."""
    from pipeline.config.choice import choose
    from pipeline.config.own_machines import store_files

    with loader.start_hydra() as hydra, store_files(folder):
        parsed = loader.parse_overrides(overrides, hydra)
        loader.refuse_sweeps(parsed)
        return loader.compose(choose(parsed, hydra), hydra)


def validate(mapping: Mapping[str, Any]) -> Config:
    """``mapping`` as a Config."""
    from pydantic import ValidationError

    from pipeline.config.schema import Config

    _require_stage(mapping.get("stage"))
    try:
        return Config.model_validate(mapping)
    except ValidationError as error:
        raise ConfigError(explain_schema_errors(error, mapping, Config)) from None


def expand_sweeps(overrides: Sequence[str]) -> tuple[list[list[str]], frozenset[str]]:
    """The overrides of every job of a multirun, and the keys that are the same in all of them."""
    with loader.start_hydra() as hydra:
        parsed = loader.parse_overrides(overrides, hydra)
        values = [loader.list_values(override) for override in parsed]
    fixed = frozenset(override.key_or_group for override in parsed if not override.is_sweep_override())
    return [list(job) for job in itertools.product(*values)], fixed


@contextmanager
def prepare_for_hydra(overrides: Sequence[str], folder: Path | None) -> Iterator[list[str]]:
    """``overrides`` as Hydra itself takes them, the last of each key; meanwhile its store has the user's own files."""
    from hydra.core.config_store import ConfigStore

    from pipeline.config.choice import choose
    from pipeline.config.own_machines import store_files

    with store_files(folder):
        with loader.start_hydra() as hydra:
            chosen = [loader.get_text(o) for o in choose(loader.parse_overrides(overrides, hydra), hydra)]
            files = ConfigStore.instance().repo
        ConfigStore.instance().repo = files  # Hydra's state is as it was, but for them
        yield chosen
