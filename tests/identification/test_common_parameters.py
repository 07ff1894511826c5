"""What all weights have in common, a bow and the places of bearings: schema, and whether a fit finds them."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from pydantic import ValidationError
from running import composed
from small_rotor import DIRECT, FITTED, NOISE, small_machine, with_weights

from pipeline.data.simulate import add_noise
from pipeline.identification.answer import conclude
from pipeline.identification.output_error_fit import fit_output_error
from pipeline.identification.training import setup_of
from pipeline.parameters.identify import ModelParametersConfig
from pipeline.parameters.model import ModelParameter, model_parameters


def test_tolerances_carry_their_units() -> None:
    """0.003 of a weight of 1 g mm is 3000 1/(kg m)."""
    given = {"weight_law": "0.003 / (g mm)", "bow": "10 um", "weight_angle": "20 deg", "bearing_position": "5 mm"}
    assert ModelParametersConfig.model_validate(given).deviations == pytest.approx(
        {"weight_law": 3000.0, "bow": 1e-5, "weight_angle": np.pi / 9, "bearing_position": 5e-3}
    )
    for kind, wrong in {"weight_law": "3 mm", "bow": "-1 um", "weight_angle": "100 deg", "bearing_position": 0}.items():
        with pytest.raises(ValidationError, match=kind):
            ModelParametersConfig.model_validate({kind: wrong})


@pytest.mark.slow
def test_a_fit_finds_what_all_weights_have_in_common_and_the_bow() -> None:
    """Weights of three sizes at two angles; the machine is off by a prior deviation and a half in each number."""
    measurement, bearings = small_machine(DIRECT)
    data = with_weights(measurement.dataset, ("a", 2e-4, 0.3), ("b", 5e-4, 2.0), ("c", 8e-4, 0.3), ("d", 3e-4, -2.0))
    deviations = {"weight_angle": 0.05, "weight_law": 100.0, "bow": 2e-6}
    parameters = (
        *model_parameters(deviations, measurement.rotor, data, bearings, measurement.unknowns),
        ModelParameter("bearing_position", 0.01, "node 0", 0),
    )
    stated = replace(measurement, dataset=data, parameters=parameters)
    truth = 1.5 * (-1.0) ** (np.arange(len(parameters)) + 1)
    exact = replace(data, displacement=stated.update(truth).response.predict(bearings))
    read = add_noise(exact, np.full(data.displacement.shape, NOISE), np.random.default_rng(3))
    found = fit_output_error(replace(stated, dataset=read), setup_of(composed(*FITTED)))
    for one, value in zip(conclude(found).parameters, truth, strict=True):
        assert abs(one.value - value) < 4 * one.left, one.name
        if one.kind != "bearing_position":
            assert one.left < 0.3, one.name
    table = found.identified.table(bearings).values[..., [0, 3]]
    assert table == pytest.approx(bearings.values[..., [0, 3]], rel=0.05)
