"""The prepared cases of studies/verdicts: what was measured of all thirty, and two of them anew."""

from __future__ import annotations

import importlib.util
import json
from types import ModuleType

import pytest
import yaml
from running import ROOT

MACHINES = yaml.safe_load((ROOT / "studies" / "verdicts" / "cases.yaml").read_text(encoding="utf-8"))
CASES = {name: case for group in ("chosen", "judged") for name, case in MACHINES[group].items()}


@pytest.fixture
def judging(monkeypatch: pytest.MonkeyPatch) -> ModuleType:
    """studies/verdicts/judge.py, which is no package, in the folder whose files its cases name."""
    monkeypatch.chdir(ROOT)
    place = importlib.util.spec_from_file_location("judge_verdicts", ROOT / "studies" / "verdicts" / "judge.py")
    found = importlib.util.module_from_spec(place)
    place.loader.exec_module(found)
    return found


def test_there_are_thirty_and_no_choice_was_made_on_eighteen() -> None:
    assert (len(CASES), len(MACHINES["judged"])) == (30, 18)


def test_no_good_coefficient_was_outside_its_band() -> None:
    kept = json.loads((ROOT / "docs" / "measured" / "verdicts.json").read_text(encoding="utf-8"))["cases"]["figures"]
    for group in ("chosen", "judged"):
        assert kept[f"verdicts.{group}.good"] > 40  # a verdict that is never good would be of no use
        assert (kept[f"verdicts.{group}.good_outside"], kept[f"verdicts.{group}.good_with_20_percent_error"]) == (0, 0)
    assert kept["verdicts.chosen.cases"] + kept["verdicts.judged.cases"] == 30


@pytest.mark.slow
@pytest.mark.parametrize(("name", "good"), [("good data, rolling", True), ("lag for lead", False)])
def test_a_case(name: str, good: bool, judging: ModuleType) -> None:
    result = judging.judge(*judging.prepare(CASES[name], MACHINES))
    counted = judging.count({name: result})
    assert (counted["good_outside"], counted["good"]) == (0, 8 if good else 0)
    if not good:
        assert "lag for lead" in result["machine"]["reason"]


@pytest.mark.slow
def test_a_mode_of_pedestals_is_named_where_no_constant_follows_it(judging: ModuleType) -> None:
    """Pedestals alone resonate at ``sqrt(k / m)``, 47.7 Hz: two digits of it are told, whatever bearings are fitted."""
    built = "+machine.as_built={pedestal_stiffness: 3e8 N/m, pedestal_mass: 3333 kg}"
    case = {"machine": "two_discs_direct", "overrides": ["model=constant", built, "force=true"]}
    assert "a mode at 48 Hz in all probes" in judging.judge(*judging.prepare(case, MACHINES))["machine"]["reason"]


@pytest.mark.slow
def test_a_coefficient_that_vanishes_at_most_speeds_spoils_no_other(judging: ModuleType) -> None:
    """Its local functions are told rounding alone, of either sign: the covariance of all was no number."""
    counted = judging.count({"": judging.judge(*judging.prepare(CASES["good data, compressor"], MACHINES))})
    assert (counted["coefficients"], counted["good_outside"]) == (16, 0)
    assert counted["good"] > 8
