"""One sentence on whether the readings are explained, from what a fit left over."""

from __future__ import annotations

from typing import Any

import pytest

from pipeline.reporting.fit_tables import describe_quality, describe_verdicts
from pipeline.trust.misfit import describe_held_out, measure_misfit


def left_over(
    ratio: float = 1.0,
    probability: float | None = 0.5,
    correlation: float = 0.0,
    factor: float | None = None,
    by_size: float | None = None,
) -> dict[str, Any]:
    """``fit`` of ``training.json``."""
    fit: dict[str, Any] = {
        "chi_square": {"value": 100.0 * ratio, "expected": 100.0, "readings": 120, "numbers": 40},
        "whiteness": {"autocorrelation": correlation, "over_its_deviation": 0.0, "probability": probability},
        "mismatch": {"chi_square": by_size, "whiteness": probability, "probability": None},
        "bad_points": 0,
    }
    return fit if factor is None else fit | {"noise_factor": {"node 1 x": factor}}


@pytest.mark.parametrize(
    ("fit", "explained"),
    [
        (left_over(), True),
        (left_over(1.4, 1e-9), True),  # below the noise: the bands are wider by it
        (left_over(1.6, 1e-9), False),
        (left_over(1.6, 0.2), True),
        (left_over(9.0, 0.2), False),  # three times the noise, however white
        (left_over(float("nan"), 0.2), False),
        (left_over(1.0, 1e-9, 0.1, 1.0), True),
        (left_over(1.0, 1e-9, 0.6, 1.0), False),  # of estimated noise, neighbours tell what wanders
        (left_over(1.0, 1e-9, 0.9, 0.3), True),  # it wanders, and lies within the stated noise
        (left_over(1.0, 0.2, 0.0, 10.0), True),  # white noise that is larger than stated
        (left_over(1.0, 0.01, 0.0, 10.0), False),
        (left_over(1.6, 0.01, 0.0, 1.0, by_size=0.01), False),  # noise from repeats: the size counts
    ],
)
def test_when_the_readings_are_explained(fit: dict[str, Any], explained: bool) -> None:
    misfit = measure_misfit(fit)
    assert misfit.explained() is explained
    assert (misfit.contradiction is None) is explained
    assert ("do not explain" in misfit.sentence) is not explained
    # every page says the same, and none calls the coefficients well determined without it
    assert ("do not explain" in describe_quality({"fit": fit})) is not explained
    said = describe_verdicts({"fit": fit, "determined": {"by": "by this fit", "coefficients": {"1": {"kxx": CERTAIN}}}})
    assert ("were the model right" in said and "do not explain" in said) is not explained
    assert "kxx well determined" in said


CERTAIN = {
    "verdict": "well determined",
    "deviation_percent": 1.0,
    "not_determined_at_percent_of_speeds": 0.0,
    "not_determined": "",
}


def test_a_prediction_that_leaves_all_bounds_is_none() -> None:
    told = describe_held_out("held_out_speeds", {"error_percent": None, "mean_square_over_noise": None})
    assert "no prediction" in told
    assert describe_held_out("held_out_runs", {"error_percent": 0.234}) == "held-out runs predicted to 0.23 %"
