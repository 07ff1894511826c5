"""From ``conf/``, a machine file and overrides to a checked :class:`~pipeline.config.schema.Config`.

Its errors, and pydantic's, leave here as :class:`~pipeline.errors.ConfigError`: the law, what came, the next step.
"""

from __future__ import annotations

import itertools
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Any

from pipeline.config import loader
from pipeline.config.kept import keep_configurations, kept, made_from
from pipeline.config.messages import schema_errors, shown, suggestion
from pipeline.errors import ConfigError

if TYPE_CHECKING:
    from pipeline.config.schema import Config

ALONE = ("new",)
"""Stages that no other goes with: before a machine file is written, nothing can read it."""


def compose_config(overrides: Sequence[str] = (), folder: Path | None = None) -> Config:
    """The configuration that ``python -m pipeline OVERRIDES`` would run its only stage with."""
    (config,) = compose_stages(overrides, folder)
    return config


def compose_stages(overrides: Sequence[str] = (), folder: Path | None = None) -> list[Config]:
    """The configurations, one a stage, that ``python -m pipeline OVERRIDES`` would run one after the other.

    ``folder`` is that of ``--config-dir``. What was composed before comes from the cache, without Hydra and pint,
    which take a second.
    """
    from pipeline.config.own_machines import contents

    outside = contents(overrides, folder)
    key = None if outside is None else made_from(loader.CONF, overrides, outside)
    configs = None if key is None else kept(key)
    if configs is None:
        mapping = composed_mapping(overrides, folder)
        configs = _validated_stages(mapping)
        if key is not None and _is_all_in_the_key(mapping, overrides, outside or ()):
            keep_configurations(key, configs)
    return [_in_force(config, overrides, folder) for config in configs]


def effective(mapping: Mapping[str, Any], overrides: Sequence[str]) -> list[Config]:
    """``mapping`` as a Config for each of its stages, with the promoted values of its study; ``overrides`` win over
    them."""
    return [_in_force(config, overrides, None) for config in _validated_stages(mapping)]


def _in_force(config: Config, overrides: Sequence[str], folder: Path | None) -> Config:
    from pipeline.config.choice import chosen_by
    from pipeline.config.promotion import with_promoted

    return with_promoted(config, overrides).model_copy(update={"chosen_by": chosen_by(config, overrides, folder)})


def _validated_stages(mapping: Mapping[str, Any]) -> list[Config]:
    complete = _with_runs_file(mapping)
    return [validated(dict(complete) | {"stage": stage}) for stage in stages_of(mapping)]


def stages_of(mapping: Mapping[str, Any]) -> list[str]:
    """The stages of a command, in the order given. Raises ConfigError for an unknown one, and one given twice."""
    given = mapping.get("stage")
    stages: list[Any] = given if isinstance(given, list) and given else [given]
    for stage in stages:
        _require_stage(stage)
    if len(set(stages)) < len(stages):
        raise ConfigError(f"stage must name each stage once, but got {shown(given)}")
    if len(stages) > 1 and set(stages) & set(ALONE):
        raise ConfigError(f"stage=new must be a command of its own, but got {shown(given)}")
    return stages


def _require_stage(stage: object) -> None:
    from pipeline.config.stage_names import STAGES

    if not isinstance(stage, str) or stage not in STAGES:
        raise ConfigError(f"stage must be one of the stages, but got {shown(stage)}{suggestion(str(stage), STAGES)}")


def _is_all_in_the_key(mapping: Mapping[str, Any], overrides: Sequence[str], outside: Sequence[str | bytes]) -> bool:
    """Whether nothing comes from a file of runs, or from what the environment resolves."""
    section = mapping.get("machine")
    from_file = isinstance(section, Mapping) and bool(section.get("runs_file"))
    resolved = any("$" in override for override in overrides) or any(b"$" in o for o in outside if isinstance(o, bytes))
    return not from_file and not resolved


def _with_runs_file(mapping: Mapping[str, Any]) -> Mapping[str, Any]:
    """``mapping`` with the speeds and runs of ``machine.runs_file``, such as ``stage=design`` writes."""
    import yaml

    section = mapping.get("machine")
    file = section.get("runs_file") if isinstance(section, Mapping) else None
    if not file:
        return mapping
    try:
        read = yaml.safe_load(Path(str(file)).read_text(encoding="utf-8"))
    except (OSError, ValueError, yaml.YAMLError) as error:
        raise ConfigError(
            f"machine.runs_file must be speeds and runs such as stage=design writes, but '{file}' can't be read as "
            f"such: {error}"
        ) from None
    if not isinstance(read, dict) or set(read) != {"speeds", "runs"}:
        came = ", ".join(map(str, read)) if isinstance(read, dict) and read else shown(read)
        raise ConfigError(f"machine.runs_file must have speeds and runs and nothing else, but '{file}' has {came}")
    assert isinstance(section, Mapping)
    return dict(mapping) | {"machine": dict(section) | read}


def composed_mapping(overrides: Sequence[str] = (), folder: Path | None = None) -> dict[str, Any]:
    """The composed configuration, interpolations resolved, before the schema has seen it."""
    from pipeline.config.choice import with_choice
    from pipeline.config.own_machines import own_files

    with loader.hydra_on_conf() as hydra, own_files(folder):
        parsed = loader.parsed_overrides(overrides, hydra)
        loader.refuse_sweeps(parsed)
        return loader.composed(with_choice(parsed, hydra), hydra)


def validated(mapping: Mapping[str, Any]) -> Config:
    """``mapping`` as a Config."""
    from pydantic import ValidationError

    from pipeline.config.schema import Config

    _require_stage(mapping.get("stage"))
    try:
        return Config.model_validate(mapping)
    except ValidationError as error:
        raise ConfigError(schema_errors(error, mapping, Config)) from None


def expanded(overrides: Sequence[str]) -> tuple[list[list[str]], frozenset[str]]:
    """The overrides of every job of a multirun, and the keys that are the same in all of them."""
    with loader.hydra_on_conf() as hydra:
        parsed = loader.parsed_overrides(overrides, hydra)
        choices = [loader.choices(override) for override in parsed]
    fixed = frozenset(override.key_or_group for override in parsed if not override.is_sweep_override())
    return [list(job) for job in itertools.product(*choices)], fixed


@contextmanager
def prepared(overrides: Sequence[str], folder: Path | None) -> Iterator[list[str]]:
    """``overrides`` as Hydra itself takes them, the last of each key; meanwhile its store has the user's own files."""
    from hydra.core.config_store import ConfigStore

    from pipeline.config.choice import with_choice
    from pipeline.config.own_machines import own_files

    with own_files(folder):
        with loader.hydra_on_conf() as hydra:
            chosen = [loader.text_of(o) for o in with_choice(loader.parsed_overrides(overrides, hydra), hydra)]
            files = ConfigStore.instance().repo
        ConfigStore.instance().repo = files  # Hydra's state is as it was, but for them
        yield chosen
