"""Metrics against ``conf/thresholds``: what must not get worse, and why that is the limit.

A threshold file (one an experiment) is a list of rules ``{file, metric, max, why}``, or ``min`` in place of ``max``.
``metric`` is a dotted path into the JSON ``file`` of the experiment's folder; ``*`` matches every key, and all matches
must hold. ``committed.csv`` beside them has every metric as it was when the limits were last reviewed.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from contextlib import suppress
from csv import DictReader
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any

from pydantic import BaseModel, ConfigDict, Field, TypeAdapter, model_validator

from pipeline.errors import ConfigError, DataError
from pipeline.files import read_json

COMMITTED = "committed.csv"


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

    @property
    def limit(self) -> float:
        """The number that it must not pass."""
        return (self.min or 0.0) if self.max is None else self.max

    def allows(self, value: float) -> bool:
        """Whether the limit holds; not for NaN."""
        return value >= self.limit if self.max is None else value <= self.limit

    def __str__(self) -> str:
        return f"at {'least' if self.max is None else 'most'} {self.limit:g}"


@dataclass(frozen=True)
class Check:
    """One metric held against its threshold. ``value`` is None where there is no such metric."""

    experiment: str
    metric: str
    value: float | None
    rule: Rule
    committed: float | None = None  # what it was; None where nobody committed it

    @property
    def met(self) -> bool:
        """False for a missing metric and for NaN, too."""
        return self.value is not None and self.rule.allows(self.value)

    @property
    def share_of_limit(self) -> float | None:
        """How near it is to its threshold: 1 and more fails; None where that is no share, or the value no number."""
        if self.value is None or not math.isfinite(self.value):
            return None
        if self.rule.max:
            return self.value / self.rule.max if self.rule.max > 0 else None
        return self.rule.min / self.value if self.rule.min is not None and self.value > 0 else None

    def has_changed(self, share: float, of_limit: float = 0.01) -> bool:
        """Whether it moved by more than ``share`` of the committed value, and by more than ``of_limit`` of its limit.

        Rounding moves the last bits of what is far below its limit.
        """
        if self.committed is None or self.value is None or not math.isfinite(self.value):
            return self.committed is not None
        change = abs(self.value - self.committed)
        return change > share * abs(self.committed) and change > of_limit * abs(self.rule.limit)


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


Committed = dict[tuple[str, str, str], float]
"""Experiment, file, metric -> value."""


def read_committed(path: Path) -> Committed:
    """The committed metrics; none without a file. Raises ConfigError where it is not what ``check.commit`` writes."""
    if not path.exists():
        return {}
    try:
        with path.open(encoding="utf-8", newline="") as lines:
            return {(row["experiment"], row["file"], row["metric"]): float(row["value"]) for row in DictReader(lines)}
    except (OSError, KeyError, TypeError, ValueError) as error:
        raise ConfigError(
            f"'{path}' must be a table of experiment, file, metric and value, but it is not ({error}): make it again "
            "with stage=check check.commit=true"
        ) from None


def tabulate_committed(checks: Sequence[Check]) -> list[dict[str, Any]]:
    """The rows of ``committed.csv``; four digits say enough."""
    return [
        {"experiment": c.experiment, "file": c.rule.file, "metric": c.metric, "value": f"{c.value:.4g}"}
        for c in checks
        if c.value is not None
    ]


def check_experiment(experiment: str, rules: list[Rule], folder: Path, committed: Committed) -> list[Check]:
    """Every rule against the files in ``folder``. A missing file or metric fails its rule."""
    checks = []
    for rule in rules:
        values: list[tuple[str, float | None]] = []
        with suppress(DataError):
            values += _select(read_json(folder / rule.file), rule.metric.split("."))
        checks += [
            Check(experiment, name, value, rule, committed.get((experiment, rule.file, name)))
            for name, value in values or [(rule.metric, None)]
        ]
    return checks


def find_nearest_limits(checks: Sequence[Check]) -> dict[str, float]:
    """The metric nearest to its threshold in each experiment, as a share of it; 1 and more fails."""
    shares = [(c.experiment, c.share_of_limit) for c in checks if c.share_of_limit is not None]
    return {name: max(0.0, *(each for other, each in shares if other == name)) for name, _ in shares}


def _select(value: Any, path: list[str], trail: tuple[str, ...] = ()) -> Iterator[tuple[str, float]]:
    if not path:
        if isinstance(value, (int, float)) and not isinstance(value, bool):
            yield ".".join(trail), float(value)
        return
    if not isinstance(value, dict):
        return
    for key in value if path[0] == "*" else [path[0]] if path[0] in value else []:
        yield from _select(value[key], path[1:], (*trail, key))
