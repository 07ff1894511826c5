"""The schema of a hyperparameter study: its search space, budget and storage."""

from __future__ import annotations

import math
import re
from collections.abc import Callable, Iterator
from typing import Annotated, Any, Literal

from pydantic import Field, PositiveFloat, PositiveInt, field_validator

from pipeline.config.section import NonNegativeInt, Once, Section, ascending, rule

Value = bool | int | float | str
Key = Annotated[str, Field(pattern=r"^(model|loss|optimizer)(\.[A-Za-z_]+)+$|^training\.tolerance$")]
"""A value of the configuration that a study may change: not what the objective is measured on."""


class _Dimension(Section):
    """What a study varies, and what its parameter means for the configuration."""

    when: dict[str, tuple[Value, ...]] = Field(default_factory=dict)
    """Dimension of the space -> its choices beside which this one has a meaning."""

    def options(self) -> tuple[Value, ...]:
        """The choices, by name where they have one; none for a range."""
        return tuple(getattr(self, "choices", ()))

    def extremes(self) -> tuple[Value, ...]:
        """The parameters that the schema must take: every choice, or the ends of a range."""
        return self.options()

    def suggest(self, trial: Any, name: str) -> Value:
        """The parameter that Optuna's ``trial`` draws."""
        return trial.suggest_categorical(name, self.options())

    def translate(self, parameter: Value) -> dict[str, Value]:
        """The values of the configuration, by key, that a parameter stands for."""
        return {getattr(self, "key", ""): parameter}

    def find(self, get: Callable[[str], Any]) -> list[Value]:
        """Parameters that stand for the configured values, which ``get`` gives by key; what says most comes first."""
        fitting = [
            option
            for option in self.options()
            if all(
                math.isclose(get(key), value)
                if isinstance(value, int | float) and isinstance(get(key), int | float)
                else get(key) == value
                for key, value in self.translate(option).items()
            )
        ]
        return sorted(fitting, key=lambda option: -len(self.translate(option)))

    def describe(self, name: str) -> str:
        """What the parameter may be, for a message."""
        return f"the choices of {name} are {', '.join(map(str, self.options()))}"


class FloatRange(_Dimension):
    """Real numbers from ``low`` to ``high``, SI."""

    kind: Literal["float"]
    key: Key
    low: float
    high: float
    log: bool = False

    def suggest(self, trial: Any, name: str) -> Value:
        return getattr(trial, f"suggest_{self.kind}")(name, self.low, self.high, log=self.log)

    def extremes(self) -> tuple[Value, ...]:
        return self.low, self.high

    def find(self, get: Callable[[str], Any]) -> list[Value]:
        value = get(self.key)
        return [value] if self.low <= value <= self.high else []

    def describe(self, name: str) -> str:
        return f"{name} goes from {self.low:g} to {self.high:g}"

    _span = ascending("low", "high")

    @rule
    def _has_logarithms(self) -> Iterator[str]:
        if self.log and self.low <= 0:
            yield f"must have low > 0 on a logarithmic scale, but got {self.low:g}"


class IntegerRange(FloatRange):
    """Whole numbers from ``low`` to ``high`` inclusive."""

    kind: Literal["int"]  # type: ignore[assignment]  # the tag of a union is narrower in each kind
    low: int
    high: int


class Choice(_Dimension):
    """One of the values of ``key``."""

    kind: Literal["choice"]
    key: Key
    choices: Annotated[tuple[Value, ...], Field(min_length=1), Once]


class Preset(_Dimension):
    """One of several named sets of values, such as an optimiser with the phases that it has."""

    kind: Literal["preset"]
    choices: dict[str, dict[Key, Value]] = Field(min_length=1)

    def translate(self, parameter: Value) -> dict[str, Value]:
        return dict(self.choices[str(parameter)])


Dimension = Annotated[IntegerRange | FloatRange | Choice | Preset, Field(discriminator="kind")]


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
    sampler: Literal["tpe", "random", "gp"]
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
    space: dict[Annotated[str, Field(pattern=r"^[A-Za-z][A-Za-z0-9_]*$")], Dimension]

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
        seen: dict[str, tuple[Value, ...]] = {}
        for name, dimension in self.space.items():
            for other, values in dimension.when.items():
                if not seen.get(other):
                    law = "must have conditions on choices that stand before them"
                    yield f"{law}, but space.{name}.when names '{other}'"
                unknown = [value for value in values if value not in seen[other]]
                if unknown or not values:
                    yield (
                        f"must have conditions that can hold, but space.{name}.when.{other} has "
                        f"{unknown or 'no value'} and the choices are {list(seen[other])}"
                    )
            seen[name] = dimension.options()
