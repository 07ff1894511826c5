"""What every method of the comparison keeps: the right answer where it can give one, a named refusal where it can't."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import get_args

import numpy as np
import pytest
from comparing import FILM, answer, composed, errors, machine, options, task

from pipeline.comparison.cases import Case, choose_main_case, list_cases
from pipeline.config.comparison import MethodName
from pipeline.methods.catalogue import METHODS
from pipeline.methods.method import Refusal

EXACT = 1e-10  # percent, rounding
METHOD_NAMES = get_args(MethodName)
BALLS = ("experiment=ball_bearing",)
OIL = ("experiment=compressor_two_journals", "machine=compressor_oil_temperatures", "machine.speeds.step_rpm=340")
BLOWS = ("experiment=impulses", "machine.speeds.step_rpm=500")
EIGHT = ("experiment=all_coefficients_backward", "machine.speeds.step_rpm=200")
FORWARD = ("experiment=all_coefficients", "machine.speeds.step_rpm=200")


@dataclass(frozen=True)
class Good:
    """A case that a method can do, and the error that it must keep there, percent: three times what it has."""

    overrides: tuple[str, ...]
    case: Case
    error: float
    loud: float = 0.01  # noise at which the error is larger


GOOD = {
    "least_squares": Good(FILM, Case(0.0, "all", 60), EXACT),
    "least_squares_expanded": Good(FILM, Case(0.0, "all", 60), EXACT),
    "smoothed": Good(FILM, Case(0.0, "all", 60), EXACT),
    "tikhonov": Good(FILM, Case(0.0, "all", 60), EXACT),
    "total_least_squares": Good(FILM, Case(0.0, "all", 60), EXACT),
    "multi_frequency": Good(BLOWS, Case(0.0, "all", 12), EXACT),
    "kalman": Good(FILM, Case(0.0, "location", 60), 1e-8),
    "kriging": Good(BALLS, Case(0.0, "all", 60), 0.005, loud=0.1),
    "critical_speeds": Good(BALLS, Case(0.0, "all", 591), 5.0, loud=0.2),
    "spline": Good(FILM, Case(0.0, "all", 60), EXACT),
    "paper": Good(FILM, Case(0.0, "all", 60), 0.4, loud=0.1),
    "paper_scaling": Good(FILM, Case(0.0, "all", 60), 0.15, loud=0.1),
    "paper_logarithm": Good(FILM, Case(0.0, "all", 60), 0.25, loud=0.1),
    "paper_second_order": Good(FILM, Case(0.0, "all", 60), 0.001),
    "residual": Good(FILM, Case(0.0, "all", 60), 5e-5),
    "preconditioned": Good(FILM, Case(0.0, "all", 60), 8e-4),
    "response": Good(FILM, Case(0.0, "all", 60), 9e-5),
    "trained": Good(FILM, Case(0.0, "all", 60), 0.01),
    "law": Good(OIL, Case(0.0, "bearings", 11), 1e-7),
}


LONG = (
    *("kriging", "critical_speeds", "paper", "paper_scaling", "paper_logarithm", "paper_second_order", "residual"),
    *("preconditioned", "response", "spline", "trained", "law"),
)
"""Methods that model many machines first, train a network, or start from many guesses."""
# The paper's residual with a part of the improved one keeps what both keep; its algorithm takes a minute a data set.
ADAM = ("paper", "paper_scaling", "paper_logarithm")
BY_DAY = [
    pytest.param(name, marks=[pytest.mark.nightly] * (name == "paper"))
    for name in METHOD_NAMES
    if name == "paper" or not name.startswith("paper")
]


@pytest.mark.parametrize(
    "method",
    [
        pytest.param(name, marks=[pytest.mark.slow] * (name in LONG) + [pytest.mark.nightly] * (name in ADAM))
        for name in METHOD_NAMES
    ],
)
def test_the_right_answer_on_clean_data(method: str) -> None:
    good = GOOD[method]
    assert errors(answer(method, good.case, *good.overrides), good.case, *good.overrides).max() < good.error


@pytest.mark.slow
@pytest.mark.parametrize("method", BY_DAY)
def test_the_error_grows_with_the_noise(method: str) -> None:
    """In proportion, over the mean of a few data sets; by half where the method's own error is not small beside it."""
    good = GOOD[method]

    def mean_error(noise: float, data_sets: int = 2) -> float:
        cases = [replace(good.case, noise=noise, data_set=i) for i in range(data_sets)]
        return float(np.mean([errors(answer(method, case, *good.overrides), case, *good.overrides) for case in cases]))

    clean, tenth, loud = mean_error(0.0, 1), mean_error(good.loud / 10), mean_error(good.loud)
    if 10 * clean < tenth:
        assert 5 < loud / tenth < 20
    else:
        assert loud > 1.5 * clean


@pytest.mark.slow
@pytest.mark.parametrize("method", BY_DAY)
def test_the_same_bits_from_the_same_seed(method: str) -> None:
    """With noise, where iterations are longest."""
    good = GOOD[method]
    case = replace(good.case, noise=good.loud / 10)  # one that the test above has
    first, second = (identify(method, case, *good.overrides) for identify in (answer, answer.__wrapped__))
    np.testing.assert_array_equal(first.coefficients.values, second.coefficients.values)


BALANCED = "identify.unbalance_planes=[2]"
ONE_RUN = (
    *FORWARD,
    "machine.runs=[{name: disc, unbalances: [{node: 1, magnitude: 100 g mm}]}]",
    "machine.speeds.step_rpm=200",
)
BY_EQUATIONS = (
    *("least_squares", "tikhonov", "total_least_squares", "residual", "preconditioned"),
    *("paper", "paper_scaling", "paper_logarithm", "paper_second_order"),
)
BY_EXPANSION = ("least_squares_expanded", "smoothed")
REFUSED = [
    *((m, Case(0.0, "location", 60), "bearings_not_measured", FILM) for m in BY_EQUATIONS),
    *((m, Case(0.0, "all", 30), "not_determined", ONE_RUN) for m in BY_EQUATIONS),
    *((m, Case(0.0, "location", 60), "forces_not_seen", FILM) for m in BY_EXPANSION),
    *((m, Case(0.0, "all", 30), "not_determined", ONE_RUN) for m in BY_EXPANSION),
    *((m, Case(0.0, "all", 60), "residual_unbalance", (*FILM, BALANCED)) for m in (*BY_EQUATIONS, *BY_EXPANSION)),
    *((m, Case(0.0, "location", 591), "not_determined", BALLS) for m in ("kalman", "kriging", "spline", "response")),
    ("trained", Case(0.0, "all", 591), "constant", BALLS),
    ("trained", Case(0.0, "all", 3), "few_speeds", FILM),
    ("law", Case(0.0, "all", 60), "no_law", FILM),
    ("multi_frequency", Case(0.0, "all", 60), "one_frequency", FILM),
    ("multi_frequency", Case(0.0, "location", 12), "bearings_not_measured", BLOWS),
    ("kriging", Case(0.0, "all", 30), "either_sign", EIGHT),
    ("kriging", Case(0.0, "all", 60), "too_many_unknowns", (*FILM, "identify.unknowns=[kxx,kyy,cxx,cyy]")),
    ("critical_speeds", Case(0.0, "all", 60), "not_constant", FILM),
    ("critical_speeds", Case(0.0, "all", 60), "stiffness_alone", (*FILM, "identify.unknowns=[kxx,cxx]")),
    ("critical_speeds", Case(0.0, "all", 60), "no_critical_speed", (*BALLS, "machine.speeds.stop_rpm=2000")),
]


@pytest.mark.parametrize(
    ("method", "case", "reason", "overrides"),
    [pytest.param(*one, marks=[pytest.mark.slow] * (one[0] == "response")) for one in REFUSED],
)
def test_what_a_method_cannot_do_it_refuses_by_name(
    method: str, case: Case, reason: str, overrides: tuple[str, ...]
) -> None:
    with pytest.raises(Refusal) as refusal:
        answer(method, case, *overrides)
    assert refusal.value.reason is reason
    assert ", but " in str(refusal.value)


def test_every_method_refuses_something() -> None:
    assert {method for method, *_ in REFUSED} == set(METHOD_NAMES) == set(METHODS)


def test_cross_validation_needs_more_equations_than_unknowns() -> None:
    """Eight unknowns of two runs are solved exactly: nothing is left to validate by."""
    whole = task(Case(0.0, "all", 30), *EIGHT)
    two = whole.dataset.of_runs(np.array([0, 3]))
    METHODS["least_squares"].identify(replace(whole, dataset=two), options(*EIGHT))
    with pytest.raises(Refusal, match="8 equations for 8 unknowns"):
        METHODS["tikhonov"].identify(replace(whole, dataset=two), options(*EIGHT))


@pytest.mark.slow
@pytest.mark.parametrize("method", ["least_squares", "total_least_squares", "kalman", "spline", "response", "trained"])
@pytest.mark.parametrize(
    "overrides",
    [FILM, pytest.param((*FILM, "identify.shared=true"), marks=pytest.mark.nightly)],
    ids=["each", "alike"],
)
def test_stated_deviations_hold(method: str, overrides: tuple[str, ...]) -> None:
    """Nominal 95 % intervals, over speeds, bearings and data sets."""
    inside = []
    for i in range(10):
        case = Case(0.003, "bearings", 60, i)
        found = answer(method, case, *overrides)
        assert found.coefficients.deviation is not None
        off = np.abs(found.coefficients.values - machine(*overrides).truth(case).values)
        stated = ~np.isnan(found.coefficients.spread)
        inside.append((off[stated] <= 1.96 * found.coefficients.spread[stated]).mean())
    assert 0.9 <= np.mean(inside) <= 0.98


def test_the_cases_are_each_once_and_the_main_one_is_there() -> None:
    settings = composed(*FILM, "comparison.speeds=[10,60,591]").comparison
    made = list_cases(settings, 60)
    assert len(set(made)) == len(made)
    assert choose_main_case(settings, 60) == Case(0.01, "bearings", 60)
    assert {case.speeds for case in made} == {10, 60}
    assert (
        sum(case == replace(choose_main_case(settings, 60), data_set=case.data_set) for case in made)
        == settings.data_sets
    )


def test_noise_is_the_same_but_for_its_size() -> None:
    """So that a line over the noise is no luck of the draw."""
    clean, quiet, loud = (task(Case(noise, "bearings", 60), *FILM).dataset.displacement for noise in (0, 0.001, 0.01))
    np.testing.assert_allclose(loud - clean, 10 * (quiet - clean), rtol=1e-9, atol=1e-18)
