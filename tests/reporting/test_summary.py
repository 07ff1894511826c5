"""What the summary says of critical speeds and of stability."""

from __future__ import annotations

from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from pipeline.reporting.summary import describe_stability, list_critical_speeds
from pipeline.twin.modes import amplify, require_separation


def test_critically_damped_speeds_stand_apart() -> None:
    """Decrements of 0.42 and 10 have amplification factors of 7.5 and 0.59; API 617 asks no margin below 2.5."""
    speeds = SimpleNamespace(speeds=np.array([20.0, 100.0]) * np.pi)
    fit: Any = SimpleNamespace(answer=SimpleNamespace(measurement=SimpleNamespace(dataset=speeds)), state="")
    modes = {}
    for rpm, decrement in ((980.0, 10.0), (2362.1, 0.42)):
        factor, _ = amplify(decrement) or (None, 0.0)
        modes[str(rpm)] = {"rpm": rpm, "logarithmic_decrement": decrement, "rpm_std": 5.0} | {
            "separation_margin_required_percent": require_separation(factor, above=True)
        }
    assert list_critical_speeds(fit, {"critical_speeds": modes}) == (
        "2362.1 +- 5.0 rpm (logarithmic decrement 0.42), between 600 and 3000 rpm; "
        "critically damped (amplification factor below 2.5): 980.0 +- 5.0 rpm"
    )


@pytest.mark.parametrize(("deviation", "near"), [(0.0024, True), (0.0002, False)])
def test_a_stable_machine_whose_margin_may_be_zero_is_stable_as_identified(deviation: float, near: bool) -> None:
    least = {"smallest_logarithmic_decrement": 0.0006, "smallest_logarithmic_decrement_std": deviation}
    said = describe_stability({"verdict": "stable", "largest_growth": -1.0, "at_rpm": 2800.0} | least)
    assert [text in said for text in (" speeds as identified;", "rpm, within its band of zero")] == [near, near]
