"""The sense of phases and angles: which are one machine mirrored, and whether the data choose the right one."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from conftest import assert_says
from small_rotor import DIRECT, small_machine

from pipeline.coefficients import COEFFICIENTS
from pipeline.errors import ConfigError
from pipeline.identification.senses import SENSES, Sense, Senses, Trial, try_senses
from pipeline.identification.training import FitSetup

ORTHOTROPIC = (2e6, 3e5, -4e5, 1e6, 900.0, 100.0, 150.0, 600.0)
ISOTROPIC = (2e6, 3e5, -3e5, 2e6, 900.0, 40.0, -40.0, 900.0)
REVERSED = np.array([-1.0 if name in ("kxy", "kyx", "cxx", "cyy") else 1.0 for name in COEFFICIENTS])
"""Signs with which a machine looks, mirrored and time reversed, as it does without them."""


@pytest.mark.parametrize("eight", [ORTHOTROPIC, ISOTROPIC])
def test_the_wrong_sense_in_all_is_the_machine_mirrored_with_damping_of_the_other_sign(
    eight: tuple[float, ...],
) -> None:
    """Exactly, cross-coupled stiffness with it; in no other sense does another machine of these coefficients fit."""
    measurement, bearings = small_machine(eight)
    expected = measurement.response.predict(bearings)
    turned = replace(bearings, values=bearings.values * REVERSED)
    assert not np.allclose(turned.values, bearings.values)
    for sense in SENSES:
        found = sense.read(measurement).response.predict(bearings)
        twin = sense.twin.read(measurement).response.predict(turned)
        assert np.allclose(twin.conj(), found, rtol=1e-9, atol=1e-9 * np.abs(found).max())
    one = Sense(mirrored=True).read(measurement).response.predict(bearings)
    assert np.abs(one - expected).max() > 0.1 * np.abs(expected).max()


def test_a_sense_read_twice_is_the_data_as_written() -> None:
    """So data in the wrong sense are made by reading right ones so."""
    measurement, _ = small_machine(DIRECT)
    for sense in SENSES:
        twice = sense.read(sense.read(measurement))
        assert twice.dataset.channels == measurement.dataset.channels
        assert twice.dataset.excitations == measurement.dataset.excitations
        assert (twice.dataset.displacement == measurement.dataset.displacement).all()
        assert (twice.known.values == measurement.known.values).all()


@pytest.mark.slow
@pytest.mark.parametrize(
    "written",
    [
        Sense(lag=True, against=True),
        *(pytest.param(one, marks=pytest.mark.nightly) for one in (Sense(), Sense(lag=True))),
    ],
)
def test_data_written_in_the_wrong_sense_are_found(written: Sense, setup: FitSetup) -> None:
    """Of all eight the one in which they were written, the mirrored machine refused by its damping."""
    found = try_senses(written.read(small_machine(DIRECT)[0]), setup)
    assert found.trials[0].sense == written
    assert found.open == found.trials[:1]
    assert found.least < 1.5 * found.expected
    assert f"the data choose {written.words}" in found.sentence
    assert ("(not all as they are written)" in found.sentence) == (written != Sense())
    assert "would need damping of the other sign" in found.sentence


@pytest.mark.slow
def test_without_damping_the_mirrored_machine_fits_as_well(setup: FitSetup) -> None:
    """One of 1 N s/m makes no phase that these readings show; the pair is told as one."""
    found = try_senses(small_machine((*DIRECT[:4], 1.0, 0.0, 0.0, 1.0))[0], setup)
    assert {one.sense for one in found.open} == {Sense(), Sense().twin}
    assert_says(found.sentence, "The same machine mirrored", "fits as well")


@pytest.mark.slow
def test_weights_along_one_line_leave_their_sense_open(setup: FitSetup) -> None:
    """All at the angle zero: with or against the rotation they are the same."""
    found = try_senses(small_machine(DIRECT, (0.0, 0.0))[0], setup)
    assert Sense(against=True) in {one.sense for one in found.open}
    assert "a run with a weight at another angle would" in found.sentence


def test_a_loss_that_weighs_no_noise_is_refused(setup: FitSetup) -> None:
    residual = replace(setup, loss=setup.loss.model_copy(update={"kind": "residual"}))
    with pytest.raises(ConfigError, match="stage=senses must have loss=response"):
        try_senses(small_machine(DIRECT)[0], residual)


def test_what_a_new_start_gained_is_no_evidence() -> None:
    """A fit that stuck 50 above its minimum: a machine that is 40 worse may have stuck, too."""
    trials = tuple(Trial(sense, 40.0 * i) for i, sense in enumerate(SENSES))
    assert len(Senses(trials, expected=10.0, least=9.0).open) == 1
    stuck = Senses(trials, expected=10.0, least=9.0, gained=50.0)
    assert stuck.open == trials[:2]
    assert "one that started anew gained 50, so less tells nothing" in stuck.sentence


def test_a_fit_far_from_its_noise_is_doubted() -> None:
    """Chi-square three times what is expected, or more: no odds are to be believed."""
    trials = tuple(Trial(sense, 100.0 * i) for i, sense in enumerate(SENSES))
    assert "Doubt this" not in Senses(trials, expected=10.0, least=29.0).sentence
    doubted = Senses(trials, expected=10.0, least=40.0).sentence
    assert "Doubt this: even the best leaves 4 times what the noise explains" in doubted
