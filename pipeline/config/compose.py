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
from pipeline.config.messages import explain_schema_errors, quote_value, suggest
from pipeline.errors import ConfigError

if TYPE_CHECKING:
    from pipeline.config.schema import Config


def compose_config(overrides: Sequence[str] = (), folder: Path | None = None) -> Config:
    """The configuration that ``python -m pipeline OVERRIDES`` would run its only stage with."""
    (config,) = compose_stages(overrides, folder)
    return config


def compose_stages(overrides: Sequence[str] = (), folder: Path | None = None) -> list[Config]:
    """The configurations, one a stage, that ``python -m pipeline OVERRIDES`` would run one after the other.

    ``folder`` is that of ``--config-dir``.
    """
    return validate_stages(compose_mapping(overrides, folder), overrides, folder)


def validate_stages(mapping: Mapping[str, Any], overrides: Sequence[str], folder: Path | None = None) -> list[Config]:
    """``mapping`` as a Config for each of its stages, with the values that its study promoted; ``overrides`` win."""
    from pipeline.config.choice import name_choice
    from pipeline.config.promotion import apply_promoted

    complete = _insert_runs(mapping)
    configs = [validate(dict(complete) | {"stage": stage}) for stage in list_stages(mapping)]
    return [
        apply_promoted(config, overrides).model_copy(update={"chosen_by": name_choice(config, overrides, folder)})
        for config in configs
    ]


def list_stages(mapping: Mapping[str, Any]) -> list[Any]:
    """The stages of a command, in the order given. Raises ConfigError for one given twice."""
    given = mapping.get("stage")
    stages: list[Any] = given if isinstance(given, list) and given else [given]
    if any(stages.count(stage) > 1 for stage in stages):
        raise ConfigError(f"stage must name each stage once, but got {quote_value(given)}")
    if len(stages) > 1 and "new" in stages:  # before a machine file is written, nothing can read it
        raise ConfigError(f"stage=new must be a command of its own, but got {quote_value(given)}")
    return stages


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

    with loader.start_hydra(folder) as hydra:
        parsed = loader.parse_overrides(overrides, hydra)
        loader.refuse_sweeps(parsed)
        return loader.compose(choose(parsed, hydra), hydra)


def validate(mapping: Mapping[str, Any]) -> Config:
    """``mapping`` as a Config. Raises ConfigError, also for a stage that there is not."""
    from pydantic import ValidationError

    from pipeline.config.schema import Config

    stage = mapping.get("stage")
    if not isinstance(stage, str) or stage not in loader.STAGES:
        known = suggest(str(stage), loader.STAGES)
        raise ConfigError(f"stage must be one of the stages, but got {quote_value(stage)}{known}")
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
    from pipeline.config.choice import choose

    with loader.start_hydra(folder) as hydra:
        yield [loader.get_text(override) for override in choose(loader.parse_overrides(overrides, hydra), hydra)]
