"""Values by dotted key in a configuration: those of a trial, and those that a study promoted into training."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from operator import attrgetter
from pathlib import Path
from typing import TYPE_CHECKING, Any

from pydantic import Field

from pipeline.config.loader import CONF, parse_key
from pipeline.config.messages import explain_schema_errors, name_first
from pipeline.config.models import model_fields
from pipeline.config.section import Section
from pipeline.config.tuning import HeldOutLoss, Key, Value
from pipeline.errors import ConfigError, DataError

if TYPE_CHECKING:
    from pipeline.config.schema import Config

BEST = "best.yaml"
UNTUNED_STAGES = ("tune", "promote", "check", "new")
"""Stages that see the configured values: a study begins from them."""


class PromotedTrial(Section):
    """``best.yaml``: the values that a study promoted; empty where the configured default is the best."""

    study: str
    trial: int = Field(ge=0)
    values: dict[Key, Value]
    held_out_loss: HeldOutLoss


def apply_values(config: Config, values: Mapping[str, Value], source: str) -> Config:
    """``config`` with ``values`` by dotted key; ``source`` says in a message where they come from.

    With a ``model.kind`` of its own the model keeps what both kinds have; ``values`` give the rest.

    :raises ConfigError: where a key does not exist or a value breaks a law of the schema
    """
    from pydantic import ValidationError

    from pipeline.config.schema import Config

    excluded = {name: getattr(config, name) for name, field in Config.model_fields.items() if field.exclude}
    mapping = config.model_dump() | excluded
    if (kind := values.get("model.kind", config.model.kind)) != config.model.kind:
        fields = model_fields(str(kind)) or mapping["model"]
        mapping["model"] = {name: mapping["model"].get(name) for name in fields}
    for key, value in values.items():
        group, _, last = key.rpartition(".")
        place = look_up(mapping, group)
        if last not in place:
            raise ConfigError(f"{source} must name keys of the configuration, but '{key}' is not one of {config.name}")
        place[last] = value
    try:
        return Config.model_validate(mapping)
    except ValidationError as error:
        raise ConfigError(
            f"{source} must give values that the schema takes:\n{explain_schema_errors(error, mapping, Config)}"
        ) from None


def look_up(composed: Mapping[str, Any], key: str) -> Any:
    """Return the section at a dotted key such as ``machine.bearings.nodes.21``; an empty one where there is none."""
    node: Any = composed
    for word in key.split("."):
        inside = node if isinstance(node, Mapping) else {}
        node = inside.get(word, inside.get(int(word)) if word.isdigit() else None)
    return node if isinstance(node, Mapping) else {}


def get_value(config: Config, key: str) -> Any:
    """Return the value of a dotted key. Raises ConfigError where there is none."""
    try:
        return attrgetter(key)(config)
    except AttributeError:
        raise ConfigError(
            f"tuning.space must name keys of the configuration, but '{key}' is not one of {config.name}: "
            "choose another search space, such as tuning=network or tuning=constant"
        ) from None


def has_value(config: Config, key: str) -> bool:
    """Tell whether the configuration has the dotted key: a model of another kind has others."""
    try:
        get_value(config, key)
    except ConfigError:
        return False
    return True


def read_promoted(folder: Path) -> PromotedTrial | None:
    """Read what the study in ``folder`` promoted; None where there is no study.

    :raises DataError: where ``best.yaml`` is not what ``stage=tune`` writes
    """
    import yaml
    from pydantic import ValidationError

    path = folder / BEST
    try:
        return PromotedTrial.model_validate(yaml.safe_load(path.read_text(encoding="utf-8")))
    except (FileNotFoundError, NotADirectoryError):
        return None
    except ValidationError as error:
        reason = name_first(error)
    except (OSError, UnicodeDecodeError, yaml.YAMLError) as error:
        reason = " ".join(str(error).split())
    raise DataError(
        f"'{path}' must hold the values that a study promoted, but {reason}: run stage=tune again, or train with the "
        "configured values (tuned=false)"
    )


def apply_promoted(config: Config, overrides: Sequence[str]) -> Config:
    """``config`` with the promoted values of its study, where there are any; ``overrides`` of the command line win.

    :raises DataError: where ``best.yaml`` can't be read
    :raises ConfigError: where its values do not fit the configuration
    """
    from pipeline.config.schema import PromotedConfig

    if not config.tuned or config.stage in UNTUNED_STAGES:
        return config
    folder = Path(config.tuning.promoted)  # in the working folder, or else beside conf/
    folder = folder if (folder / BEST).exists() else CONF.parent / folder
    promoted = read_promoted(folder)
    if not promoted:
        return config
    given = set(map(parse_key, overrides))
    in_force = {key: value for key, value in promoted.values.items() if not is_overridden(key, given)}
    source = f"'{folder / BEST}' (tuned=false leaves it out)"
    return apply_values(config, in_force, source).model_copy(
        update={
            "promoted": PromotedConfig(
                **dict(promoted),
                configured={key: get_value(config, key) for key in in_force if has_value(config, key)},
                in_force=in_force,
                overridden={key: value for key, value in promoted.values.items() if key not in in_force},
            )
        }
    )


def is_overridden(key: str, given: set[str]) -> bool:
    """Tell whether the command line set ``key``, or a group that it belongs to such as ``model``."""
    return any(name == key or key.startswith(f"{name}.") for name in given)
