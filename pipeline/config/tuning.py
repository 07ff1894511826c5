"""The schema of a hyperparameter study: its search space, budget and storage."""

from __future__ import annotations

import re
from collections.abc import Iterator, Mapping
from typing import Annotated, Any, Literal

from pydantic import Field, PositiveFloat, PositiveInt, field_validator

from pipeline.config.section import NonNegativeInt, Section, rule

Value = bool | int | float | str
Key = Annotated[str, Field(pattern=r"^(model|loss|optimizer)(\.[A-Za-z_]+)+$|^training\.tolerance$")]
"""A value of the configuration that a study may change: not what the objective is measured on."""


class _Dimension(Section):
    when: dict[str, tuple[Value, ...]] = Field(default_factory=dict)

    def options(self) -> tuple[str | Value, ...] | None:
        """The choices, or None for a range."""
        return None


class _Range(_Dimension):
    key: Key
    low: float
    high: float
    log: bool = False

    @rule
    def _ascending(self) -> Iterator[str]:
        if self.low > self.high:
            yield f"must have low <= high, but got {self.low:g} and {self.high:g}"
        if self.log and self.low <= 0:
            yield f"must have low > 0 on a logarithmic scale, but got {self.low:g}"


class IntegerRange(_Range):
    """Whole numbers from ``low`` to ``high`` inclusive."""

    kind: Literal["int"]
    low: int
    high: int


class FloatRange(_Range):
    """Real numbers from ``low`` to ``high``, SI."""

    kind: Literal["float"]


class Choice(_Dimension):
    """One of the values of ``key``."""

    kind: Literal["choice"]
    key: Key
    choices: tuple[Value, ...] = Field(min_length=1)

    def options(self) -> tuple[str | Value, ...]:
        """The values."""
        return self.choices

    @rule
    def _once(self) -> Iterator[str]:
        if len(set(self.choices)) != len(self.choices):
            yield f"must name each choice once, but got {list(self.choices)}"


class Preset(_Dimension):
    """One of several named sets of values, such as an optimiser with the phases that it has."""

    kind: Literal["preset"]
    choices: dict[str, dict[Key, Value]] = Field(min_length=1)

    def options(self) -> tuple[str | Value, ...]:
        """The names."""
        return tuple(self.choices)


Dimension = Annotated[IntegerRange | FloatRange | Choice | Preset, Field(discriminator="kind")]
DimensionName = Annotated[str, Field(pattern=r"^[A-Za-z][A-Za-z0-9_]*$")]


Sampler = Literal["tpe", "random", "gp"]


class ComparisonConfig(Section):
    """Studies that ``stage=samplers`` makes: each sampler with each seed."""

    samplers: tuple[Sampler, ...] = Field(min_length=1)
    seeds: tuple[NonNegativeInt, ...] = Field(min_length=1)


class HeldOutLoss(Section):
    """Medians of the held-out loss over the seeds of a study; null where most seeds diverged."""

    configured: PositiveFloat | None
    promoted: PositiveFloat | None


class TuningConfig(Section):
    """A study: what is varied, how often, where it is kept and what is done with its best trials."""

    study: str = Field(min_length=1, max_length=200)
    folder: str = Field(min_length=1)
    promoted: str = Field(min_length=1)
    storage: str = Field(min_length=1)
    n_trials: PositiveInt
    sampler: Sampler
    sampler_seed: NonNegativeInt
    startup_trials: PositiveInt
    pruner: Literal["median", "none"]
    workers: Annotated[int, Field(ge=1, le=256)]
    finalists: Annotated[int, Field(ge=1, le=20)]
    seeds: tuple[NonNegativeInt, ...] = Field(min_length=1)
    least_gain: Annotated[float, Field(ge=1)]
    changed: Literal["refuse", "restart"]
    timeout_seconds: PositiveFloat
    heartbeat_seconds: PositiveInt
    comparison: ComparisonConfig
    space: dict[DimensionName, Dimension]

    @property
    def silence_seconds(self) -> int:
        """A worker without a heartbeat for so long is taken for dead."""
        return 3 * self.heartbeat_seconds

    @field_validator("storage")
    @classmethod
    def _storage(cls, url: str) -> str:
        if not re.match(r"^[a-z][a-z0-9+]*://", url, re.IGNORECASE):
            raise ValueError(
                "must be the URL of a database: sqlite:///studies/optuna.db for a file, or postgresql+psycopg://... "
                "(a journal such as studies/optuna.log is of an earlier version: its studies can't be gone on with, "
                "their reports stay)"
            )
        return url

    @rule
    def _space(self) -> Iterator[str]:
        seen: dict[str, Any] = {}
        for name, dimension in self.space.items():
            yield from _check_condition(name, dimension, seen)
            seen[name] = dimension


def _check_condition(name: str, dimension: _Dimension, earlier: Mapping[str, _Dimension]) -> Iterator[str]:
    for other, values in dimension.when.items():
        known = earlier[other].options() if other in earlier else None
        if known is None:
            yield f"must have conditions on choices that stand before them, but space.{name}.when names '{other}'"
        unknown = [value for value in values if value not in (known or ())]
        if unknown or not values:
            yield (
                f"must have conditions that can hold, but space.{name}.when.{other} has {unknown or 'no value'} and "
                f"the choices are {list(known or ())}"
            )
