"""The levitated rotor: responses to a sweep against a closed form, the table's modes, and what a bearing carries."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pandas as pd
import pytest
from frequency_responses import LINES, RATE, Lines, respond
from levitated import RIG, STATED, build_machine, fit_bands, read, weigh_modes

from pipeline.parameters.model import ModelParameter, update_rotor
from pipeline.sweep.bias import respond_steadily


@pytest.mark.parametrize(("lines", "mode"), [(LINES[0], (16.3, 0.006)), (LINES[1], (100.4, 0.016))])
def test_a_response_has_neither_harmonics_nor_noise(lines: Lines, mode: tuple[float, float]) -> None:
    """Errors of a mode's closed form over deviations are about one, with a second harmonic and noise in the signal."""
    time = np.arange(round(16 * RATE)) / RATE
    drive = np.sin(np.pi * 500 / 16 * time**2)
    driven = np.fft.rfft(drive) * respond_steadily(*mode, np.fft.rfftfreq(len(time), 1 / RATE))
    signal = np.fft.irfft(driven) + 0.5 * drive**2 + np.random.default_rng(3).standard_normal(len(time))
    hz, response, deviation = respond(drive, signal[:, None], lines)
    off = np.linalg.norm(response[:, 0] - respond_steadily(*mode, hz))
    assert 0.7 < off / np.linalg.norm(deviation) / np.sqrt(2) < 1.4


@pytest.mark.slow
def test_the_modes_are_those_that_the_authors_read() -> None:
    """Within 2 %, each with a band."""
    modes = fit_bands(read(pd.read_csv(RIG / "frequency_responses.csv")))
    assert [modes[mode]["hz"] for mode in STATED.values()] == pytest.approx(list(STATED), rel=0.02)
    assert all(mode["hz_deviation"] < 0.005 * mode["hz"] for mode in modes)
    assert all(mode["damping_deviation"] < mode["damping_ratio"] for mode in modes)


SPREAD = {"hz_deviation": 0.2, "damping_ratio": 0.02, "damping_deviation": 0.002}
MODES = [{"hz": hz} | SPREAD for hz in (16.4, 52.0, 55.0, 74.0, 105.0, 170.0, 204.0, 212.0)]


def test_half_the_mass_is_that_of_a_rigid_shaft_alone() -> None:
    """On a rigid shaft, each bearing carries half of the rotor; on this one, a disc and a piece of shaft."""
    machine = build_machine(MODES)
    stiff = update_rotor(machine.rotor, [ModelParameter("youngs_modulus", 1e5, "", value=1.0)])
    rigid, soft = (weigh_modes(rotor, np.full(2, 1e5)) for rotor in (stiff, machine.rotor))
    assert rigid[0]["mass_at_bearings"] == pytest.approx(machine.rotor.total_mass / 2, rel=1e-3)
    assert rigid[0]["shaft_share"] == pytest.approx(0, abs=1e-3)
    assert soft[0]["shaft_share"] > 0.9
    assert all(0.85 < mode["mass_at_bearings"] < 1.05 for mode in soft[1:])


@pytest.mark.slow
def test_the_bearings_of_a_machine_are_its_answer() -> None:
    """Frequencies and damping of known bearings give these back."""
    machine, stated = build_machine(MODES), np.array([1.15e5, 0.95e5, 40.0, 15.0])
    hz, damping = machine.modes(np.concatenate([np.log(stated), np.zeros(len(machine.tolerances))]))
    x, covariance, _ = replace(machine, hz=hz, damping=damping[1:3]).fit([1.2e5, 1.0e5])
    assert np.exp(x[:4]) == pytest.approx(stated, rel=1e-4)
    assert np.sqrt(np.diag(covariance))[:2] == pytest.approx(0.017, abs=0.01)
