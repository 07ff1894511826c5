"""One measurement: the one value that every method takes, made once.

Legend: S speeds, P channels, R runs, B bearings, U unknowns, M members (B, or 1 where all bearings share their
coefficients), N balance planes.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import KW_ONLY, InitVar, dataclass, replace
from functools import cached_property
from pathlib import Path

import numpy as np

from pipeline.coefficients import COEFFICIENTS, CoefficientName, is_direct
from pipeline.data.dataset import VibrationDataset
from pipeline.data.sensors import NoiseModel
from pipeline.laws.law_set import NO_LAWS, LawSet
from pipeline.parameters.bearings import known_variation
from pipeline.parameters.kind import ModelParameter
from pipeline.parameters.model import set_values, update_rotor
from pipeline.parameters.weights import update_excitations
from pipeline.problem.condition_noise import NO_LEVELS
from pipeline.problem.noise import residual_root
from pipeline.problem.noise_levels import NoiseLevels
from pipeline.problem.reference_response import SolvedRotor
from pipeline.problem.residual import BearingEquations, LinearResidual, bearing_equations, linear_residual
from pipeline.problem.response import ResponseBlock, ResponseEquations
from pipeline.rotor.bearing_table import BearingTable
from pipeline.rotor.model import RotorModel
from pipeline.unknowns import Structure, UnknownSet, tie, unknown_set


@dataclass(frozen=True)
class Guess:
    """The order of magnitude of the direct coefficients, before anything is measured."""

    stiffness: float  # N/m
    damping: float  # N s/m
    within: float | None = None  # factor that is one standard deviation of a coefficient about it; None: no prior
    unbalance: float = np.inf  # kg m, one standard deviation of each part of a residual unbalance

    def sizes(self, unknowns: UnknownSet) -> np.ndarray:
        """(M, U) N/m and N s/m, cross-coupled coefficients included."""
        size = {"k": self.stiffness, "c": self.damping}
        return np.tile([size[name[0]] for name in unknowns.names], (unknowns.n_members, 1))

    def direct(self, unknowns: UnknownSet) -> np.ndarray:
        """(M, U) the same with zero for cross-coupled coefficients, which have either sign."""
        return self.sizes(unknowns) * [is_direct(name) for name in unknowns.names]


@dataclass(frozen=True, eq=False)
class Measurement:
    """Everything that an identification may see. There is no truth in it."""

    rotor: RotorModel
    dataset: VibrationDataset
    known: BearingTable  # the coefficients that are not identified, at the speeds of the data
    noise: NoiseModel
    unknowns: UnknownSet
    guess: Guess
    _: KW_ONLY
    parameters: tuple[ModelParameter, ...] = ()  # T, uncertain numbers of the model; the response is at their values
    tolerances: tuple[ModelParameter, ...] = ()  # further ones that are not fitted, but widen what is known
    drift: NoiseLevels = NO_LEVELS  # noise in levels, of runs that are means of records, in place of ``noise``
    laws: LawSet = NO_LAWS  # of the bearings, for models that are made of them
    as_found: tuple[complex, ...] = ()  # kg m at each node, what the baseline shows; none where no bearing drifts
    solved: InitVar[ResponseEquations | None] = None  # :attr:`response`, where it is at hand
    weighed: InitVar[np.ndarray | None] = None  # :attr:`deviation`, where it is not to follow from ``noise``

    def __post_init__(self, solved: ResponseEquations | None, weighed: np.ndarray | None) -> None:
        at_hand = {"response": solved, "deviation": weighed}
        vars(self).update({name: value for name, value in at_hand.items() if value is not None})

    @classmethod
    def read(
        cls,
        rotor: str | Path,
        vibration: str | Path,
        excitation: str | Path,
        *,
        unknowns: Sequence[CoefficientName],
        noise: NoiseModel,
        guess: Guess,
        known: str | Path | None = None,
        baseline: str | None = None,
        structure: Structure = "none",
        shared: bool = False,
        unbalance_planes: Sequence[int] = (),
        same_conditions: Mapping[str, float] | None = None,
    ) -> Measurement:
        """A measurement from files.

        Args:
            rotor: a rotor saved by ROSS (.toml, .json); its bearings say where the bearings stand.
            vibration: ``vibration.parquet`` or .csv, see :mod:`pipeline.data.vibration_files`.
            excitation: ``excitation.csv``.
            unknowns: names such as ``kxx`` that are identified at every bearing.
            known: table of the other coefficients; not needed where all eight are unknown.
            baseline: the run of the machine as it was found, which is subtracted from the others.
            structure: ties between the coefficients of a bearing, see :mod:`pipeline.unknowns`.
            shared: all bearings have the same coefficients.
            unbalance_planes: nodes whose residual unbalance is identified too (loss ``response``).
            same_conditions: by how much operating conditions may differ and still be one, by name, SI.

        Raises DataError with the law that a file breaks.
        """
        from pipeline.config.rotor import RotorConfig
        from pipeline.data.coefficient_files import read_coefficients
        from pipeline.data.vibration_files import read_dataset
        from pipeline.rotor.stored import load_rotor

        model = load_rotor(RotorConfig(file=str(rotor)))
        dataset = read_dataset(Path(vibration), Path(excitation), model, baseline, same_conditions)
        nodes, asked = model.bearing_nodes, tie(tuple(unknowns), structure)
        others = tuple(name for name in COEFFICIENTS if name not in asked)
        if known is None and not others:
            nothing = np.zeros((len(nodes), len(dataset.speeds), len(COEFFICIENTS)))
            table = BearingTable(nodes, dataset.speeds, nothing, dataset.operating)
        else:
            path = Path(known or "known_coefficients.csv")
            table = read_coefficients(path, nodes, dataset.speeds, dict.fromkeys(nodes, others), dataset.operating)
        unknown = unknown_set(dict.fromkeys(nodes, asked), shared, tuple(unbalance_planes))
        return cls(model, dataset, table, noise, unknown, guess)

    @cached_property
    def baseline(self) -> np.ndarray:
        """(S, P, R) m that was taken off the readings; zero where nothing was."""
        taken = self.dataset.subtracted
        return np.zeros_like(self.dataset.displacement) if taken is None else taken

    @cached_property
    def deviation(self) -> np.ndarray:
        """(S, P, R) m, root mean square of each reading's noise, by the readings' sizes or by its levels; infinite
        where a run was not measured.
        """
        stated = self.deviation_of(self.dataset.displacement, self.baseline)
        return np.where(self.dataset.present[:, None], stated, np.inf)

    def deviation_of(
        self,
        displacement: np.ndarray,
        baseline: np.ndarray | float = 0.0,
        factor: np.ndarray | float = 1.0,
        alone: bool = False,
        least: float = 1e-15,
        runs: np.ndarray | slice = slice(None),
    ) -> np.ndarray:
        """(.., S, P, R) m of readings of another size of these ``runs``, that a ``baseline`` was taken off.

        ``factor`` (P,) is a channel's deviation over the stated one. ``alone`` leaves out what all readings of a record
        share. A reading of zero without additive noise would have none at all: it has the ``least``.
        """
        if self.drift:
            return np.asarray(np.broadcast_to(self.drift.deviation(), np.shape(displacement)))
        floor, stated = self.noise.floor_at(self.dataset.frequencies[:, runs]), self.dataset.noise
        size = self.noise.deviation(displacement, np.asarray(baseline), floor)
        if stated.any():
            size = np.where(stated[..., runs] > 0, stated[..., runs], size)
        size = size * np.asarray(factor)[..., None]
        record = 0.0 if alone else self.noise.record
        return np.asarray(np.maximum(np.hypot(size, record * np.abs(displacement)), least))

    @cached_property
    def equations(self) -> BearingEquations:
        """The equations at the bearings. Raises DataError where x or y is not measured at one."""
        return bearing_equations(self.rotor, self.dataset)

    @cached_property
    def residual(self) -> LinearResidual:
        """The residual in the unknowns. Raises as :attr:`equations`; IdentifiabilityError for a bearing at rest."""
        return linear_residual(self.equations, self.unknowns, self.known)

    def residual_root(self, bearings: BearingTable) -> np.ndarray:
        """(S, R, 2 B, P) N, of the covariance of the residual near the ``bearings``:
        :func:`pipeline.problem.noise.residual_root`.
        """
        return residual_root(self.rotor, self.dataset, bearings, self.deviation)

    @cached_property
    def _solved(self) -> SolvedRotor:
        stiffness, planes = self.guess.stiffness, self.unknowns.planes
        return SolvedRotor(self.rotor, self.dataset, stiffness, planes, self.parameters)

    @cached_property
    def response(self) -> ResponseEquations:
        """The response at the sensors, at the values of the model parameters."""
        return self._solved.response

    @property
    def variations(self) -> tuple[ResponseBlock, ...]:
        """The derivatives of the response's blocks by the model parameters, leading with T; empty without any."""
        return self._solved.variations

    @property
    def updated_rotor(self) -> RotorModel:
        """The rotor at the values of the model parameters."""
        return update_rotor(self.rotor, self.parameters) if self.parameters else self.rotor

    @property
    def updated_known(self) -> BearingTable:
        """The known coefficients at the values of the model parameters."""
        change = (self.known_variation @ self.parameter_values).swapaxes(0, 1)
        return replace(self.known, values=self.known.values + change)

    @property
    def known_variation(self) -> np.ndarray:
        """(S, B, 8, T) derivative of the known coefficients by the model parameters, N/m and N s/m."""
        return known_variation(self.parameters, self.known)

    @property
    def parameter_values(self) -> np.ndarray:
        """(T,) in prior deviations."""
        return np.array([parameter.value for parameter in self.parameters])

    def update(self, values: Sequence[float] | np.ndarray) -> Measurement:
        """The same with the response at other ``values`` (T,) of the model parameters, in prior deviations."""
        return replace(self, parameters=set_values(self.parameters, values))

    def as_stated(self) -> Measurement:
        """The same with rotor and weights at the values of the model parameters, as if they were stated so."""
        if not self.parameters:
            return self
        data = update_excitations(self.dataset, self.parameters)
        return replace(
            self, rotor=self.updated_rotor, dataset=data, known=self.updated_known, parameters=(), tolerances=()
        )

    def select(self, speeds: np.ndarray | None = None, runs: np.ndarray | None = None) -> Measurement:
        """The same at the ``speeds`` (mask or index) and for the ``runs`` (ascending indices); None for all."""
        keep = np.arange(len(self.dataset.speeds)) if speeds is None else speeds
        dataset = self.dataset.at(keep)
        return replace(
            self,
            dataset=dataset if runs is None else dataset.of_runs(runs),
            known=self.known.at(keep),
            drift=self.drift.select(keep, runs),
            solved=self.response.at(keep, runs),  # once for all of it
        )

    def of_channels(self, kept: Sequence[int]) -> Measurement:
        """The ``kept`` channels (indices) alone, with the response that they show to be solved anew."""
        weighed, noise = self.deviation[:, kept], self.noise.of_channels(kept)
        return replace(self, dataset=self.dataset.of_channels(kept), noise=noise, weighed=weighed, solved=None)

    def table(self, values: np.ndarray) -> BearingTable:
        """All eight coefficients, from unknowns (M, S, U), or constants (M, 1, U), and the known ones."""
        return self.known.with_unknowns(self.unknowns, values)

    def subtract_unbalance(self) -> Measurement:
        """The synchronous runs less the first of them: a residual unbalance, the same in all, cancels exactly.

        The first is that of each point. Without balance planes nothing is subtracted; a synchronous run that is single,
        or alone at its point, stays as it is. The model is as stated.
        """
        unknowns, data = replace(self.unknowns, planes=()), self.dataset
        turning = next((b.runs for b in self.response.blocks if b.unit_sensors.shape[-1] and len(b.runs) > 1), None)
        if turning is None:
            solved = replace(self.response, planes=())
            return replace(self, unknowns=unknowns, parameters=(), solved=solved)
        every, seen = np.arange(len(data.runs)), data.present[:, turning]
        first = turning[seen.argmax(axis=1)]  # (S,)
        turns = np.isin(every, turning) & (seen.sum(axis=1, keepdims=True) > 1)  # (S, R)
        left = data.present & ~(turns & (every == first[:, None]))
        rest = np.flatnonzero(left.any(axis=0))
        at_first, before = first[:, None, None], self.baseline
        taken = np.take_along_axis(data.displacement, at_first, axis=2)
        # Two runs with the same baseline differ by their readings themselves: the baseline cancels with its noise.
        read = np.where(turns[:, None], np.take_along_axis(before, at_first, axis=2) + taken, before)
        shown = np.where(left[:, None], data.displacement - taken * turns[:, None], 0.0)
        blocks = [_less_first(block, first, turns, rest) for block in self.response.blocks]
        return replace(
            self,
            dataset=replace(
                data.of_runs(rest), displacement=shown[..., rest], subtracted=read[..., rest], present=left[:, rest]
            ),
            drift=self.drift.select(np.arange(len(data.speeds)), rest),
            unknowns=unknowns,
            parameters=(),
            solved=replace(self.response, planes=(), blocks=tuple(b for b in blocks if len(b.runs))),
        )


def _less_first(block: ResponseBlock, first: np.ndarray, turns: np.ndarray, rest: np.ndarray) -> ResponseBlock:
    """The block without the run ``first`` (S,) of each point, which is subtracted from those that turn (S, R)."""
    keep, forced = np.isin(block.runs, rest), [block.forced_sensors, block.forced_bearings]
    if (less := turns[:, None, block.runs]).any():
        at = np.searchsorted(block.runs, first)[:, None, None]
        forced = [values - np.take_along_axis(values, at, axis=2) * less for values in forced]
    sensors, bearings = (values[..., keep] for values in forced)
    runs = np.searchsorted(rest, block.runs[keep])
    return replace(block, runs=runs, forced_sensors=sensors, forced_bearings=bearings)
