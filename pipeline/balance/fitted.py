"""What predicts vibration from weights, by the name of the method: influence coefficients, physical model, blend."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from functools import cached_property

from pipeline.balance.blend import blend_with_influence
from pipeline.balance.consistency import find_contradictions
from pipeline.balance.influence import fit_influence
from pipeline.balance.linear_vibration import LinearVibration
from pipeline.balance.physical import Physical
from pipeline.data.conditions import Conditions
from pipeline.errors import ConfigError, IdentifiabilityError, nearest


@dataclass(frozen=True, eq=False)
class Fitted:
    """The experiment's conditions, the names of those that contradict their labels, and what was fitted to the others,
    by method; the preferred one is the first."""

    conditions: Conditions
    contradictions: tuple[str, ...]
    models: Mapping[str, LinearVibration]

    @cached_property
    def sound(self) -> Conditions:
        """The conditions that do not contradict their labels."""
        return self.conditions.without(self.contradictions)

    def can_leave_out(self, method: str) -> bool:
        """Whether the method is fitted anew without each condition: quickly done, and of enough conditions."""
        return method == "influence" and len(self.sound.names) > len(self.sound.planes) + 3

    def leave_each_out(self, method: str) -> list[LinearVibration]:
        """The model of a method for each of the experiment's conditions: influence coefficients that it is no part of.

        With too few conditions to leave one out, and for other methods, it is the one that there is.
        """
        left_out = self.sound.names if self.can_leave_out(method) else ()
        return [
            fit_influence(self.sound.without([name])) if name in left_out else self.models[method]
            for name in self.conditions.names
        ]

    def pick(self, wanted: str | None, key: str) -> str:
        """The method that is asked for at ``key``, or the first. Raises ConfigError for one that there is not."""
        method = wanted or next(iter(self.models))
        if method not in self.models:
            raise ConfigError(f"{key} must be a method with a fit, but got '{method}': {nearest(method, self.models)}")
        return method


def fit_models(conditions: Conditions, physical: Physical | None) -> Fitted:
    """Influence coefficients, and where there is a physical model, that and the blend of both.

    Conditions that contradict their labels are left out.
    """
    try:
        contradictions, influence = find_contradictions(conditions)
    except IdentifiabilityError:  # too few conditions to judge one by the others
        contradictions, influence = {}, fit_influence(conditions)
    models: dict[str, LinearVibration] = {"influence": influence}
    if physical:
        models |= {
            "physical": physical,
            "blend": blend_with_influence(physical, conditions.without(contradictions)),
        }
    return Fitted(conditions, tuple(contradictions), models)
