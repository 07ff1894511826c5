"""Where the fit starts: weights that turn back by any angle."""

from __future__ import annotations

from dataclasses import replace
from functools import cache

import numpy as np
import pytest
from conftest import examples
from hypothesis import given
from hypothesis import strategies as st
from running import composed
from small_rig import SmallRig, small_rig, with_noise
from small_rotor import FITTED

from pipeline.identification.answer import conclude
from pipeline.identification.output_error_fit import OutputErrorFit, fit_output_error
from pipeline.identification.output_error_start import align_weights
from pipeline.identification.training import setup_of
from pipeline.problem.measurement import Measurement


@pytest.mark.slow
@given(st.floats(0.0, 2 * np.pi))
@examples(10)
def test_weights_turn_back_by_any_angle(angle: float) -> None:
    """Law: turned readings turn the start by as much, and leave it as far from the answer as it was."""
    rig = turned_rig()
    starts = [align_weights(turn(with_noise(rig), a)).parameter_values[0] * WIDE for a in (0.0, angle)]
    assert abs(np.angle(np.exp(1j * (starts[1] - starts[0] - angle)))) < 1e-9
    assert abs(starts[0]) < 1.0


@pytest.mark.slow
@pytest.mark.parametrize("degrees", [75, 180, 290])
def test_weights_turned_by_any_angle_end_at_the_same_answer(degrees: int) -> None:
    """Nobody wrote down where the tacho stands: bearings and loss are the same, whatever the angle."""
    rig, setup = turned_rig(), setup_of(composed(*FITTED))
    fits = [fit_output_error(turn(with_noise(rig), np.radians(d)), setup) for d in (0, degrees)]
    (here,), (there,) = (conclude(fit).parameters for fit in fits)
    apart = WIDE * (there.value - here.value) - np.radians(degrees)
    assert abs(np.angle(np.exp(1j * apart))) < 0.2 * WIDE * here.left
    values = [fit.problem.unknowns(fit.weights)[0][0, 0].numpy() for fit in fits]
    assert np.abs((values[1] - values[0]) / spread(fits[0])).max() < 0.1  # the angle's own prior pulls a little


def spread(fit: OutputErrorFit) -> np.ndarray:
    """(A,) deviations of the coefficients, which do not depend on the speed."""
    return np.asarray(fit.problem.unknown_deviation(fit.weights)[0, 0])


WIDE = 1.4
"""rad: prior deviation of the common angle."""


@cache
def turned_rig() -> SmallRig:
    """Eight conditions whose weights' angle is uncertain."""
    return small_rig(np.random.default_rng(5), 8, drift=5e-8, deviations={"weight_angle": WIDE})


def turn(measurement: Measurement, angle: float) -> Measurement:
    """All readings turned, as another place of the tacho would."""
    data = measurement.dataset
    turned = replace(data, displacement=data.displacement * np.exp(1j * angle))
    return replace(measurement, dataset=turned, solved=measurement.response)
