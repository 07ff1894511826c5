"""What the rules make of evidence: each in the words that a user reads."""

from __future__ import annotations

import re
from typing import Any, cast

import numpy as np
import pytest
from conftest import assert_says

from pipeline.coefficients import COEFFICIENTS
from pipeline.problem.determination import judge_determined
from pipeline.rotor.bearing_table import BearingTable
from pipeline.trust.evidence import Evidence, Growth
from pipeline.trust.judgement import judge
from pipeline.trust.misfit import measure_misfit
from pipeline.trust.mistake import Mistake
from pipeline.trust.verdict import find_contradicted, judge_mistakes, judge_whirl

FIT: dict[str, Any] = {
    "chi_square": {"value": 100.0, "expected": 100.0, "readings": 120, "numbers": 40},
    "whiteness": {"autocorrelation": 0.0, "over_its_deviation": 0.0, "probability": 0.5},
    "mismatch": {"chi_square": 0.5, "whiteness": 0.5, "probability": 0.8},
}
VALUES = dict(zip(COEFFICIENTS, (1e8, 1e6, -1e6, 1e8, 1e5, 1e3, -1e3, 1e5), strict=True))
CERTAIN = {name: 0.01 * abs(value) for name, value in VALUES.items()}


def gathered(deviation: dict[str, float] | None = None, **changed: Any) -> Evidence:
    """One bearing at five speeds, all eight coefficients known to a percent, nothing against them."""
    values = np.tile(list(VALUES.values()), (1, 5, 1))
    spread = np.tile(list((CERTAIN | (deviation or {})).values()), (1, 5, 1))
    fit = changed.pop("fit", FIT)
    given: dict[str, Any] = {
        "answer": BearingTable((3,), np.arange(1.0, 6.0), values, deviation=spread),
        "by_fit": spread,
        "tolerances": {},
        "moves": {},
        "fit": fit,
        "misfit": measure_misfit(fit),
        "predicted": {"a": 1.0, "b": 1.0},
        "superposed": {"a": 1.0, "b": 1.0},
        "priors": {},
        "departures": {},
        "growth": Growth(-1.0, 0.1, None),
        "lacking": None,
        "outcome": "converged",
    }
    return Evidence(**(given | changed))


def record(evidence: Evidence, mistakes: list[Mistake] | None = None) -> dict[str, Any]:
    return judge(evidence, [], judge_mistakes(mistakes or [], list(find_contradicted(evidence))))


def of(judged: dict[str, Any], name: str) -> dict[str, Any]:
    return next(entry for entry in judged["verdicts"] if entry["coefficient"] == name)


def test_where_nothing_speaks_against_it_all_is_good() -> None:
    judged = record(gathered())
    assert (judged["machine"]["verdict"], judged["machine"]["reservation"]) == ("good", "")
    assert judged["bearings"][0]["reason"] == "8 of 8 coefficients are good."


def test_verdict_and_determination_are_one_scale() -> None:
    """What is called good is called well determined, and what is not determined is no."""
    for share in (0.01, 0.049, 0.051, 0.08, 0.29, 0.31, 2.0):
        evidence = gathered({"kxx": share * 1e8})
        judged = of(record(evidence), "kxx")["verdict"]
        (determined,) = [each for each in judge_determined(evidence.answer) if each.name == "kxx"]
        words = {"good": "well determined", "with care": "weakly determined", "no": "not determined"}
        assert determined.verdict.determined == words[judged]


@pytest.mark.parametrize(
    ("name", "deviation", "verdict"),
    [
        ("kxy", 1e4, "good"),  # 0.01 % of the direct ones, 1 % of itself
        ("kxy", 4e5, "good"),  # 40 % of itself, 0.4 % of the direct ones
        ("kxy", 1e6, "with care"),
        ("kxy", 4e6, "no"),
        ("cyx", 4e2, "good"),
        ("kxx", 4e7, "no"),
    ],
)
def test_a_cross_term_is_judged_beside_the_direct_ones(name: str, deviation: float, verdict: str) -> None:
    entry = of(record(gathered({name: deviation})), name)
    assert entry["verdict"] == verdict
    assert ("of the direct coefficients" in entry["reasons"][0]) is (verdict == "good")


def test_a_cross_term_of_zero_has_a_verdict() -> None:
    evidence = gathered({"kxy": 1e4})
    evidence.answer.values[..., 1] = 0.0
    assert of(record(evidence), "kxy")["verdict"] == "good"


def test_a_growth_within_its_deviation_turns_nothing() -> None:
    assert record(gathered(growth=Growth(0.35, 1.7, None)))["machine"]["verdict"] == "good"
    judged = record(gathered(growth=Growth(9.0, 1.0, 2100.0)))
    assert judged["machine"]["verdict"] == "with care"
    assert "9.0 +- 1.0 1/s" in judged["machine"]["reason"]


@pytest.mark.parametrize(
    ("stated", "moves", "verdict"),
    [
        ("priors", (1.0, 2.0), "good"),
        ("priors", (2.5, 0.0), "with care"),
        ("priors", (5.9, 3.9, 3.2, 3.9), "no"),
        ("departures", (3.9, -1.0), "good"),
        ("departures", (0.3, -47.0), "no"),
    ],
)
def test_numbers_that_moved_beyond_their_tolerances_speak_against_the_model(
    stated: str, moves: tuple[float, ...], verdict: str
) -> None:
    judged = record(gathered(**{stated: {f"probe_gain {i}": move for i, move in enumerate(moves)}}))["machine"]
    assert (judged["verdict"], bool(re.search("model lacks something|47 times as far", judged["reason"]))) == (
        verdict,
        verdict == "no",
    )


def test_a_run_is_blamed_where_sums_of_runs_object() -> None:
    judged = record(gathered(superposed={"a": 16.0, "b": 2.0}, predicted={"a": 9.0, "b": 9.0}))["machine"]
    assert "Run 'a' contradicts the sum of other runs: it lies 4 times its noise away." in judged["reason"]
    assert "model" not in judged["reason"]
    assert judged["next"].startswith("Check the weight, its angle and its plane in run 'a'")


def test_the_model_may_be_at_fault_where_no_sum_of_runs_objects() -> None:
    for superposed in ({"a": 1.0, "b": 1.0}, {}):
        judged = record(gathered(superposed=superposed, predicted={"a": 16.0, "b": 2.0}))["machine"]
        assert_says(judged["reason"], "Run 'a' contradicts the fit of the other runs", "the model may be at fault")
        assert judged["next"].startswith("Check the model, and the weight")


@pytest.mark.parametrize(("superposed", "doubted"), [({"a": 1.0}, True), ({"a": 16.0}, False), ({}, True)])
def test_a_single_mistake_is_doubted_where_no_sum_of_runs_objects(superposed: dict[str, float], doubted: bool) -> None:
    single = Mistake(
        "the weight of run 'a' is not as stated",
        "the weight of run 'a'",
        cast(Any, None),
        gross=False,
        single=True,
        falls_by=9.0,
    )
    reason = record(gathered(superposed=superposed), [single])["machine"]["reason"]
    assert "3 times better if this is so: the weight of run 'a'" in reason
    assert ("the model may be at fault" in reason) is doubted
    every = Mistake("all readings are 2 times too small", "the conventions", cast(Any, None), falls_by=9.0)
    assert "may be at fault" not in record(gathered(superposed=superposed), [every])["machine"]["reason"]


def test_a_coefficient_that_hangs_on_one_run_doubts_the_model_too() -> None:
    move, spread = np.zeros((1, 5, 8)), np.ones((1, 5, 8))
    move[..., 0] = 1e7
    for superposed, doubted in (({"a": 1.0}, True), ({"a": 16.0}, False)):
        entry = of(record(gathered(moves={"run a": (move, spread)}, superposed=superposed)), "kxx")
        (reason,) = [text for text in entry["reasons"] if text.startswith("Without run a")]
        assert ("the model may be at fault" in reason) is doubted


def test_a_rejected_model_is_said_to_be_with_its_held_out_error() -> None:
    fit = FIT | {"held_out_speeds": {"error_percent": 92.0, "mean_square_over_noise": 400.0}}
    judged = record(gathered({name: 5.0 * abs(value) for name, value in VALUES.items()}, fit=fit))["machine"]
    assert judged["verdict"] == "no"
    assert_says(judged["reservation"], "REJECTED", "held-out speeds predicted to 92 %")


def test_good_is_never_said_beside_readings_that_are_not_explained() -> None:
    judged = record(gathered(fit=FIT | {"chi_square": FIT["chi_square"] | {"value": 10_000.0}}))
    assert {entry["verdict"] for entry in judged["verdicts"]} == {"with care"}
    assert "do not explain the readings: they lie 10 times as far" in judged["machine"]["reason"]


def test_a_tolerance_larger_than_the_fits_own_share_is_named() -> None:
    tolerance = np.zeros((1, 5, 8))
    tolerance[..., 0] = 1e7
    evidence = gathered({"kxx": 1.005e7}, by_fit=np.full((1, 5, 8), 1e6), tolerances={"probe_angle": tolerance})
    entry = of(record(evidence), "kxx")
    assert entry["verdict"] == "with care"
    assert "A usual tolerance of probe angle" in entry["reasons"][0]
    assert "identify.model_parameters.probe_angle" in entry["next"]


def test_mirrored_phases_are_told_by_the_orbits() -> None:
    """Without a run of unbalances, or where half of the orbits turn backward, nothing is said."""
    assert not [*judge_whirl({}), *judge_whirl({"a": 0.9, "b": 0.3})]
    (reason,) = judge_whirl({"a": 1.0, "b": 0.96})
    assert_says(reason.sentence, "unbalance runs turn backward at 98 % of speeds and nodes")


def test_one_start_of_several_is_told() -> None:
    judged = record(gathered(fit=FIT | {"starts": {"fitted": 7, "at_this_answer": 1}}))
    assert judged["machine"]["verdict"] == "with care"
    assert_says(judged["machine"]["reason"], "1 of 7 starts ended at this answer", "global minimum")
    assert record(gathered(fit=FIT | {"starts": {"fitted": 7, "at_this_answer": 2}}))["machine"]["verdict"] == "good"


def test_a_mode_that_the_model_lacks_is_named_by_its_frequency() -> None:
    judged = record(gathered(lacking=(2 * np.pi * 22.0, "all probes")))["machine"]
    assert_says(judged["reason"], "a mode at 22 Hz in all probes that the model lacks")
    assert_says(judged["next"], "a support, a base, a coupling")


def test_a_misfit_alone_says_no_where_no_noise_looks_like_it() -> None:
    """Ten times the noise: white, the noise is stated too small; over the speed, the machine is another one."""
    far = FIT | {"chi_square": FIT["chi_square"] | {"value": 1e4}, "mismatch": {"chi_square": 0.0, "whiteness": 0.5}}
    assert record(gathered(fit=far))["machine"]["verdict"] == "with care"
    wandering = far | {"whiteness": FIT["whiteness"] | {"autocorrelation": 0.9, "probability": 0.0}}
    assert record(gathered(fit=wandering))["machine"]["verdict"] == "no"
