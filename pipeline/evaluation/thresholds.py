"""Metrics against ``conf/thresholds``: what must not get worse, and why that is the limit.

A threshold file (one an experiment) is a list of rules ``{file, metric, max, why}``, or ``min`` in place of ``max``.
``metric`` is a dotted path into the JSON ``file`` of the experiment's folder; ``*`` matches every key, and all matches
must hold.
"""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any

from pydantic import BaseModel, ConfigDict, Field, TypeAdapter, model_validator

from pipeline.errors import ConfigError, DataError
from pipeline.files import read_json


class Rule(BaseModel):
    """One threshold."""

    model_config = ConfigDict(extra="forbid", frozen=True)

    file: str = "metrics.json"
    metric: str = Field(min_length=1)
    max: Annotated[float, Field(allow_inf_nan=False)] | None = None
    min: Annotated[float, Field(allow_inf_nan=False)] | None = None
    why: str = Field(min_length=10)

    @model_validator(mode="after")
    def _one_limit(self) -> Rule:
        if (self.max is None) == (self.min is None):
            raise ValueError("must have max, or min for a metric that must not get small, and not both")
        return self

    def allows(self, value: float) -> bool:
        """Whether the limit holds; not for NaN."""
        return value <= self.max if self.max is not None else self.min is not None and value >= self.min

    def __str__(self) -> str:
        return f"at most {self.max:g}" if self.max is not None else f"at least {self.min:g}"


@dataclass(frozen=True)
class Check:
    """One metric held against its threshold. ``value`` is None where there is no such metric."""

    experiment: str
    metric: str
    value: float | None
    rule: Rule

    @property
    def met(self) -> bool:
        """False for a missing metric and for NaN, too."""
        return self.value is not None and self.rule.allows(self.value)


def read_rules(path: Path) -> list[Rule]:
    """Rules of one experiment. Raises ConfigError."""
    import yaml

    try:
        return TypeAdapter(Annotated[list[Rule], Field(min_length=1)]).validate_python(
            yaml.safe_load(path.read_text(encoding="utf-8"))
        )
    except (OSError, ValueError, yaml.YAMLError) as error:
        raise ConfigError(
            f"'{path}' must be a list of rules with file, metric, max (or min) and why, but it is not: {error}"
        ) from None


def check_experiment(experiment: str, rules: list[Rule], folder: Path) -> list[Check]:
    """Every rule against the files in ``folder``. A missing file or metric fails its rule."""
    checks = []
    for rule in rules:
        found: list[tuple[str, float | None]] = []
        with suppress(DataError):
            found += _select(read_json(folder / rule.file), rule.metric.split("."))
        checks += [Check(experiment, name, value, rule) for name, value in found or [(rule.metric, None)]]
    return checks


def _select(value: Any, path: list[str], trail: tuple[str, ...] = ()) -> Iterator[tuple[str, float]]:
    if not path:
        if isinstance(value, (int, float)) and not isinstance(value, bool):
            yield ".".join(trail), float(value)
        return
    if not isinstance(value, dict):
        return
    for key in value if path[0] == "*" else [path[0]] if path[0] in value else []:
        yield from _select(value[key], path[1:], (*trail, key))
