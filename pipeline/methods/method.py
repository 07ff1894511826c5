"""The interface that all methods share: a measurement in; coefficients with deviations out, or a named refusal.

Legend: B bearings, M members (B, or 1 where all bearings share their coefficients), S speeds, P channels, R runs, U
unknowns.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np

from pipeline.config.comparison import ComparisonConfig
from pipeline.data.operating import group_rows, split_states
from pipeline.errors import DataError, PipelineError
from pipeline.identification.quality import FAR_FROM_EXPECTED
from pipeline.laws.law_set import NO_LAWS, LawSet
from pipeline.parameters.kind import turns_with_rotor
from pipeline.problem.diagnosis import determines, guess_bearings, sensor_rows
from pipeline.problem.identifiability import Identifiability, Solvability, judge_identifiability
from pipeline.problem.measurement import Measurement
from pipeline.problem.residual import BearingEquations, LinearResidual
from pipeline.rotor.bearing_table import BearingTable

REQUIREMENTS = {
    "no_law": "the machine must have laws of its bearings",
    "bearings_not_measured": "x and y must be measured at every bearing",
    "forces_not_seen": "the sensors must tell the forces at the bearings",
    "not_determined": "the measurement must determine the unknowns",
    "nothing_to_validate": "there must be more equations than unknowns at a speed",
    "one_frequency": "there must be forces of two or more frequencies at a rotor speed",
    "too_many_unknowns": "the surrogate takes few unknowns",
    "either_sign": "the unknowns must be positive: a direct coefficient each",
    "stiffness_alone": "the unknowns must be direct stiffnesses",
    "constant": "the coefficients must change with the speed",
    "not_constant": "the coefficients must be the same at every speed",
    "few_speeds": "there must be enough speeds",
    "not_finite": "the answer must be finite",
    "singular": "the arithmetic must stay regular",
    "not_settled": "the iteration must settle",
    "no_critical_speed": "there must be a critical speed for each unknown among the speeds",
    "residual_unbalance": "a residual unbalance can't be identified",
}
"""Name of what a method can't do -> what a task must have for it."""


class Refusal(PipelineError):
    """A method that can't do a task: ``reason`` names why, of :data:`REQUIREMENTS`; ``str`` says what came."""

    def __init__(self, reason: str, came: str) -> None:
        super().__init__(f"{REQUIREMENTS[reason]}, but {came}")
        self.reason = reason


@dataclass(frozen=True)
class MethodOptions:
    """What a method may know beside the measurement."""

    settings: ComparisonConfig
    seed: int
    laws: LawSet = NO_LAWS  # of the bearings, where something is known of their type

    @property
    def constant(self) -> bool:
        """Whether the coefficients are known to be the same at every speed."""
        return self.settings.response.model.kind == "constant"


@dataclass(frozen=True, eq=False)
class Estimate:
    """What a method answers."""

    coefficients: BearingTable  # with their deviations, where some are stated
    words: str = ""  # what the answer cost or rests on
    doubt: str = ""  # what speaks against it: it does not explain its readings
    n_speeds: int = 0  # how many speeds were looked at; 0 for all


@dataclass(frozen=True)
class Method:
    """One method, and what a reader must know to choose it."""

    name: str
    label: str
    source: str
    beforehand: str  # data and priors that it needs beside the measurement
    solve: Callable[[Measurement, MethodOptions], Estimate]
    takes_planes: bool = False  # it identifies a residual unbalance, too
    takes_conditions: bool = False  # its coefficients are functions of operating conditions, too

    def identify(self, measurement: Measurement, options: MethodOptions) -> Estimate:
        """Answer from the measurement, less the runs that the method can't use. Raises Refusal.

        A method of the speed alone answers at each operating condition by itself, and so where runs are missing.
        """
        used = measurement if self.takes_planes else drop_unbalance(measurement)
        if (used.dataset.operating or not used.dataset.complete) and not self.takes_conditions:
            return solve_each(lambda state: self.solve(state, options), used)
        return self.solve(used, options)


# --- one operating condition after the other --------------------------------------------------------


def solve_each(solve: Callable[[Measurement], Estimate], measurement: Measurement) -> Estimate:
    """The answers of ``solve`` at each operating condition, put together. Raises the first Refusal.

    Points of a condition that were not measured in the same runs are answered apart, each with its own runs.
    """
    data, values = measurement.dataset, np.array(measurement.known.values)
    states = [
        points[rows]
        for _, points in split_states(data.speeds, data.operating)
        for rows in group_rows(data.present[points])
    ]
    answers, deviation = [], np.full(values.shape, np.nan)
    for points in states:  # in the runs that have them, as if there were no operating conditions
        state = measurement.select(points, np.flatnonzero(data.present[points[0]]))
        known = replace(state.known, operating={})
        answer = solve(replace(state, dataset=replace(state.dataset, operating={}), known=known))
        values[:, points], deviation[:, points] = answer.coefficients.values, answer.coefficients.spread
        answers.append(answer)
    used = [answer.n_speeds or len(points) for answer, points in zip(answers, states, strict=True)]
    return replace(
        answers[0],
        coefficients=replace(measurement.known, values=values, deviation=deviation),
        words=f"each of {len(states)} conditions by itself; the first: {answers[0].words}",
        doubt=next((answer.doubt for answer in answers if answer.doubt), ""),
        n_speeds=sum(used) if any(answer.n_speeds for answer in answers) else 0,
    )


# --- what methods share ----------------------------------------------------------------------------


def make_estimate(
    measurement: Measurement, values: np.ndarray, deviation: np.ndarray, words: str = "", doubt: str = ""
) -> Estimate:
    """The answer, from unknowns (M, S, U) and their standard deviations (M, S, U)."""
    stated = measurement.unknowns.expand_deviation(np.nan_to_num(deviation))
    return Estimate(replace(measurement.table(values), deviation=stated), words, doubt)


def require_bearing_equations(measurement: Measurement) -> BearingEquations:
    """The equations at the bearings. Raises Refusal where they are not measured."""
    try:
        return measurement.equations
    except DataError:
        raise Refusal("bearings_not_measured", f"the sensors are at {describe_sensors(measurement)}") from None


def require_residual(measurement: Measurement, options: MethodOptions) -> LinearResidual:
    """The residual in the unknowns. Raises Refusal where the runs do not determine them at any speed."""
    equations = require_bearing_equations(measurement)
    refuse_undetermined(judge_identifiability(equations, measurement.residual, options.constant))
    return measurement.residual


def refuse_undetermined(reports: tuple[Identifiability, ...]) -> None:
    """Raise Refusal for a bearing whose unknowns the runs determine at no speed."""
    for report in reports:
        if report.verdict is Solvability.NOT_IDENTIFIABLE:
            raise Refusal("not_determined", report.reason)


def require_determined(measurement: Measurement, together: bool) -> None:
    """Raise Refusal where the readings leave a combination of the unknowns free: all speeds ``together``, or each.

    Judged at bearings of the size of the guess that are all the same: what their symmetry hides is hidden near it, too.
    """
    rows = sensor_rows(measurement, guess_bearings(measurement))
    if not determines(rows.reshape(1, -1, rows.shape[-1]) if together else rows):
        where = "all speeds together" if together else "a speed by itself"
        nodes = {node for node, _ in measurement.dataset.channels}
        raise Refusal(
            "not_determined",
            f"at {where} {describe_sensors(measurement)} leave{'s' * (len(nodes) == 1)} a combination of them free",
        )


def describe_sensors(measurement: Measurement) -> str:
    """Name the nodes that are measured."""
    nodes = list(dict.fromkeys(node for node, _ in measurement.dataset.channels))
    return f"node{'s' * (len(nodes) > 1)} {', '.join(map(str, nodes))}"


def drop_unbalance(measurement: Measurement) -> Measurement:
    """The measurement without the runs that a residual unbalance moves, where there is one to identify.

    Raises Refusal where no run is left.
    """
    if not measurement.unknowns.planes:
        return measurement
    keep = np.flatnonzero(~turns_with_rotor(measurement.dataset))
    if not len(keep):
        raise Refusal("residual_unbalance", "every run turns with the rotor")
    # The response is solved anew: that of the measurement has planes.
    return replace(measurement.select(None, keep), unknowns=replace(measurement.unknowns, planes=()))


def describe_unbalance(planes: tuple[int, ...], unbalance: np.ndarray) -> str:
    """Name the residual unbalance (N,) complex, kg m, of the planes; no words where there are none."""
    sizes = (f"{1e6 * abs(u):.3g} g mm at node {node}" for node, u in zip(planes, unbalance, strict=True))
    return f", residual unbalance {', '.join(sizes)}" if planes else ""


def doubt(misfit: float | None) -> str:
    """Say that chi-square is far above what is expected; no words where it is not."""
    if misfit is None or misfit <= FAR_FROM_EXPECTED:  # NaN is not either
        return ""
    return f"chi-square is {misfit:.3g} times what is expected"
