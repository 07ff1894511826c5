"""A rotor with one disc at three oil temperatures: coefficients that fall with the speed and with the temperature."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from small_rotor import small_machine

from pipeline.data.simulate import add_noise
from pipeline.problem.measurement import Measurement
from pipeline.rotor.bearing_table import BearingTable

CELSIUS = (45.0, 55.0, 65.0)
NOISE = 2e-8
SPEEDS = np.linspace(60.0, 260.0, 9)


def warm_bearings(speeds: np.ndarray, celsius: np.ndarray) -> BearingTable:
    """Direct coefficients over points (S,): rad/s and degrees Celsius."""
    viscosity = np.exp(-0.034 * (celsius - 55.0))
    values = np.zeros((2, len(speeds), 8))
    for c, (size, power) in {0: (2e6, 0.3), 3: (1.2e6, 0.3), 4: (900.0, -0.4), 7: (600.0, -0.4)}.items():
        values[..., c] = size * viscosity * (speeds / 150.0) ** power
    return BearingTable((0, 5), speeds, values, {"oil_temperature": celsius + 273.15})


def warm_machine(celsius: tuple[float, ...] = CELSIUS) -> tuple[Measurement, BearingTable]:
    """Readings at every speed of every temperature, and the bearings; the direct coefficients are unknown."""
    speeds, degrees = np.tile(SPEEDS, len(celsius)), np.repeat(celsius, len(SPEEDS))
    bearings = warm_bearings(speeds, degrees)
    made, _ = small_machine((1.0,) * 8, speeds=speeds)
    known = replace(bearings, values=np.zeros_like(bearings.values))
    blank = replace(made, dataset=replace(made.dataset, operating=bearings.operating), known=known)
    exact = replace(blank.dataset, displacement=blank.response.predict(bearings))
    deviation = np.full(exact.displacement.shape, NOISE)
    return replace(blank, dataset=add_noise(exact, deviation, np.random.default_rng(7))), bearings
