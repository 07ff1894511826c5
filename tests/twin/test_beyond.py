"""Critical speeds beyond the speeds of the data, against those of the machine as it is."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from running import composed
from small_rig import small_rig
from small_rotor import FITTED

from pipeline.errors import ConfigError
from pipeline.identification.output_error_fit import fit_output_error
from pipeline.identification.quality import output_error_quality
from pipeline.identification.training import setup_of
from pipeline.identification.uncertainty import measure_uncertainty
from pipeline.problem.condition_noise import condition_noise, to_dataset
from pipeline.rotor.bearing_table import BearingTable
from pipeline.twin.mode_deviations import expect_criticals
from pipeline.twin.modes import find_critical_speeds, find_modes

pytestmark = pytest.mark.slow  # a fit of two seconds
ABOVE = np.linspace(150.0, 420.0, 91)


def test_critical_speeds_above_the_data_lie_within_their_deviations() -> None:
    """Data at 110 and 135 rad/s; oracle: the modes of the true rotor on its true bearings, on the same grid."""
    deviations, off = {"disc_mass": 0.02, "youngs_modulus": 0.02}, np.array([0.7, -0.8])
    rig = small_rig(np.random.default_rng(21), 30, deviations=deviations, truth=off)
    measurement = replace(rig.template, dataset=to_dataset(rig.conditions), drift=condition_noise(rig.conditions))
    fit = fit_output_error(measurement, setup_of(composed(*FITTED)))
    uncertainty = measure_uncertainty(fit, output_error_quality(fit))
    at_fit = measurement.update(uncertainty.parameters)
    found = expect_criticals(at_fit, uncertainty, ABOVE)
    bearings = BearingTable((0, 5), ABOVE, np.repeat(rig.bearings.values[:, :1], len(ABOVE), axis=1))
    true = find_critical_speeds(find_modes(measurement.update(off).updated_rotor, bearings))
    assert len(found) == len(true) > 0
    for (one, (deviation, decrement_deviation)), other in zip(found, true, strict=True):
        assert abs(one.speed - other.speed) < 4 * deviation
        assert abs(one.logarithmic_decrement - other.logarithmic_decrement) < 4 * decrement_deviation
        assert 0 < deviation < 0.02 * one.speed
    stated = find_critical_speeds(find_modes(measurement.rotor, bearings))
    assert abs(stated[0].speed - true[0].speed) > 2 * found[0][1][0]  # what was stated would have been refused
    tilted = replace(at_fit.known, values=at_fit.known.values + np.array([0.0, 1e4])[None, :, None])
    with pytest.raises(ConfigError, match="do not depend on the speed"):
        expect_criticals(replace(at_fit, known=tilted), uncertainty, ABOVE)
    network = replace(fit.identified, model=replace(fit.identified.model, hidden=(4,)))
    with pytest.raises(ConfigError, match="model=constant"):
        expect_criticals(at_fit, replace(uncertainty, identified=network), ABOVE)
