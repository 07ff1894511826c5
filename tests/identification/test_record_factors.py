"""A factor of each record, and of each label of weights: against a dense covariance, and what fits make of them."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from running import composed
from small_rotor import DIRECT, FITTED, NOISE, small_machine, with_weights

from pipeline.config.runs import NoiseConfig
from pipeline.data.sensors import NoiseModel
from pipeline.data.simulate import add_noise
from pipeline.errors import ConfigError
from pipeline.identification.answer import conclude
from pipeline.identification.output_error_fit import fit_output_error
from pipeline.identification.quality import output_error_quality
from pipeline.identification.training import setup_of
from pipeline.parameters.model import model_parameters
from pipeline.problem.configured import build_measurement
from pipeline.problem.measurement import Measurement
from pipeline.rotor.bearing_table import BearingTable

SHARED = 0.2


def scattered(**deviations: float) -> tuple[Measurement, BearingTable]:
    """Four weights of two labels, one of which is 10 % and 6 degrees off; each record has a factor of its own."""
    measurement, bearings = small_machine(DIRECT, speeds=np.linspace(60.0, 260.0, 40))
    data = with_weights(measurement.dataset, ("a", 2e-4, 0.3), ("b", 2e-4, 2.0), ("c", 8e-4, 0.3), ("d", 8e-4, -2.0))
    labels = model_parameters(
        {"label_gain": 0.1, "label_angle": 0.1}, measurement.rotor, data, bearings, measurement.unknowns
    )
    off = replace(measurement, dataset=data, parameters=labels).update(np.array([0.0, np.log(1.1) / 0.1, 0.0, 1.0]))
    read = off.response.predict(bearings) * (1 + SHARED * np.random.default_rng(8).standard_normal((40, 1, 4)))
    read = add_noise(replace(data, displacement=read), np.full(read.shape, NOISE), np.random.default_rng(3))
    parameters = model_parameters(deviations, measurement.rotor, data, bearings, measurement.unknowns)
    noise = NoiseModel(NOISE, 0.0, record=SHARED)
    return replace(measurement, dataset=read, parameters=parameters, noise=noise), bearings


@pytest.mark.slow
def test_factors_of_records_are_eliminated_and_those_of_labels_are_told() -> None:
    """Rows against the dense covariance of each record; numbers within their bands, which are those of the draws."""
    measurement, bearings = scattered(label_gain=0.2, label_angle=0.2)
    # Without a factor of all weights, whose gain the known masses tell, both labels have their own.
    fit = fit_output_error(measurement, setup_of(composed(*FITTED)))
    quality, answer = output_error_quality(fit), conclude(fit)
    assert quality.misfit == pytest.approx(1.0, abs=0.15)
    for number, true in zip(answer.parameters, [0.0, np.log(1.1), 0.0, 0.1], strict=True):
        assert abs(0.2 * number.value - true) < 3.5 * 0.2 * number.left, number.name
        assert number.left < 0.5
    direct = fit.identified.table(bearings).values[..., [0, 3]]
    assert direct == pytest.approx(bearings.values[..., [0, 3]], rel=0.05)

    problem, read = fit.problem, fit.problem.displacement(fit.weights)
    (off,), (share,) = problem.deviations(fit.weights), problem.readings.shares
    square = (off[0].abs().numpy() ** 2).sum(axis=1)
    determinant = 0.0
    for s, r in np.ndindex(square.shape):
        mean, own = read[s, :, r], NOISE / np.sqrt(2 * share[0, s, :, r])
        both = np.concatenate([mean.real, mean.imag])
        dense = np.diag(np.tile(own**2, 2)) + SHARED**2 * np.outer(both, both)
        left = mean - measurement.dataset.displacement[s, :, r]
        left = np.concatenate([left.real, left.imag])
        assert square[s, r] == pytest.approx(left @ np.linalg.solve(dense, left), rel=2e-3)
        determinant += np.linalg.slogdet(dense)[1]
    assert problem.readings.log_determinant() == pytest.approx(determinant, rel=1e-5)


def test_a_record_of_which_a_baseline_was_taken_off_is_refused() -> None:
    """A reading and its baseline have factors of their own."""
    measurement, bearings = scattered()
    taken = replace(measurement.dataset, subtracted=np.ones_like(measurement.dataset.displacement))
    noise = {"stated_noise": NoiseConfig(additive=NOISE, multiplicative=0.0, record=SHARED)}
    with pytest.raises(ConfigError, match=r"stated_noise\.record must be 0 where a baseline"):
        build_measurement(composed(*FITTED).model_copy(update=noise), measurement.rotor, taken, bearings)
