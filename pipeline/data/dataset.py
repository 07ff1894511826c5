"""What was measured and what excited it.

Coefficients and gyroscopic terms belong to the rotor speed, the dynamics to the excitation frequency w; the two are
the same for unbalance (synchronous), and may differ for a shaker.

Legend: S speeds, R runs, P measured channels (a node and a direction each). SI and radians.
"""

from __future__ import annotations

import hashlib
from collections.abc import Iterator
from dataclasses import dataclass
from functools import cached_property
from typing import Literal

import numpy as np

from pipeline.rotor.model import RotorModel, translation_dof

DIRECTIONS = ("x", "y")
Kind = Literal["unbalance", "force"]
Whirl = Literal["forward", "backward"]


@dataclass(frozen=True)
class Excitation:
    """A force that rotates with the shaft, acting in one run at one node."""

    run: str
    kind: Kind
    node: int
    magnitude: float  # kg m for an unbalance, N for a force
    phase: float  # rad
    whirl: Whirl = "forward"


@dataclass(frozen=True, eq=False)
class VibrationDataset:
    """Complex amplitudes Q of q(t) = Re(Q e^{jwt}), zero-to-peak, of every run, speed and channel."""

    speeds: np.ndarray  # (S,) rad/s, ascending
    runs: tuple[str, ...]  # R
    channels: tuple[tuple[int, int], ...]  # P of (node, direction), direction 0 for x, 1 for y
    displacement: np.ndarray  # (S, P, R) complex, m
    excitations: tuple[Excitation, ...]
    own_frequencies: np.ndarray | None = None  # (S, R) rad/s; None where every run turns with the rotor

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
        digest.update(np.ascontiguousarray(self.speeds).tobytes())
        digest.update(np.ascontiguousarray(self.displacement).tobytes())
        if self.own_frequencies is not None:
            digest.update(np.ascontiguousarray(self.own_frequencies).tobytes())
        return digest.hexdigest()[:16]

    def measured_dof(self) -> np.ndarray:
        """(P,) index of each channel among the rotor's lateral DOF."""
        return np.array([translation_dof(node, direction) for node, direction in self.channels])


def runs_by_frequency(frequencies: np.ndarray) -> Iterator[tuple[np.ndarray, np.ndarray]]:
    """Runs that share their frequencies (S, R), as (indices of the runs, their frequencies (S,))."""
    columns, of = np.unique(frequencies, axis=1, return_inverse=True)
    for i in range(columns.shape[1]):
        yield np.flatnonzero(of.ravel() == i), columns[:, i]


def force_vectors(
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
