"""What a fit leaves over: the mismatch, the size by repeats, and what was held out."""

from __future__ import annotations

import json
from dataclasses import make_dataclass
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from scipy.stats import chi2

from pipeline.identification.quality import _held_out, mismatch


def test_repeats_judge_the_size_of_what_is_left_over() -> None:
    """Noise from n repeats is itself uncertain: the same excess says less, and much says the same."""
    stated, repeated = mismatch(1300.0, 1000, 0.0), mismatch(1300.0, 1000, 0.0, repeated=200)
    assert stated["chi_square"] < repeated["chi_square"] < 0.05
    assert mismatch(1050.0, 1000, 0.0, repeated=200)["chi_square"] > 0.05


def held_out(predicted: complex) -> Any:
    """Two readings of 1 that were not fitted, with a noise of a tenth of what is predicted."""
    data = SimpleNamespace(n_readings=2, displacement=np.ones((2, 1, 1)), present=np.ones((2, 1)))
    measurement = make_dataclass("Read", ["dataset", "noise", "baseline", "deviation_of"])(
        data, None, 0.0, lambda read, baseline, factor: 0.1 * np.abs(read)
    )
    problem = SimpleNamespace(displacement=lambda weights: np.full((2, 1, 1), predicted), measurement=measurement)
    problem.update = lambda weights: problem
    return problem


@pytest.mark.parametrize("far", [complex("inf"), complex("nan"), 1e200 + 0j])
def test_a_prediction_beyond_all_bounds_is_null_in_json(far: complex) -> None:
    """A range that was held out, where coefficients are exponentials of functions that nothing holds there."""
    fit: Any = SimpleNamespace(weights=None, factor=np.ones(1), problem=held_out(far))
    assert json.loads(json.dumps(_held_out(fit, held_out(far)), allow_nan=False))["error_percent"] is None
    assert _held_out(fit, held_out(1.1 + 0j))["error_percent"] == pytest.approx(10.0)


def test_the_mismatch_test_is_that_of_the_distributions() -> None:
    """Medians of chi-square and of the normal distribution; estimated noise leaves the order alone to judge."""
    found = mismatch(float(chi2.median(200)), 200, 0.0)
    assert found == pytest.approx({"chi_square": 0.5, "whiteness": 0.5, "probability": 1.0})
    assert mismatch(None, 200, 1.6449) == {
        "chi_square": None,
        "whiteness": pytest.approx(0.05, abs=1e-4),
        "probability": pytest.approx(0.05, abs=1e-4),
    }
