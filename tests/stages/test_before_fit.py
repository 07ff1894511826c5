"""What is said before a fit: a condition that the model has no input for."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from small_rotor import small_machine

from pipeline.stages.before_fit import list_idle


@pytest.mark.slow
def test_a_condition_that_the_model_has_no_input_for_is_named() -> None:
    measurement, _ = small_machine((2e6, 0.0, 0.0, 1.2e6, 900.0, 0.0, 0.0, 600.0))
    count = len(measurement.dataset.speeds)
    operating = {"oil_temperature": np.linspace(310.0, 330.0, count), "load": np.full(count, 500.0)}
    warm = replace(measurement, dataset=replace(measurement.dataset, operating=operating))
    assert (list_idle("constant", warm), list_idle("network", warm)) == (["oil_temperature"], [])
