"""A machine with two planes whose influence, law of weights and noise are known, and conditions drawn from it."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import pytest

from pipeline.data.conditions import Conditions
from pipeline.problem.noise_levels import NoiseLevels

SPEEDS, CHANNELS, PLANES = 2, 3, (4, 9)
SIZE = SPEEDS * CHANNELS
GRAM = 1e-6  # g mm in kg m
TAILS = [pytest.param(6.0, id="student"), pytest.param(None, id="gaussian", marks=pytest.mark.nightly)]
"""Degrees of freedom of what conditions scatter by; outliers of Student's t are the harder case."""


def circular(rng: np.random.Generator, *shape: int) -> np.ndarray:
    """Circular complex Gaussian numbers of unit variance."""
    return (rng.standard_normal(shape) + 1j * rng.standard_normal(shape)) / np.sqrt(2)


@dataclass(frozen=True, eq=False)
class Truth:
    """What conditions are drawn from."""

    baseline: np.ndarray  # (D,) m
    influence: np.ndarray  # (D, N) m/(kg m)
    root: np.ndarray  # (D, D) of the covariance of conditions, m
    law: complex = 0.0  # 1/(kg m)

    def mean(self, unbalance: np.ndarray) -> np.ndarray:
        """(C, D) m, of weights (C, N) kg m."""
        return self.baseline + (unbalance * (1 + self.law * abs(unbalance))) @ self.influence.T

    def draw(self, rng: np.random.Generator, n: int, tail: float | None = None) -> Conditions:
        """``n`` conditions with weights up to 60 g mm; ``tail`` are the degrees of freedom of a Student t."""
        unbalance = 60 * GRAM * rng.random((n, 2)) * np.exp(2j * np.pi * rng.random((n, 2)))
        unbalance[rng.random((n, 2)) < 0.3] = 0
        noise = circular(rng, n, SIZE) @ self.root.T
        if tail is not None:
            noise /= np.sqrt(rng.chisquare(tail, (n, 1)) / tail)
        return self.gather(unbalance, self.mean(unbalance) + noise)

    def gather(self, unbalance: np.ndarray, vectors: np.ndarray) -> Conditions:
        """Conditions of three records without scatter."""
        n = len(unbalance)
        return Conditions(
            names=tuple(f"C{c:03d}" for c in range(n)),
            speeds=np.array([100.0, 120.0]),
            own_speeds=np.tile([100.0, 120.0], (n, 1)),
            displacement=vectors.reshape(n, SPEEDS, CHANNELS),
            counts=np.full(n, 3),
            channels=((2, 0.0), (2, 90.0), (7, 0.0)),
            planes=PLANES,
            unbalance=unbalance,
            record_covariance=np.zeros((SPEEDS, CHANNELS, CHANNELS), dtype=complex),
        )


def truth(rng: np.random.Generator, law: complex = 0.0) -> Truth:
    """Influence of the order of 0.3 m/(kg m), noise of 0.2 um that is strongly correlated."""
    root = 2e-7 * (circular(rng, SIZE, 2) @ circular(rng, 2, SIZE) + 0.3 * circular(rng, SIZE, SIZE))
    return Truth(5e-6 * circular(rng, SIZE), 0.3 * circular(rng, SIZE, 2), root, law)


@dataclass(frozen=True, eq=False)
class KnownVibration:
    """A :class:`pipeline.balance.linear_vibration.LinearVibration` that knows the truth."""

    truth: Truth
    speeds: np.ndarray
    channels: tuple[tuple[int, float], ...]
    planes: tuple[int, ...]
    noise: NoiseLevels

    def predict(self, unbalance: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Exact."""
        mean = self.truth.mean(unbalance)
        return mean, np.zeros((len(mean), SIZE, SIZE), dtype=complex)

    def influence_at(self, unbalance: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """The same everywhere."""
        return self.truth.influence, self.truth.baseline


def know(truth: Truth) -> KnownVibration:
    """The model that is the truth, with its noise."""
    some = truth.gather(np.zeros((1, 2), dtype=complex), np.zeros((1, SIZE), dtype=complex))
    noise = NoiseLevels(some.record_covariance, truth.root @ truth.root.conj().T, np.inf)
    return KnownVibration(truth, some.speeds, some.channels, some.planes, noise)
