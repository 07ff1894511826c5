"""Which run would help a coefficient most: the information that each candidate would add to that of the fit.

Legend: S speeds, P channels, R runs, B bearings, Z weights.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace

import numpy as np

from pipeline.data.dataset import EVERYWHERE, Excitation
from pipeline.identification.identified import IdentifiedModel
from pipeline.identification.uncertainty import Uncertainty
from pipeline.problem.condition_noise import NO_LEVELS
from pipeline.problem.measurement import Measurement
from pipeline.problem.ranking import rank_indices
from pipeline.trust.linearised import LinearisedFit, cross, linearise
from pipeline.write_numbers import write_number

Runs = Sequence[tuple[Excitation, ...]]


@dataclass(frozen=True, eq=False)
class Gains:
    """What each candidate run would add."""

    runs: tuple[tuple[Excitation, ...], ...] = ()
    factors: np.ndarray = field(default_factory=lambda: np.empty(0))
    """(C, B, 8) by how many times the deviations fall with it, by linear theory; medians over the speed."""

    def best(self, b: int, c: int) -> tuple[tuple[Excitation, ...], float]:
        """The run that lowers the deviation of a coefficient most, and by how many times; none and zero without any."""
        if not self.runs:
            return (), 0.0
        factors = self.factors[:, b, c]
        k = rank_indices(np.where(np.isfinite(factors), factors, np.nan))[0]
        return self.runs[k], float(factors[k])


def weigh_candidates(
    measurement: Measurement,
    identified: IdentifiedModel,
    uncertainty: Uncertainty,
    linear: LinearisedFit,
    candidates: Runs,
) -> Gains:
    """Every candidate beside the runs that there are; ``measurement`` is at the fitted model parameters."""
    nodes = measurement.rotor.n_nodes
    able = tuple(acting for acting in candidates if all(weight.node < nodes for weight in acting))
    if not able:
        return Gains()
    before, data, factors = linear.deviate(np.linalg.inv(linear.normal)), measurement.dataset, []
    excitations = tuple(replace(weight, run=f"candidate {i}") for i, acting in enumerate(able) for weight in acting)
    shape = (*data.displacement.shape[:2], len(able))
    plan = replace(
        data,
        runs=tuple(f"candidate {i}" for i in range(len(able))),
        displacement=np.zeros(shape, dtype=complex),
        excitations=excitations,
        own_frequencies=None,
        subtracted=None,
        present=EVERYWHERE,
    )
    planned = replace(measurement, dataset=plan, drift=NO_LEVELS)  # its runs are conditions of their own
    seen = linearise(planned, identified, uncertainty, np.ones(shape, dtype=bool)).by_weight
    for i in range(len(able)):
        after = linear.deviate(np.linalg.inv(linear.normal + cross(seen[:, :, [i]], seen[:, :, [i]])))
        with np.errstate(divide="ignore", invalid="ignore"):
            factors.append(np.median(before / after, axis=1))
    return Gains(able, np.array(factors))


def describe_run(acting: Sequence[Excitation]) -> str:
    """In words: weights and forces with their nodes and angles."""
    phrases = []
    for weight in acting:
        if weight.kind == "unbalance":
            what = f"a weight of {write_number(1e6 * weight.magnitude, digits=3)} g mm at node {weight.node}"
        else:
            what = (
                f"a {weight.whirl} rotating force of {write_number(weight.magnitude, digits=3)} N at node {weight.node}"
            )
        if len(acting) > 1:
            what += f" at {np.degrees(weight.phase):.0f} deg"
        phrases.append(what)
    return " and ".join(phrases)
