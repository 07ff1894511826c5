"""Probes show the displacement along each of them, with runout, noise and quantisation; the noise of a reading."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from pipeline.data.dataset import DIRECTIONS, VibrationDataset, synchronous
from pipeline.data.simulate import add_noise

NOMINAL_95 = 1.959964
"""Standard deviations to either side of a normal value, within which 95 of 100 lie."""
Floors = tuple[tuple[float, ...], ...]
"""m, m/s and m/s^2 of each channel: noise that is constant in a displacement, a velocity, and an acceleration."""
NO_FLOOR = (0.0, 0.0, 0.0)
FLOORS = (("additive_um", "um", 1e6), ("floor_mm_s", "mm/s", 1e3), ("floor_m_s2", "m/s^2", 1.0))
"""How summaries name them: key, unit and the factor of it."""


@dataclass(frozen=True)
class NoiseModel:
    """Circular noise of each measured complex displacement: a floor, and a share of the reading's size."""

    additive: float  # m, root mean square
    multiplicative: float  # share of the reading, root mean square
    drift: float = 0.0  # m, root mean square, of the records of a condition together where nothing estimates it
    record: float = 0.0  # standard deviation of a factor that all readings of a run at a speed share
    floors: Floors = ()  # of each channel beside additive; none: 0

    def with_drift(self) -> NoiseModel:
        """The noise of conditions that are too few to tell their drift: it counts as noise of each reading."""
        return replace(self, additive=float(np.hypot(self.additive, self.drift)), drift=0.0)

    def of_channels(self, kept: Sequence[int]) -> NoiseModel:
        """That of the ``kept`` channels (indices) alone."""
        return replace(self, floors=tuple(self.floors[p] for p in kept if self.floors))

    @property
    def floored(self) -> bool:
        """Whether a part of it is constant."""
        return self.additive > 0 or bool(np.any(self.floors))

    def with_floor(self, ratio: float) -> NoiseModel:
        """That whose floors are ``ratio`` times as large."""
        floors = tuple(map(tuple, (ratio * np.array(self.floors)).tolist()))
        return replace(self, additive=ratio * self.additive, floors=floors)

    def reshaped(self, ratio: float, readings: np.ndarray, beside: np.ndarray) -> NoiseModel:
        """The noise whose floors are ``ratio`` times as large beside the share, as large as this over the ``readings``
        m with their own floors ``beside``: in the mean of the deviations' logarithms.
        """
        other = self.with_floor(ratio).deviation(readings, beside=ratio * beside)
        size = float(np.exp(np.mean(np.log(self.deviation(readings, beside=beside) / other))))
        return replace(self.with_floor(ratio * size), multiplicative=self.multiplicative * size)

    def floor_at(self, frequencies: np.ndarray) -> np.ndarray:
        """(S, P or 1, R) m, the own floor of each channel at the ``frequencies`` (S, R) rad/s.

        Noise a of what a probe measures, U = (j w)^k V, is a / w^k of the displacement V.
        """
        sizes, w = np.array(self.floors or [NO_FLOOR]), frequencies[:, None]
        squares = [(sizes[:, k, None] / w**k) ** 2 for k in np.flatnonzero(sizes.any(axis=0))]
        return np.asarray(np.sqrt(sum(squares, np.zeros_like(w))))

    def deviation(
        self, displacement: np.ndarray, subtracted: np.ndarray | float = 0.0, beside: np.ndarray | float = 0.0
    ) -> np.ndarray:
        """(.., S, P, R) m, root mean square of the noise of each reading, whose channels have floors ``beside``.

        The noise of a baseline that was ``subtracted`` (zero where none was) is still there.
        """
        floor = np.hypot(self.additive, beside)
        read = np.hypot(floor, self.multiplicative * np.abs(displacement + subtracted))
        baseline = np.hypot(floor, self.multiplicative * np.abs(subtracted))
        return np.hypot(read, np.where(subtracted != 0, baseline, 0.0))


Channels = tuple[tuple[int, float], ...]


@dataclass(frozen=True)
class Sensors:
    """Probes of one kind, and what they add. Sizes in m."""

    channels: Channels | None  # (node, angle in degrees); None for x and y at every node
    noise: NoiseModel = NoiseModel(0.0, 0.0)
    runout: float = 0.0
    quantisation: float = 0.0
    slow_roll_readings: int = 0  # how many the runout is taken from, which is then subtracted


def name_channel(node: int, angle: float) -> tuple[int, float]:
    """The channel of a probe whose ``angle`` is in rad."""
    # An angle such as 45 deg is a text or a number of radians: rounded, it is 45 again.
    return node, round(float(np.degrees(angle)), 9) % 360.0


def list_directions(nodes: tuple[int, ...]) -> Channels:
    """x and y at the nodes."""
    return tuple((node, angle) for node in nodes for angle in DIRECTIONS.values())


def project(dataset: VibrationDataset, channels: Channels) -> VibrationDataset:
    """The displacements along the channels, of a data set that has x and y at their nodes."""
    readings = [dataset.project(node, angle) for node, angle in channels]
    return replace(dataset, channels=channels, displacement=np.stack(readings, axis=1))


def measure(dataset: VibrationDataset, sensors: Sensors, generator: np.random.Generator) -> VibrationDataset:
    """Return what the sensors read from a data set with x and y at every node."""
    seen = dataset if sensors.channels is None else project(dataset, sensors.channels)
    # Noise comes first from the generator: with other runout, the same noise.
    noise, floors = sensors.noise, sensors.noise.floor_at(seen.frequencies)
    if noise.floored or noise.multiplicative:
        seen = add_noise(seen, noise.deviation(seen.displacement, beside=floors), generator)
    turns = synchronous(seen.frequencies, seen.speeds[:, None])[:, None]
    runout = np.zeros(len(seen.channels), dtype=complex)
    if sensors.runout:
        runout = sensors.runout * np.exp(1j * generator.uniform(0, 2 * np.pi, len(seen.channels)))
    readings = _quantise(seen.displacement + runout[:, None] * turns, sensors.quantisation)
    if sensors.slow_roll_readings:  # without weights or shaker, so slowly that nothing vibrates: their mean
        parts = generator.standard_normal((2, sensors.slow_roll_readings, len(runout))) / np.sqrt(2.0)
        # No lower speed than the first is stated.
        deviation = noise.deviation(runout, beside=floors[0, :, 0])
        slow = _quantise(runout + deviation * (parts[0] + 1j * parts[1]), sensors.quantisation).mean(axis=0)
        readings = readings - slow[:, None] * turns
    return replace(seen, displacement=readings)


def _quantise(readings: np.ndarray, step: float) -> np.ndarray:
    return step * (np.round(readings.real / step) + 1j * np.round(readings.imag / step)) if step else readings
