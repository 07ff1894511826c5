"""The numbers of bearing laws in an engineer's units, and what is said of a law that the readings contradict."""

from __future__ import annotations

from types import SimpleNamespace
from typing import Any

from pipeline.evaluation.errors import find_contradiction
from pipeline.problem.determination import Verdict
from pipeline.reporting.fit_tables import describe_law, list_numbers, tabulate_numbers
from pipeline.trust.verdict import judge_contradiction

OIL = SimpleNamespace(reference=55 + 273.15)
CONFIG: Any = SimpleNamespace(machine=SimpleNamespace(laws=SimpleNamespace(oil=OIL)))


def number(value: float, deviation: float, unit: str, determined: bool = True) -> dict[str, Any]:
    return {"value": value, "deviation": deviation, "unit": unit, "guess": 2 * value, "determined": determined}


FOUND = {
    "oil.viscosity": number(0.0166, 4e-5, "Pa * s"),
    "oil.slope": number(0.034, 6e-5, "1 / K", determined=False),
    "oil.c": number(178.15, 2.0, "K"),
    "8.radial_clearance": number(99.9e-6, 7e-8, "m"),
    "21.static_load": number(45.0, 0.5, "N"),
    "21.preload": number(0.5, 0.01, ""),
}


def test_numbers_have_the_units_of_an_engineer() -> None:
    rows = tabulate_numbers("", list_numbers(FOUND, CONFIG)).rows
    assert [row[:3] for row in rows] == [
        ["oil viscosity at 55 degC", "16.600 +- 0.040", "mPa s"],
        ["oil slope", "0.034000 +- 0.000060", "1/K"],
        ["oil c", "-95.0 +- 2.0", "degC"],
        ["node 8 radial clearance", "99.900 +- 0.070", "um"],
        ["node 21 static load", "45.00 +- 0.50", "N"],
        ["node 21 preload", "0.500 +- 0.010", ""],
    ]
    assert [row[5] for row in rows] == ["", "the data do not tell it", "", "", "", ""]
    assert rows[0][3:5] == ["0.24", "33.2"]


def quality(probability: float | None, **more: Any) -> dict[str, Any]:
    return {"fit": {"mismatch": {"probability": probability}}, **more}


def test_a_law_that_the_readings_contradict_is_named_with_the_next_step() -> None:
    (words,) = describe_law(quality(0.002), "law")
    assert words.startswith("The readings contradict this bearing law (probability 0.002). Fit model=hybrid or model=")
    assert "another table" in words
    assert "(probability below 0.0001)" in describe_law(quality(0.0), "law")[0]
    assert describe_law(quality(0.06), "law") == describe_law(quality(None), "law") == []
    assert describe_law(quality(0.002), "network") == []
    (reason,) = judge_contradiction(find_contradiction(quality(0.002), "law"))
    assert reason.verdict is Verdict.WITH_CARE
    assert judge_contradiction(find_contradiction(quality(0.4), "law")) == []


def test_a_correction_that_stands_out_of_its_deviation_speaks_against_the_law() -> None:
    correction = {
        "8": {name: {"percent": p, "deviation_percent": 1.0} for name, p in (("kxx", 12.0), ("cyy", 1.5))},
        "13": {"kxx": {"percent": 0.0, "deviation_percent": 1e-9}},
        "21": {"kxx": {"percent": 0.5, "deviation_percent": 3.0}},
    }
    first, nothing, second = describe_law(quality(0.5, correction=correction), "hybrid")
    assert "node 8 by kxx 12 +- 1 %, cyy 1.5 +- 1 %" in first
    assert first.endswith("That of kxx speaks against the law.")
    assert nothing.startswith("The network corrects nothing of the law of node 13")
    assert second.endswith("None of it speaks against the law.")


def test_ends_of_tables_are_told() -> None:
    (outside,) = describe_law(quality(0.5, law={"outside_table": {"8": 0.25, "21": 0.0}}), "law")
    assert outside.startswith("At 25 % of the points the bearing of node 8 lies beyond the end of its table")
