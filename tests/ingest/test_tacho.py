"""Tacho pulses: between samples, through noise, at regular times, and a lock on the samples."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.interpolate import make_lsq_spline

from ingest.test_order_tracking import Shaft
from pipeline.ingest.tacho import find_pulses, fit_angle


def test_pulse_times_are_interpolated() -> None:
    """Edges of some samples: the crossing is found to a hundredth of a sample, rising and falling."""
    shaft = Shaft(5000.0, 1237.0, 1237.0, 3.0)
    notch = shaft.tacho(np.random.default_rng(1), edge=12.0)
    for edge, at in (("rising", 0.0), ("falling", 0.2)):
        turns = find_pulses(shaft.time, notch, edge, None, None, "x")[0] * 1237 / 60 + 0.1234 / (2 * np.pi) - at
        assert np.abs(turns - np.round(turns)).max() < 2e-3 / 10


def test_a_run_up_from_standstill_has_regular_pulses() -> None:
    """With constant acceleration from zero the first intervals shrink fast; none is taken for a missing pulse."""
    angle = fit_angle(np.sqrt(np.arange(1, 200) / 3.0), 1, "x")
    assert angle.speed(np.array([5.0]))[0] / (2 * np.pi) == pytest.approx(2 * 3.0 * 5.0, rel=1e-3)


def test_the_spline_is_that_which_qr_ranks_first(rng: np.random.Generator, monkeypatch: pytest.MonkeyPatch) -> None:
    """A speed that wanders needs some knots of many: normal equations choose the same, to the last bit."""
    pulses = np.arange(900) / 50 + 0.02 * np.sin(np.arange(900) / 60) + 1e-5 * rng.standard_normal(900)
    chosen = fit_angle(pulses, 1, "x").spline
    monkeypatch.setattr(
        "scipy.interpolate.make_lsq_spline", lambda *given, method, **named: make_lsq_spline(*given, **named)
    )
    np.testing.assert_array_equal(chosen.c, fit_angle(pulses, 1, "x").spline.c)


def test_noise_on_the_levels_makes_no_pulses(rng: np.random.Generator) -> None:
    shaft = Shaft(5000.0, 900.0, 900.0, 4.0)
    noisy = shaft.tacho(rng) + 0.4 * rng.standard_normal(len(shaft.time))
    assert len(find_pulses(shaft.time, noisy, "rising", None, None, "x")[0]) == 60


def test_a_locked_sharp_tacho_is_known_as_such(rng: np.random.Generator) -> None:
    """Sharp edges, always between the same two samples: half a sample for all of them together."""
    locked = Shaft(10000.0, 6000.0, 6000.0, 1.0)
    free = Shaft(10000.0, 5981.0, 5981.0, 1.0)
    found = [find_pulses(s.time, s.tacho(rng, 0.0), "rising", None, None, "x")[1] for s in (locked, free)]
    assert found == pytest.approx([0.5e-4, 0.0])
    assert find_pulses(locked.time, locked.tacho(rng, 15.0), "rising", None, None, "x")[1] == 0.0
