"""The full spectrum of two probes, of a circle in closed form."""

from __future__ import annotations

import numpy as np
import pytest

from pipeline.config.measured import MeasuredProbeConfig
from pipeline.ingest.full_spectrum import measure_full_spectra
from pipeline.ingest.order_tracking import Signals
from pipeline.ingest.tacho import fit_angle


@pytest.mark.parametrize("sense", [1, -1])
def test_a_circle_is_one_line_of_the_full_spectrum(sense: int) -> None:
    """A circle of 3 um with the rotor is order +1, against it -1; the mean position is that of the probes."""
    time, hertz = np.arange(0.0, 4.0, 1 / 4000), 40.0
    turn = np.exp(2j * np.pi * sense * hertz * time)
    x, y = 3e-6 * turn.real + 5e-6, 3e-6 * turn.imag - 2e-6
    probes = {
        "left": MeasuredProbeConfig(node=1, angle="135 deg"),
        "right": MeasuredProbeConfig(node=1, angle="45 deg"),
    }
    seen = np.stack([x * np.cos(p.angle) + y * np.sin(p.angle) for p in probes.values()], axis=1)
    angle = fit_angle(np.arange(0.0, 3.99, 1 / hertz), 1, "here")
    found = measure_full_spectra([Signals(time, seen, angle, "here")], probes, 1)
    assert found.speeds == pytest.approx(np.full(len(found.speeds), 2 * np.pi * hertz), rel=1e-3)
    largest = found.spectrum.argmax(axis=1)
    assert found.orders[largest] == pytest.approx(np.full(len(largest), float(sense)))
    assert found.spectrum.max(axis=1) == pytest.approx(np.full(len(largest), 3e-6), rel=1e-3)
    assert found.spectrum[:, np.argmin(np.abs(found.orders + sense))].max() < 1e-9
    assert found.centre == pytest.approx(np.tile([5e-6, -2e-6], (len(found.centre), 1)), rel=1e-3)
