"""Measured vibration, and the forces that excited it.

Coefficients and gyroscopic terms belong to the rotor speed, the dynamics to the excitation frequency w; the two are
the same for unbalance (synchronous), and may differ for a shaker.

A point is what is set when a reading is taken: a speed, and operating conditions beside it (an oil temperature, a load)
where the data have some. So one speed may come more than once, each time at other conditions.

Legend: S operating points, R runs, P measured channels (a node and a direction each). SI and radians.
"""

from __future__ import annotations

import hashlib
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import Any, Literal

import numpy as np

from pipeline.errors import DataError
from pipeline.rotor.model import DOF_PER_NODE, RotorModel, translation_dof
from pipeline.units import RAD_S_PER_RPM

DIRECTIONS = {"x": 0.0, "y": 90.0}
"""Angle of a displacement's direction in degrees, from x towards y."""
SYNCHRONOUS = 0.01
"""A run turns with the rotor where its frequency is within this share of the nominal speed: a speed is never held
exactly, and each record has its own."""
EVERYWHERE = np.ones((1, 1), dtype=bool)
"""Every run was measured at every point."""
UNSTATED = np.zeros((1, 1, 1))
"""No reading states its own noise."""
Kind = Literal["unbalance", "force"]


@dataclass(frozen=True)
class Excitation:
    """A force that rotates with the shaft, acting in one run at one node."""

    run: str
    kind: Kind
    node: int
    magnitude: float  # kg m for an unbalance, N for a force
    phase: float  # rad
    whirl: Literal["forward", "backward"] = "forward"


@dataclass(frozen=True, eq=False)
class VibrationDataset:
    """Complex amplitudes Q of q(t) = Re(Q e^{jwt}), zero-to-peak, of every run, operating point and channel."""

    speeds: np.ndarray  # (S,) rad/s, ascending; of points with operating conditions, ascending at each of them
    runs: tuple[str, ...]  # R
    channels: tuple[tuple[int, float], ...]  # P of (node, angle of the direction in degrees, from x towards y)
    displacement: np.ndarray  # (S, P, R) complex, m
    excitations: tuple[Excitation, ...]
    own_frequencies: np.ndarray | None = None  # (S, R) rad/s; None where every run turns with the rotor
    subtracted: np.ndarray | None = None  # (S, P, R) m, the baseline that was taken off; its noise is still there
    conditions: tuple[str, ...] | None = None  # (R,) the condition that a run repeats; None where each is its own
    operating: Mapping[str, np.ndarray] = field(default_factory=dict)  # name -> (S,) SI, temperatures in K
    present: np.ndarray = field(default_factory=lambda: EVERYWHERE)  # (S, R) bool: which runs were measured where
    noise: np.ndarray = field(default_factory=lambda: UNSTATED)  # (S, P, R) m, rms of a reading's own; 0: as stated

    def __post_init__(self) -> None:
        shape = (len(self.speeds), len(self.runs))
        mask = EVERYWHERE if np.all(self.present) else self.present
        object.__setattr__(self, "present", np.broadcast_to(mask, shape))

    @property
    def channel_names(self) -> list[str]:
        """What each channel is called."""
        return [f"node {node} {name_direction(angle)}" for node, angle in self.channels]

    @property
    def complete(self) -> bool:
        """Whether every run was measured everywhere."""
        return bool(self.present.all())

    @cached_property
    def frequencies(self) -> np.ndarray:
        """(S, R) excitation frequencies w, rad/s."""
        if self.own_frequencies is not None:
            return self.own_frequencies
        return np.repeat(self.speeds[:, None], len(self.runs), axis=1)

    @cached_property
    def fingerprint(self) -> str:
        """Identity of the data: equal for equal numbers."""
        digest = hashlib.sha256(repr((self.runs, self.channels, self.excitations)).encode())
        if self.conditions:
            digest.update(repr(self.conditions).encode())
        digest.update(np.ascontiguousarray(self.speeds).tobytes())
        digest.update(np.ascontiguousarray(self.displacement).tobytes())
        arrays = (self.own_frequencies, self.subtracted, None if self.complete else self.present)
        for more in (*arrays, self.noise if self.noise.any() else None):
            if more is not None:
                digest.update(np.ascontiguousarray(more).tobytes())
        for name, values in self.operating.items():
            digest.update(name.encode() + np.ascontiguousarray(values).tobytes())
        return digest.hexdigest()[:16]

    def of_runs(self, runs: np.ndarray) -> VibrationDataset:
        """The ``runs`` (indices) alone."""
        names = tuple(self.runs[r] for r in runs)
        return self.at(
            slice(None),
            runs,
            runs=names,
            excitations=tuple(excitation for excitation in self.excitations if excitation.run in names),
            conditions=tuple(self.conditions[r] for r in runs) if self.conditions else None,
        )

    def at(
        self, speeds: np.ndarray | slice, where: np.ndarray | slice = slice(None), **beside: Any
    ) -> VibrationDataset:
        """The same at the points ``speeds`` (indices); of runs :meth:`of_runs`."""
        own, subtracted = self.own_frequencies, self.subtracted
        return replace(
            self,
            speeds=self.speeds[speeds],
            displacement=self.displacement[speeds][..., where],
            own_frequencies=None if own is None else own[speeds][:, where],
            subtracted=None if subtracted is None else subtracted[speeds][..., where],
            operating={name: values[speeds] for name, values in self.operating.items()},
            present=self.present[speeds][:, where],
            noise=self.noise[speeds][..., where] if self.noise.any() else UNSTATED,
            **beside,
        )

    def of_channels(self, kept: Sequence[int]) -> VibrationDataset:
        """The ``kept`` channels (indices) alone."""
        return replace(
            self,
            channels=tuple(self.channels[p] for p in kept),
            displacement=self.displacement[:, kept],
            subtracted=None if self.subtracted is None else self.subtracted[:, kept],
            noise=self.noise[:, kept] if self.noise.any() else UNSTATED,
        )

    @property
    def points(self) -> dict[str, np.ndarray]:
        """Name -> (S,) what the coefficients may depend on: ``speed`` in rad/s, and the operating conditions."""
        return {"speed": self.speeds, **self.operating}

    @property
    def readings(self) -> np.ndarray:
        """(n, P) complex, m: the displacements of every run and point that were measured."""
        return self.displacement.swapaxes(1, 2)[self.present]

    @property
    def n_readings(self) -> int:
        """How many complex numbers were measured."""
        return int(self.present.sum()) * len(self.channels)

    def excitation_of(self, run: int) -> tuple[Excitation, ...]:
        """What acts in the run of this index, without its name: equal for runs that repeat each other, if their
        frequencies are."""
        return tuple(replace(excitation, run="") for excitation in self.excitations if excitation.run == self.runs[run])

    def find_repeats(self, runs: np.ndarray) -> list[tuple[int, int]]:
        """Places among the ``runs`` (indices of one frequency) of each that repeats another, and of the last of these
        before it: by what acts in them.
        """
        pairs, last = [], dict[tuple[Excitation, ...], int]()
        for i, run in enumerate(runs):
            acting = self.excitation_of(int(run))
            if acting in last:
                pairs.append((i, last[acting]))
            last[acting] = i
        return pairs

    def sensor_matrix(self, rotor: RotorModel) -> np.ndarray:
        """(P, n) what each channel shows of the rotor's lateral DOF."""
        return np.stack([np.array(project_direction(angle)) @ rotor.show(node) for node, angle in self.channels])

    def shares(self, node: int, angle: float) -> np.ndarray:
        """(P,) what each channel adds to the reading of a probe in the direction ``angle`` (degrees): it alone where it
        is that probe, otherwise x and y of the ``node``.
        """
        probe = node, round(angle, 9) % 360.0
        both = {(node, axis): share for axis, share in zip(DIRECTIONS.values(), project_direction(angle), strict=True)}
        result = np.zeros(len(self.channels))
        for channel, share in ({probe: 1.0} if probe in self.channels else both).items():
            result[self.channels.index(channel)] = share
        return result

    def project(self, node: int, angle: float) -> np.ndarray:
        """(S, R) complex, m: what a probe in the direction ``angle`` (degrees) sees; see :meth:`shares`."""
        seen = [share * self.displacement[:, p] for p, share in enumerate(self.shares(node, angle)) if share]
        return np.asarray(sum(seen))

    @property
    def orbits(self) -> dict[int, np.ndarray]:
        """Node -> (S, 2, R) complex, m: x and y of every node whose probes tell both."""
        dof, resolution = self.resolution()
        pairs = [i for i, x in enumerate(dof[:-1]) if x % DOF_PER_NODE == 0 and dof[i + 1] == x + 1]
        return {int(dof[i]) // DOF_PER_NODE: resolution[[i, i + 1]] @ self.displacement for i in pairs}

    def resolution(self, span: float = 1e-6) -> tuple[np.ndarray, np.ndarray]:
        """Which lateral DOF the channels determine by themselves, (D,), and how, (D, P): ``q = resolution @ channels``.

        Probes of one node whose angles span the plane give its x and y, by least squares; a single one gives x or y if
        it looks along it, and nothing otherwise. Two look along the same line below an angle of the sine ``span``.
        """
        dof, rows = [], []
        for node in dict.fromkeys(node for node, _ in self.channels):
            probes = [p for p, (n, _) in enumerate(self.channels) if n == node]
            cosines = np.array([project_direction(self.channels[p][1]) for p in probes])
            inverse = np.linalg.pinv(cosines, rcond=span)
            for direction in range(2):
                if abs(inverse[direction] @ cosines[:, direction] - 1) < span:
                    dof.append(translation_dof(node, direction))
                    rows.append(np.zeros(len(self.channels)))
                    rows[-1][probes] = inverse[direction]
        return np.array(dof, dtype=int), np.array(rows).reshape(len(dof), len(self.channels))


def place_rows(
    speeds: np.ndarray,
    runs: tuple[str, ...],
    channels: tuple[tuple[int, float], ...],
    at: tuple[Any, Any, Any],
    readings: np.ndarray,
    excitations: tuple[Excitation, ...],
    frequencies: Sequence[float] | np.ndarray = (),
    noise: Sequence[float] | np.ndarray = (),
    **beside: Any,
) -> VibrationDataset:
    """The data set of rows whose ``readings`` (n,) or (n, P), complex, m, stand ``at`` these indices of the point, the
    channel and the run; what no row has was not measured.

    ``frequencies`` (n,) rad/s, where they are not the rotor's, and the ``noise`` of each reading, m, are of rows, too.
    """
    shape = len(speeds), len(channels), len(runs)
    displacement, present = np.zeros(shape, dtype=complex), np.zeros(shape[::2], dtype=bool)
    displacement[at], present[at[::2]] = readings, True
    if len(frequencies):
        beside["own_frequencies"] = np.repeat(speeds[:, None], len(runs), axis=1)
        beside["own_frequencies"][at[::2]] = frequencies
    if len(noise):
        beside["noise"] = np.zeros(shape)
        beside["noise"][at] = noise
    return VibrationDataset(speeds, runs, channels, displacement, excitations, present=present, **beside)


def project_direction(angle: float) -> tuple[float, float]:
    """Cosines with x and y of a direction in degrees, exact along the axes."""
    quarter, rest = divmod(angle, 90.0)
    if rest == 0.0:
        return ((1.0, 0.0), (0.0, 1.0), (-1.0, 0.0), (0.0, -1.0))[int(quarter) % 4]
    return float(np.cos(np.radians(angle))), float(np.sin(np.radians(angle)))


def name_direction(angle: float) -> str:
    """``x``, ``y``, or the angle in degrees."""
    return next((name for name, other in DIRECTIONS.items() if other == angle), f"{angle:g}")


def synchronous(frequencies: np.ndarray, speeds: np.ndarray) -> np.ndarray:
    """Mask, of their common shape: which ``frequencies`` belong to rotor ``speeds``, both rad/s."""
    return np.asarray(np.abs(frequencies - speeds) <= SYNCHRONOUS * speeds)


def require_synchronous(rotor: RotorModel, dataset: VibrationDataset) -> None:
    """Raise DataError for runs of their own frequency on a rotor whose bearings stand on supports, or have mass."""
    if rotor.supported_nodes and not synchronous(dataset.frequencies, dataset.speeds[:, None]).all():
        raise DataError(
            "runs must turn with the rotor where a bearing stands on a support (what the shaft feels of both depends "
            f"on the frequency), but that of node {rotor.supported_nodes[0]} does and a run has a frequency of its "
            "own: leave the run out, or the support"
        )


def subtract_baseline(dataset: VibrationDataset, baseline: str) -> VibrationDataset:
    """The other runs; those that turn with the rotor less the ``baseline``, and so less any residual unbalance.

    Raises DataError where another run was measured at a point and the baseline was not.
    """
    b = dataset.runs.index(baseline)
    alone = np.argwhere(dataset.present & ~dataset.present[:, [b]])
    if len(alone):
        rpm = dataset.speeds[alone[0][0]] / RAD_S_PER_RPM
        raise DataError(
            f"the baseline '{baseline}' must be measured at the speeds and conditions of the other runs, but at "
            f"{len(alone)} points it was not (the first: run '{dataset.runs[alone[0][1]]}', {rpm:g} rpm): say in "
            "same_conditions by how much conditions may differ, keep to the speeds that it has, or leave the baseline "
            "out and identify the residual unbalance (identify.unbalance_planes)"
        )
    if not dataset.complete:
        dataset = dataset.at(np.flatnonzero(np.delete(dataset.present, b, axis=1).any(axis=1)))
    rest = dataset.of_runs(np.delete(np.arange(len(dataset.runs)), b))
    turning = synchronous(rest.frequencies, rest.speeds[:, None]) & rest.present  # (S, R)
    subtracted = dataset.displacement[..., [b]] * turning[:, None]
    return replace(rest, displacement=rest.displacement - subtracted, subtracted=subtracted)


def group_runs(frequencies: np.ndarray) -> Iterator[tuple[np.ndarray, np.ndarray]]:
    """Runs that share their frequencies (S, R), as (indices of the runs, their frequencies (S,))."""
    if (frequencies == frequencies[:, :1]).all():  # as of unbalance; sorting them would take a while
        yield np.arange(frequencies.shape[1]), frequencies[:, 0]
        return
    columns, group = np.unique(frequencies, axis=1, return_inverse=True)
    for i in range(columns.shape[1]):
        yield np.flatnonzero(group.ravel() == i), columns[:, i]


def assemble_forces(
    rotor: RotorModel, excitations: tuple[Excitation, ...], runs: tuple[str, ...], frequencies: np.ndarray
) -> np.ndarray:
    """(S, n, R) complex forces in N at ``frequencies`` (S, R), or (S,) where they are the same in every run.

    An unbalance m e at phase p: F = w^2 m e e^{jp} [1, -j] on (x, y) of its node, the sign that ROSS uses
    (forward whirl); a backward whirl has [1, +j]. A rotating force has its magnitude in place of w^2 m e.
    """
    forces = np.zeros((len(frequencies), rotor.n_dof, len(runs)), dtype=complex)
    for excitation in excitations:
        run = runs.index(excitation.run)
        amplitude = excitation.magnitude * np.exp(1j * excitation.phase) * np.ones(len(frequencies))
        if excitation.kind == "unbalance":
            amplitude = amplitude * (frequencies if frequencies.ndim == 1 else frequencies[:, run]) ** 2
        quadrature = -1j if excitation.whirl == "forward" else 1j
        forces[:, translation_dof(excitation.node, 0), run] += amplitude
        forces[:, translation_dof(excitation.node, 1), run] += quadrature * amplitude
    return forces
