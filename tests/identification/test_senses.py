"""In which sense phases and angles count: which are one machine mirrored, and whether the data choose the right one."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from conftest import Run
from running import FEW_SPEEDS, composed, strict_json

from pipeline.coefficients import COEFFICIENTS
from pipeline.config.rotor import RotorConfig
from pipeline.data.dataset import Excitation, VibrationDataset
from pipeline.data.noise import NoiseModel
from pipeline.data.simulate import add_noise
from pipeline.errors import ConfigError
from pipeline.identification.senses import SENSES, Sense, reverse, try_senses
from pipeline.identification.training import FitSetup, setup_of
from pipeline.problem.measurement import Guess, Measurement
from pipeline.rotor.bearing_table import BearingTable
from pipeline.rotor.stored import load_rotor
from pipeline.unknowns import BearingUnknowns, unknown_set

ORTHOTROPIC = (2e6, 3e5, -4e5, 1e6, 900.0, 100.0, 150.0, 600.0)
ISOTROPIC = (2e6, 3e5, -3e5, 2e6, 900.0, 40.0, -40.0, 900.0)
DIRECT = (2e6, 0.0, 0.0, 1.2e6, 900.0, 0.0, 0.0, 600.0)
NOISE = 2e-7
FITTED = (
    "experiment=ball_bearing",
    "loss=response",
    "optimizer=levenberg_marquardt",
    "optimizer.levenberg_marquardt.steps=60",
    "optimizer.levenberg_marquardt.patience=3",
    "training=to_the_minimum",
    "tracking=none",
)
"""Constants, by Levenberg-Marquardt alone."""


def machine(eight: tuple[float, ...], angles: tuple[float, float] = (0.3, 2.0)) -> tuple[Measurement, BearingTable]:
    """Readings of probes at 20 and 110 degrees of a rotor with one disc, and its bearings; the last four unknown."""
    shaft = [{"length": 1.0, "outer_diameter": 0.03, "inner_diameter": 0.0, "elements": 5}]
    disc = {"node": 2, "mass": 10.0, "diametral_inertia": 0.05, "polar_inertia": 0.09}
    material = {"density": 7810.0, "youngs_modulus": 211e9, "shear_modulus": 81.2e9}
    config = {"material": material, "shaft": shaft, "discs": [disc], "bearing_nodes": [0, 5], "shear_effects": True}
    model, speeds = load_rotor(RotorConfig.model_validate(config)), np.linspace(60.0, 260.0, 6)
    bearings = BearingTable((0, 5), speeds, np.tile(eight, (2, len(speeds), 1)))
    channels = tuple((node, angle) for node in (0, 5) for angle in (20.0, 110.0))
    weights = tuple(Excitation(run, "unbalance", 2, 5e-4, angle) for run, angle in zip("ab", angles, strict=True))
    data = VibrationDataset(speeds, ("a", "b"), channels, np.ones((len(speeds), 4, 2), complex), weights)
    unknowns = unknown_set(dict.fromkeys((0, 5), BearingUnknowns(("kxx", "kyy", "cxx", "cyy"))))
    made = Measurement(model, data, bearings, NoiseModel(NOISE, 0.0), unknowns, Guess(1e6, 1e3))
    exact = replace(data, displacement=made.response.predict(bearings))
    deviation = np.full(exact.displacement.shape, NOISE)
    return replace(made, dataset=add_noise(exact, deviation, np.random.default_rng(5))), bearings


@pytest.fixture(scope="module")
def setup() -> FitSetup:
    return setup_of(composed(*FITTED))


@pytest.mark.parametrize("eight", [ORTHOTROPIC, ISOTROPIC])
def test_the_wrong_sense_in_all_is_the_machine_mirrored_with_damping_of_the_other_sign(
    eight: tuple[float, ...],
) -> None:
    """Exactly, cross-coupled stiffness with it; in no other sense does another machine of these coefficients fit."""
    measurement, bearings = machine(eight)
    expected = measurement.response.predict(bearings)
    turned = replace(bearings, values=reverse(bearings.values))
    assert not np.allclose(turned.values, bearings.values)
    for sense in SENSES:
        found = sense.read(measurement).response.predict(bearings)
        twin = sense.twin.read(measurement).response.predict(turned)
        assert np.allclose(twin.conj(), found, rtol=1e-9, atol=1e-9 * np.abs(found).max())
    signs = dict(zip(COEFFICIENTS, reverse(np.ones(8)), strict=True))
    assert [name for name, sign in signs.items() if sign < 0] == ["kxy", "kyx", "cxx", "cyy"]
    one = Sense(mirrored=True).read(measurement).response.predict(bearings)
    assert np.abs(one - expected).max() > 0.1 * np.abs(expected).max()


def test_a_sense_read_twice_is_the_data_as_written() -> None:
    """So data in the wrong sense are made by reading right ones so."""
    measurement, _ = machine(DIRECT)
    for sense in SENSES:
        twice = sense.read(sense.read(measurement))
        assert twice.dataset.channels == measurement.dataset.channels
        assert twice.dataset.excitations == measurement.dataset.excitations
        assert (twice.dataset.displacement == measurement.dataset.displacement).all()
        assert (twice.known.values == measurement.known.values).all()


@pytest.mark.slow
@pytest.mark.parametrize("written", [Sense(), Sense(lag=True), Sense(lag=True, against=True)])
def test_data_written_in_the_wrong_sense_are_found(written: Sense, setup: FitSetup) -> None:
    """Of all eight the one in which they were written, the mirrored machine refused by its damping."""
    found = try_senses(written.read(machine(DIRECT)[0]), setup)
    assert found.trials[0].sense == written
    assert found.open == found.trials[:1]
    assert found.least < 1.5 * found.expected
    assert f"the data choose {written.words}" in found.sentence
    assert ("(not as they are written)" in found.sentence) == (written != Sense())
    assert "would need damping of the other sign" in found.sentence


@pytest.mark.slow
def test_without_damping_the_mirrored_machine_fits_as_well(setup: FitSetup) -> None:
    """One of 1 N s/m makes no phase that these readings show; the pair is told as one."""
    found = try_senses(machine((*DIRECT[:4], 1.0, 0.0, 0.0, 1.0))[0], setup)
    assert {one.sense for one in found.open} == {Sense(), Sense().twin}
    assert "The same machine mirrored" in found.sentence
    assert "fits as well" in found.sentence


@pytest.mark.slow
def test_weights_along_one_line_leave_their_sense_open(setup: FitSetup) -> None:
    """All at the angle zero: with or against the rotation they are the same."""
    found = try_senses(machine(DIRECT, (0.0, 0.0))[0], setup)
    assert Sense(against=True) in {one.sense for one in found.open}
    assert "a run with a weight at another angle would" in found.sentence


def test_a_loss_that_weighs_no_noise_is_refused(setup: FitSetup) -> None:
    residual = replace(setup, loss=setup.loss.model_copy(update={"kind": "residual"}))
    with pytest.raises(ConfigError, match="stage=senses must have loss=response"):
        try_senses(machine(DIRECT)[0], residual)


@pytest.mark.slow
def test_the_stage_writes_every_sense_and_the_sentence(run: Run, tmp_path: Path) -> None:
    """Modelled data are written as the program reads them, with all weights at one angle."""
    run("senses", composed(*FITTED, *FEW_SPEEDS), tmp_path)
    found = strict_json(tmp_path / "senses.json")
    assert len(found["senses"]) == 8
    flags = ("phase_as_lag", "weights_against_rotation", "rotation_from_y_to_x")
    (written,) = [one for one in found["senses"] if not any(one[flag] for flag in flags)]
    assert not written["told_from_the_best"]
    assert "the data" in found["sentence"]
