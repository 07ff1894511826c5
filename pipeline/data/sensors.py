"""Probes show the displacement along each of them, with runout, noise and quantisation."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from pipeline.data.dataset import DIRECTIONS, VibrationDataset, project_direction
from pipeline.data.noise import NoiseModel
from pipeline.data.simulate import add_noise

Channels = tuple[tuple[int, float], ...]


@dataclass(frozen=True)
class Sensors:
    """Probes of one kind. Sizes in m."""

    channels: Channels | None  # (node, angle in degrees); None for x and y at every node
    additive: float = 0.0  # root mean square of the complex noise
    multiplicative: float = 0.0  # share of the reading
    runout: float = 0.0
    quantisation: float = 0.0


def list_directions(nodes: tuple[int, ...]) -> Channels:
    """x and y at the nodes."""
    return tuple((node, angle) for node in nodes for angle in DIRECTIONS.values())


def project(dataset: VibrationDataset, channels: Channels) -> VibrationDataset:
    """The displacements along the channels, of a data set that has x and y at their nodes."""
    place = {channel: p for p, channel in enumerate(dataset.channels)}
    readings = []
    for node, angle in channels:
        shares = zip(project_direction(angle), DIRECTIONS.values(), strict=True)
        readings.append(sum(share * dataset.displacement[:, place[node, axis]] for share, axis in shares))
    return replace(dataset, channels=channels, displacement=np.stack(readings, axis=1))


def measure(dataset: VibrationDataset, sensors: Sensors, generator: np.random.Generator) -> VibrationDataset:
    """Return what the sensors read from a data set with x and y at every node."""
    seen = dataset if sensors.channels is None else project(dataset, sensors.channels)
    # Noise comes first from the generator: with other runout, the same noise.
    if sensors.additive or sensors.multiplicative:
        noise = NoiseModel(sensors.additive, sensors.multiplicative)
        seen = add_noise(seen, noise.deviation(seen.displacement), generator)
    readings = seen.displacement
    if sensors.runout:
        phase = generator.uniform(0, 2 * np.pi, len(seen.channels))
        turns = np.isclose(seen.frequencies, seen.speeds[:, None], rtol=1e-9)[:, None]
        readings = readings + sensors.runout * np.exp(1j * phase)[:, None] * turns
    if sensors.quantisation:
        step = sensors.quantisation
        readings = step * (np.round(readings.real / step) + 1j * np.round(readings.imag / step))
    return replace(seen, displacement=readings)
