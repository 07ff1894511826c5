"""What probes make of motion: runout less slow roll, and noise."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from parameters.test_as_built import small
from parameters.test_ground import WEIGHTS

from pipeline.data.dataset import DIRECTIONS, VibrationDataset
from pipeline.data.sensors import NoiseModel, Sensors, measure
from pipeline.problem.configured import configure_sensors, model_machine


def test_slow_roll_takes_the_runout_off_but_for_the_noise_of_its_reading() -> None:
    """What is left is the same at every speed and in every run, as large as the floor, the share and the steps."""
    config = small()
    rotor, _, complete = model_machine(config)
    sensors = replace(configure_sensors(config, rotor), quantisation=0.0)
    exact = measure(complete, replace(sensors, runout=0.0, slow_roll_readings=0), np.random.default_rng(1))
    raw = measure(complete, replace(sensors, slow_roll_readings=0), np.random.default_rng(1))
    assert np.abs(raw.displacement - exact.displacement) == pytest.approx(5e-6)
    left = []
    for seed in range(50):
        exact = measure(complete, replace(sensors, runout=0.0, slow_roll_readings=0), np.random.default_rng(seed))
        found = measure(complete, sensors, np.random.default_rng(seed)).displacement - exact.displacement
        assert found == pytest.approx(np.broadcast_to(found[:1, :, :1], found.shape), abs=1e-18)
        left.append(found[0, :, 0])
    size = np.hypot(sensors.noise.additive, sensors.noise.multiplicative * sensors.runout)
    assert np.sqrt(np.mean(np.abs(left) ** 2)) == pytest.approx(size, rel=0.2)


CASINGS = tuple((node, angle) for node in (9, 10) for angle in DIRECTIONS.values())


FLOORS = ((0.0, 0.0, 0.02), (0.0, 1e-4, 0.0), (3e-7, 0.0, 0.0), (0.0, 0.0, 0.02))
"""Of the casings' x and y at both bearings: accelerometers, a velocity probe, and a probe that stands on the ground."""


def test_the_noise_of_a_simulated_probe_is_constant_in_what_it_measures() -> None:
    """(j w)^k V has the stated floor at every speed; the noise model has it over w^k."""
    speeds = np.linspace(100.0, 700.0, 4000)
    still = VibrationDataset(speeds, ("a",), CASINGS, np.zeros((4000, 4, 1), dtype=complex), WEIGHTS[:1])
    noise = NoiseModel(0.0, 0.0, floors=FLOORS)
    drawn = measure(still, Sensors(CASINGS, noise), np.random.default_rng(2)).displacement[..., 0]
    orders, sizes = np.argmax(FLOORS, axis=1), np.max(FLOORS, axis=1)
    for half in np.split(np.abs(drawn * speeds[:, None] ** orders) ** 2, 2):
        assert half.mean(axis=0) == pytest.approx(sizes**2, rel=0.1)
    assert noise.floor_at(speeds[:, None])[..., 0] == pytest.approx(sizes / speeds[:, None] ** orders)
