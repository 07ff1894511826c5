"""A run-up through a resonance: the rate is measured from the tacho, and the bias that it makes is told."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest
from conftest import assert_says
from measured_files import PROBES, rotating, tacho_of, write_hdf5
from reading import RPM, RUNS, waves, with_ingest

from pipeline.ingest.dataset import MeasuredRuns, read_measured_runs
from pipeline.sweep.bias import measure_bias, respond_to_ramp

SAMPLES = 4000.0  # Hz
CRITICAL, DAMPING = 1500.0, 0.03  # rpm, ratio


def measured(folder: Path, rate: float, **changes: Any) -> MeasuredRuns:
    """What is read of a run-up or run-down between 700 and 2500 rpm at ``rate`` rpm/s, its four probes alike."""
    first, last = (700.0, 2500.0) if rate > 0 else (2500.0, 700.0)
    t = np.arange(0, (last - first) / rate, 1 / SAMPLES)
    phi = 2 * np.pi * (first * t + rate * t**2 / 2) / 60 + 0.3
    vectors = 1e-5 * respond_to_ramp(CRITICAL * RPM, DAMPING, (first + rate * t) * RPM, rate * RPM)
    turned = {name: np.exp(-1j * np.radians(angle)) for name, (_, angle) in PROBES.items()}
    channels = {name: 8000.0 * rotating(turned[name] * vectors, phi) for name in PROBES} | {"tacho": tacho_of(phi, 8.0)}
    section = waves(
        runs=[RUNS[0] | {"file": str(write_hdf5(folder / "one.h5", channels))}],
        sample_rate=f"{SAMPLES} Hz",
        speeds={"start_rpm": 1000, "stop_rpm": 2300, "step_rpm": 20},
    )
    return read_measured_runs(with_ingest(section | changes).machine.recordings)


@pytest.mark.slow
@pytest.mark.parametrize("rate", [150.0, -150.0])
def test_a_fast_sweep_is_warned_of_with_its_bias(rate: float, tmp_path: Path) -> None:
    """The rate, the mode behind the swept peak, and what the peak is off."""
    found = measured(tmp_path, rate)
    bias = found.sweeps["one"]
    assert (bias.rate / RPM, bias.frequency / RPM, bias.damping, bias.peak_shift) == (
        pytest.approx(rate, rel=2e-3),
        pytest.approx(CRITICAL, rel=5e-3),
        pytest.approx(DAMPING, rel=0.1),
        pytest.approx(measure_bias(CRITICAL * RPM, DAMPING, rate * RPM, 0.01).peak_shift, rel=0.1),
    )
    assert_says(
        " ".join(found.notes),
        "run 'one' is no sequence of steady states: a sweep of 150 rpm/s reads the natural frequency of",
        f"too {'high' if rate > 0 else 'low'}",
    )


@pytest.mark.slow
def test_the_stated_lag_is_the_limit(tmp_path: Path) -> None:
    """The same sweep, where the configuration lets a peak lag by more than it does."""
    found = measured(tmp_path, 150.0, tracking={"most_lag": 0.1})
    assert 0.01 < found.sweeps["one"].peak_shift < 0.1
    assert not any("steady states" in note for note in found.notes)
