"""The spline of the comparison, by SciPy, against the output error with B-splines: two authors of one idea."""

from __future__ import annotations

import numpy as np
import pytest
from comparing import composed, errors, options, task

from pipeline.comparison.cases import Case
from pipeline.identification.fit import fit
from pipeline.identification.training import FitSetup
from pipeline.methods.method import Estimate
from pipeline.methods.spline import identify_by_spline

FILM = ("experiment=hydrostatic_stiffness", "machine.speeds.step_rpm=100")
BALLS = ("experiment=ball_bearing", "machine.speeds.step_rpm=100")


def setup_of(*overrides: str) -> FitSetup:
    """The output error as the comparison has it, with another model."""
    own = composed(*overrides).comparison.response
    return FitSetup(own.model, own.loss, own.optimizer, own.training)


@pytest.mark.slow
def test_the_spline_is_as_good_as_the_output_error_with_b_splines() -> None:
    """Over some data sets of 1 % noise, eight functions each: neither has a median error a third above the other."""
    few = ("model@comparison.response.model=b_spline", "comparison.response.model.count=8")
    ours, theirs = [], []
    for i in range(6):
        case = Case(0.01, "bearings", 60, i)
        data = task(case, *FILM)
        ours.append(errors(identify_by_spline(data, options(*FILM)), case, *FILM).mean())
        found = fit(data, setup_of(*FILM, *few)).table(data.known)
        theirs.append(errors(Estimate(found, None), case, *FILM).mean())
    ratio = np.mean(ours) / np.mean(theirs)
    print(ratio)
    assert 3 / 4 < ratio < 4 / 3


def test_constants_are_the_same_minimum() -> None:
    """Constants leave nothing to choose: the two minimise the same sum of squares, weighed by the same noise."""
    data = task(Case(0.01, "bearings", 60), *BALLS)
    one = identify_by_spline(data, options(*BALLS)).coefficients.values
    other = fit(data, setup_of(*BALLS)).table(data.known).values
    np.testing.assert_allclose(one, other, rtol=3e-4)


BLOWS = ("experiment=impulses", "machine.speeds.step_rpm=1000")


@pytest.mark.slow
def test_the_spline_finds_the_residual_unbalance() -> None:
    """On clean data exactly, and the runs that turn with the rotor count as the others do."""
    case = Case(0.0, "bearings", 6)
    found = identify_by_spline(task(case, *BLOWS), options(*BLOWS))
    hidden = {one.node: 1e6 * one.magnitude for one in composed(*BLOWS).machine.residual_unbalance}
    for node, size in hidden.items():
        assert f"{size:.3g} g mm at node {node}" in found.words
    assert errors(found, case, *BLOWS).max() < 1e-6
