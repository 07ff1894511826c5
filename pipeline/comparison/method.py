"""The interface that all methods share: a task in; coefficients with their deviations out, or a named refusal.

Legend: B bearings, M members (B, or 1 where all bearings are alike), S speeds, P channels, R runs, U unknowns.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from enum import Enum
from functools import cached_property

import numpy as np

from pipeline.coefficients import COEFFICIENTS
from pipeline.config.comparison import ComparisonConfig
from pipeline.config.identification import IdentifyConfig
from pipeline.config.runs import NoiseConfig
from pipeline.data.dataset import VibrationDataset, reading_deviation
from pipeline.equations.bearing_equations import BearingEquations, bearing_equations
from pipeline.equations.identifiability import Identifiability, Verdict, identifiability
from pipeline.equations.response import ResponseEquations, response_equations
from pipeline.equations.unknown_system import UnknownSystem, unknown_system
from pipeline.errors import DataError, PipelineError
from pipeline.rotor.bearing_table import BearingTable
from pipeline.rotor.model import RotorModel
from pipeline.unknowns import UnknownSet, unknown_set


class Reason(Enum):
    """What a method can't do, by name."""

    BEARINGS_NOT_MEASURED = "x and y must be measured at every bearing"
    NOT_DETERMINED = "the measurement must determine the unknowns"
    NOTHING_TO_VALIDATE = "there must be more equations than unknowns at a speed"
    ONE_FREQUENCY = "there must be forces of two or more frequencies at a rotor speed"
    TOO_MANY_UNKNOWNS = "the surrogate takes few unknowns"
    EITHER_SIGN = "the unknowns must be positive: a direct coefficient each"
    STIFFNESS_ALONE = "the unknowns must be direct stiffnesses"
    NOT_CONSTANT = "the coefficients must be the same at every speed"
    NOT_FINITE = "the answer must be finite"
    SINGULAR = "the arithmetic must stay regular"
    NOT_SETTLED = "the iteration must settle"
    NO_CRITICAL_SPEED = "there must be a critical speed for each unknown among the speeds"
    RESIDUAL_UNBALANCE = "a residual unbalance can't be identified"


class Refusal(PipelineError):
    """A method that can't do a task: ``reason`` names why, ``str`` says what came."""

    def __init__(self, reason: Reason, came: str) -> None:
        super().__init__(f"{reason.value}, but {came}")
        self.reason = reason


@dataclass(frozen=True, eq=False)
class Task:
    """Everything that a method may see. There is no truth in it."""

    rotor: RotorModel
    dataset: VibrationDataset
    known: BearingTable
    noise: NoiseConfig  # of the readings, as it is stated
    identify: IdentifyConfig
    settings: ComparisonConfig
    seed: int

    @property
    def constant(self) -> bool:
        """Whether the coefficients are known to be the same at every speed."""
        return self.settings.response.model.kind == "constant"

    @cached_property
    def unknowns(self) -> UnknownSet:
        """U of all bearings."""
        return unknown_set({node: self.identify.at(node) for node in self.rotor.bearing_nodes})

    @property
    def alike(self) -> bool:
        """Whether all bearings share their coefficients."""
        return self.identify.tie_bearings

    @property
    def members(self) -> int:
        """M."""
        return 1 if self.alike else len(self.rotor.bearing_nodes)

    @cached_property
    def active(self) -> tuple[tuple[int, int], ...]:
        """The unknowns that members have, as (member, unknown)."""
        present = self.unknowns.present[: self.members]
        return tuple((int(m), int(u)) for m, u in np.argwhere(present))

    @cached_property
    def deviation(self) -> np.ndarray:
        """(S, P, R) m, root mean square of the noise."""
        noise = self.noise
        return reading_deviation(
            self.dataset.displacement, self.dataset.subtracted, noise.additive, noise.multiplicative
        )

    @cached_property
    def equations(self) -> BearingEquations:
        """The equations at the bearings. Raises Refusal where they are not measured."""
        try:
            return bearing_equations(self.rotor, self.dataset)
        except DataError:
            raise Refusal(Reason.BEARINGS_NOT_MEASURED, f"the sensors are at {self.sensors}") from None

    @cached_property
    def system(self) -> UnknownSystem:
        """The residual in the unknowns. Raises Refusal where the runs do not determine them at any speed."""
        equations = self.equations
        system = unknown_system(equations, self.unknowns, self.known)
        refuse_undetermined(identifiability(equations, system, self.alike, self.constant))
        return system

    def response(self, planes: tuple[int, ...] = ()) -> ResponseEquations:
        """The response at the sensors."""
        return response_equations(self.rotor, self.dataset, self.settings.response.model.initial_stiffness, planes)

    def guess(self) -> np.ndarray:
        """(M, U) the configured guesses of direct coefficients, N/m and N s/m."""
        model = self.settings.response.model
        sizes = {"k": model.initial_stiffness, "c": model.initial_damping}
        return np.tile([sizes[name[0]] for name in self.unknowns.names], (self.members, 1))

    def table(self, values: np.ndarray) -> BearingTable:
        """All eight coefficients, from unknowns (M, S, U) and the known ones."""
        return self.known.with_unknowns(self.unknowns, values)

    def leading(self, table: BearingTable) -> np.ndarray:
        """(M, S, U) the unknowns of a table, each the coefficient that leads it."""
        leaders = [COEFFICIENTS.index(name) for name in self.unknowns.names]
        return table.values[: self.members][..., leaders] * self.unknowns.present[: self.members, None]

    @property
    def n_nodes(self) -> int:
        """How many nodes are measured."""
        return len({node for node, _ in self.dataset.channels})

    @property
    def sensors(self) -> str:
        """The nodes that are measured, in words."""
        nodes = list(dict.fromkeys(node for node, _ in self.dataset.channels))
        return f"node{'s' * (len(nodes) > 1)} {', '.join(map(str, nodes))}"

    def active_values(self, columns: np.ndarray) -> np.ndarray:
        """(M, S, U) from the active unknowns (S, A); zero where a member lacks an unknown."""
        result = np.zeros((self.members, len(columns), len(self.unknowns.names)))
        for a, (m, u) in enumerate(self.active):
            result[m, :, u] = columns[:, a]
        return result

    def estimate(self, values: np.ndarray, deviation: np.ndarray, words: str = "", doubt: str = "") -> Estimate:
        """The answer, from unknowns (M, S, U) and their standard deviations (M, S, U)."""
        every = np.broadcast_to(np.nan_to_num(deviation), (len(self.known.nodes), *deviation.shape[1:]))
        of = np.einsum("bcu,bsu->bsc", np.abs(self.unknowns.expansion), every)
        return Estimate(self.table(values), np.where(self.unknowns.identified[:, None], of, np.nan), words, doubt)

    def without_unbalance(self) -> Task:
        """The task without the runs that a residual unbalance moves, where there is one to identify.

        Raises Refusal where no run is left.
        """
        if not self.identify.unbalance_planes:
            return self
        keep = np.flatnonzero(~self.synchronous())
        dataset = self.dataset
        if not len(keep):
            raise Refusal(Reason.RESIDUAL_UNBALANCE, "every run turns with the rotor")
        identify = self.identify.model_copy(update={"unbalance_planes": ()})
        return replace(self, dataset=dataset.of_runs(keep), identify=identify)

    def synchronous(self) -> np.ndarray:
        """(R,) mask of the runs that turn with the rotor."""
        return np.isclose(self.dataset.frequencies, self.dataset.speeds[:, None], rtol=1e-9).all(axis=0)


@dataclass(frozen=True, eq=False)
class Estimate:
    """What a method answers."""

    coefficients: BearingTable
    deviation: np.ndarray | None  # (B, S, 8) standard deviations, NaN for known ones; None where none is stated
    words: str = ""  # what the answer cost or rests on
    doubt: str = ""  # what speaks against it, of itself: it does not explain its readings


@dataclass(frozen=True)
class Method:
    """One method, and what a reader must know to choose it."""

    name: str
    label: str
    source: str
    beforehand: str  # data and priors that it needs beside the measurement
    identify: Callable[[Task], Estimate]


def refuse_undetermined(accounts: tuple[Identifiability, ...]) -> None:
    """Raise Refusal for a bearing whose unknowns the runs determine at no speed."""
    for account in accounts:
        if account.verdict is Verdict.NOT_IDENTIFIABLE:
            raise Refusal(Reason.NOT_DETERMINED, account.reason)


def doubt_of(chi_square: float, expected: float) -> str:
    """Words for a chi-square far above what is expected; none for one that is not."""
    if chi_square <= _FAR_FROM_EXPECTED * expected:  # NaN is not either
        return ""
    return f"chi-square is {chi_square / expected:.3g} times what is expected"


_FAR_FROM_EXPECTED = 3.0
