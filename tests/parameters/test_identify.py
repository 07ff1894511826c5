"""The section of uncertain numbers: tolerances carry their units."""

from __future__ import annotations

import numpy as np
import pytest
from pydantic import ValidationError

from pipeline.parameters.identify import ModelParametersConfig


def test_tolerances_carry_their_units() -> None:
    """0.003 of a weight of 1 g mm is 3000 1/(kg m)."""
    given = {"weight_law": "0.003 / (g mm)", "bow": "10 um", "weight_angle": "20 deg", "bearing_position": "5 mm"}
    assert ModelParametersConfig.model_validate(given).deviations == pytest.approx(
        {"weight_law": 3000.0, "bow": 1e-5, "weight_angle": np.pi / 9, "bearing_position": 5e-3}
    )
    for kind, wrong in {"weight_law": "3 mm", "bow": "-1 um", "weight_angle": "100 deg", "bearing_position": 0}.items():
        with pytest.raises(ValidationError, match=kind):
            ModelParametersConfig.model_validate({kind: wrong})
