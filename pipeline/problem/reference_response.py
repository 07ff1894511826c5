"""The rotor on reference bearings, solved: what :mod:`pipeline.problem.response` starts from, and its derivatives.

Casings are places besides the bearings, where nothing changes until a support does.

With ``D X = right`` on the reference bearings, a parameter of the model moves what rows c show of the solution by
``c dX = (D'^-1 c')' (d right - dD X)``: one adjoint solution serves all parameters.

Legend: S speeds, P channels, R runs, B bearings and casings, N balance planes, T model parameters, n lateral DOF. SI
units.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace
from functools import cached_property, lru_cache
from typing import TYPE_CHECKING

import numpy as np

from pipeline.data.dataset import VibrationDataset, assemble_forces, group_runs, synchronous
from pipeline.parameters.geometry import bow_change, bow_force
from pipeline.parameters.kind import ModelParameter, turns_with_rotor
from pipeline.parameters.model import set_values, update_rotor
from pipeline.parameters.probes import runout, sensor_change, sensor_matrix
from pipeline.parameters.weights import force_changes, update_excitations
from pipeline.problem.response import ResponseBlock, ResponseEquations
from pipeline.rotor.dynamic_stiffness import BandedStiffness, banded, solve
from pipeline.rotor.interpolation import bearing_places
from pipeline.rotor.model import RotorModel, casing_dof, translation_dof

if TYPE_CHECKING:
    from scipy.sparse import csr_array

REFERENCE_LOSS = 1.0
"""Loss factor of the reference bearings, ``H0 = k (1 + j)``: so damped, they have no resonance that costs digits."""


def _split(
    runs: np.ndarray, frequencies: np.ndarray, n_planes: int, at_bearings: np.ndarray, at_sensors: np.ndarray
) -> ResponseBlock:
    """The block of responses (.., S, 2 B, R + N + 2 B) and (.., S, P, R + N + 2 B): of runs, planes, and bearings."""
    cuts = [len(runs), len(runs) + n_planes]
    forced_bearings, unit_bearings, receptance_bearings = np.split(at_bearings, cuts, axis=-1)
    forced_sensors, unit_sensors, receptance_sensors = np.split(at_sensors, cuts, axis=-1)
    return ResponseBlock(
        runs=runs,
        frequencies=frequencies,
        forced_sensors=forced_sensors,
        forced_bearings=forced_bearings,
        receptance_sensors=receptance_sensors,
        receptance_bearings=receptance_bearings,
        unit_sensors=unit_sensors,
        unit_bearings=unit_bearings,
    )


@dataclass(frozen=True, eq=False)
class SolvedRotor:
    """A rotor on reference bearings, at the values of the model parameters, and its derivatives by them there.

    Bearings are not varied here: they follow from their coefficients. Raises PipelineError where the rotor has no
    response.
    """

    stated: RotorModel
    dataset: VibrationDataset  # its weights and probes as they are stated
    stiffness: float  # N/m, any value of the bearings' order
    planes: tuple[int, ...] = ()  # N
    parameters: tuple[ModelParameter, ...] = ()  # T

    @property
    def _reference(self) -> complex:
        return self.stiffness * (1 + 1j * REFERENCE_LOSS)

    @cached_property
    def _rotor(self) -> RotorModel:
        return update_rotor(self.stated, self.parameters) if self.parameters else self.stated

    @cached_property
    def _data(self) -> VibrationDataset:
        return update_excitations(self.dataset, self.parameters)

    @cached_property
    def _sensors(self) -> np.ndarray:
        """(P, n) what the channels show."""
        return sensor_matrix(self._data, self._rotor, self.parameters)

    @cached_property
    def _system(self) -> BandedStiffness:
        return banded(self._rotor)

    def _solve(self, w: np.ndarray, speeds: np.ndarray, right: np.ndarray, transposed: bool = False) -> np.ndarray:
        """(V, n, ..) of sides ``right`` (V, n, ..) at frequencies ``w`` and ``speeds`` (V,) rad/s."""
        places = bearing_places(self._rotor)
        impedance = np.broadcast_to(self._reference * np.eye(2), (len(places.dof), len(speeds), 2, 2))
        return solve(self._system, w, speeds, right, places.spread(impedance), places.dof, transposed)

    @cached_property
    def _blocks(self) -> tuple[tuple[np.ndarray, np.ndarray, int, np.ndarray], ...]:
        """Runs (indices) that share their frequencies (S,) rad/s, each block of them on reference bearings.

        With them how many planes N count, 0 where the runs are not synchronous, and the response (S, n, R + N + 2 B) of
        the forces, of 1 kg m at each plane, of 1 N at each bearing. Each run's own response is at its own frequencies.

        Runs that turn with the rotor are one block, though each has a speed of its own. What the weights do on the
        reference bearings is that of the run's own speed; what other bearings change of it is that of the mean. The
        error is of first order in the departure, times the amplification: under 3 % of the response for records within
        0.5 %.
        """
        rotor, dataset = self._rotor, self._data
        speeds, frequencies = dataset.speeds, dataset.frequencies
        held = np.eye(rotor.n_dof)[:, casing_dof(rotor).ravel()]
        loads = np.hstack([bearing_places(rotor).loads(rotor.n_dof), held])
        forces = assemble_forces(rotor, dataset.excitations, dataset.runs, frequencies)
        forces = forces + bow_force(self.parameters, self.stated)[:, None] * turns_with_rotor(dataset)
        blocks = []
        for runs, w in _group_turning(dataset):
            planes = self.planes if synchronous(w, speeds).all() else ()
            width = len(runs) + len(planes) + loads.shape[1]
            right = np.zeros((len(speeds), rotor.n_dof, width), dtype=complex)
            right[..., : len(runs)] = forces[..., runs]
            for n, node in enumerate(planes):
                right[:, translation_dof(node, 0), len(runs) + n] = w**2
                right[:, translation_dof(node, 1), len(runs) + n] = -1j * w**2
            right[..., len(runs) + len(planes) :] = loads
            response = self._solve(w, speeds, right)
            apart = np.flatnonzero((frequencies[:, runs] != w[:, None]).any(axis=0))
            if len(apart):  # (S, r) systems of one right side each, as (S r,)
                alone = self._solve(
                    frequencies[:, runs[apart]].ravel(),
                    np.repeat(speeds, len(apart)),
                    right[..., apart].swapaxes(1, 2).reshape(-1, rotor.n_dof, 1),
                )
                response[..., apart] = alone.reshape(len(speeds), len(apart), -1).swapaxes(1, 2)
            blocks.append((runs, w, len(planes), response))
        return tuple(blocks)

    @cached_property
    def response(self) -> ResponseEquations:
        """What the probes show."""
        places, ground = bearing_places(self._rotor), casing_dof(self._rotor).ravel()
        blocks = tuple(
            _split(runs, w, count, np.concatenate([places.show(x), x[:, ground]], axis=1), self._sensors @ x)
            for runs, w, count, x in self._blocks
        )
        solved = ResponseEquations(self.stated.bearing_nodes, self.dataset.speeds, self._reference, self.planes, blocks)
        return solved.shifted(runout(self.parameters, self._data))

    @cached_property
    def variations(self) -> tuple[ResponseBlock, ...]:
        """The derivatives of every block by the parameters, leading with T; empty without parameters."""
        if not self.parameters:
            return ()
        rotor, sensors, speeds = self._rotor, self._sensors, self.dataset.speeds
        forces, turns = force_changes(self.parameters, self.stated, self.dataset), turns_with_rotor(self.dataset)
        rows, ground, blocks = bearing_places(rotor).loads(rotor.n_dof).T, casing_dof(rotor).ravel(), []
        shown = np.concatenate([rows, np.eye(rotor.n_dof)[ground], sensors])  # at bearings, at casings, and by probes
        count, right = len(rows) + len(ground), np.broadcast_to(shown.T, (len(speeds), *shown.T.shape))
        for runs, w, n_planes, solved in self._blocks:
            adjoint = self._solve(w, speeds, right, transposed=True).swapaxes(1, 2)  # (S, .., n)
            held, felt, forced = adjoint @ rows.T, rows @ solved, slice(0, len(runs))
            loaded = slice(solved.shape[-1] - count, solved.shape[-1] - len(ground))
            every = np.zeros((len(self.parameters), *adjoint.shape[:2], solved.shape[-1]), dtype=complex)
            for t, at, push in self._push(w, solved):
                every[t] += adjoint[..., at] @ push
            for parameter, force, variation in zip(self.parameters, forces, every, strict=True):
                if force is not None:
                    variation[..., forced] += adjoint @ force[..., runs]
                if (bent := bow_change(parameter, self.stated)) is not None:
                    variation[..., forced] += (adjoint @ bent)[..., None] * turns[runs]
                if parameter.row.derive_places:
                    # With the bearings' rows c on the matrices, D + c' H0 c has the derivative dc' H0 c + c' H0 dc.
                    slopes = parameter.deviation * parameter.row.derive_places(rotor, parameter.place)
                    turned = adjoint @ slopes.T
                    variation -= self._reference * (turned @ felt + held @ (slopes @ solved))
                    variation[..., loaded] += turned
                    variation[:, : len(rows)] += slopes @ solved  # the bearings' own motion
                if (seen := sensor_change(parameter, self.dataset, rotor, self.parameters)) is not None:
                    variation[:, count:] += seen @ solved
                # What the sensors show besides is none of the rotor's.
                if (vector := runout([replace(parameter, value=1.0)], self._data)).any():
                    variation[:, count:, forced] += vector[..., runs]
            blocks.append(_split(runs, w, n_planes, every[:, :, :count], every[:, :, count:]))
        return tuple(blocks)

    def _push(self, w: np.ndarray, solved: np.ndarray) -> Iterator[tuple[int, np.ndarray, np.ndarray]]:
        """``-dD X`` of each change of a matrix: its parameter, the rows (k,), and the force (S, k, ..) N on them."""
        factors = {
            "stiffness": 1 + 0 * w,
            "mass": -(w**2),
            "damping": 1j * w,
            "gyroscopic": 1j * w * self.dataset.speeds,
        }
        flat, nothing = np.moveaxis(solved, 1, 0).reshape(solved.shape[1], -1), np.zeros(len(self.parameters))
        for t, name, at, matrix in _list_changes(self.stated, set_values(self.parameters, nothing)):
            force = (matrix @ flat).reshape(len(at), len(w), -1).swapaxes(0, 1)
            yield t, at, -self.parameters[t].slope * factors[name][:, None, None] * force


def _group_turning(dataset: VibrationDataset) -> Iterator[tuple[np.ndarray, np.ndarray]]:
    """Runs (indices) that share their frequencies (S,) rad/s, and those that turn with the rotor at their mean."""
    frequencies, turning = dataset.frequencies, np.flatnonzero(turns_with_rotor(dataset))
    rest = np.arange(len(dataset.runs))
    if len(turning) > 0 and (frequencies[:, turning] != frequencies[:, turning[:1]]).any():
        rest = np.setdiff1d(rest, turning)
        yield turning, frequencies[:, turning].mean(axis=1)
    if len(rest):
        yield from ((rest[runs], w) for runs, w in group_runs(frequencies[:, rest]))


@lru_cache(maxsize=8)
def _list_changes(
    rotor: RotorModel, parameters: tuple[ModelParameter, ...]
) -> tuple[tuple[int, str, np.ndarray, csr_array], ...]:
    """Which parameter (its index) changes which matrix in which rows (k,), and by what (k, n), of one deviation."""
    from scipy.sparse import csr_array

    changes = []
    for t, parameter in enumerate(parameters):
        for name, change in parameter.row.rotor(parameter, rotor).items():
            if len(at := np.flatnonzero(change.any(axis=1))):
                changes.append((t, name, at, csr_array(change[at])))
    return tuple(changes)
