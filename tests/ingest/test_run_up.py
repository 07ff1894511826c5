"""A run-up's table: its units, its rate, and one sentence for each mistake."""

from __future__ import annotations

import re
from typing import Any

import numpy as np
import pytest

from pipeline.errors import DataError
from pipeline.ingest.run_up import RunUpConfig, read_run_up

TABLE = "examples/rk4/run_up.csv"


SETTINGS: dict[str, Any] = {
    "file": TABLE,
    "columns": {"speed": "rpm", "amplitude": "amp_1x", "phase": "phase_1x_deg"},
    "voltage": "V",
    "scale": "7.874 mV/um",
    "amplitude": "zero_to_peak",
    "phase_unit": "deg",
    "speed": "rpm",
    "from_rpm": 1030,
    "to_rpm": 2616,
}


def test_the_column_in_volts_is_the_one_in_micrometres_five_times_too_small() -> None:
    """What the file calls um took volts for mil."""
    right = read_run_up(RunUpConfig(**SETTINGS))
    other = {key: value for key, value in SETTINGS.items() if key not in ("voltage", "scale")} | {"length": "um"}
    other["columns"] = SETTINGS["columns"] | {"amplitude": "amp_1x_um"}
    wrong = read_run_up(RunUpConfig(**other))
    assert np.abs(right.vectors).max() == pytest.approx(103e-6, rel=0.01)
    assert np.abs(right.vectors / wrong.vectors) == pytest.approx(np.full(211, 5.0), rel=1e-3)
    assert wrong.rate_deviation is not None


def test_a_given_rate_is_taken() -> None:
    run_up = read_run_up(RunUpConfig(**SETTINGS | {"rate_rpm_per_s": -100.0}))
    assert (run_up.rate_deviation, run_up.rate) == (None, pytest.approx(-100 * np.pi / 30))


MISTAKES: dict[str, tuple[dict[str, Any], str]] = {
    "no such file": ({"file": "nowhere.csv"}, "must exist, but there is no such file"),
    "no such column": ({"columns": {"speed": "rmp"}}, "must have the column 'rmp'"),
    "few rows": ({"to_rpm": 1100}, "must have at least 40 rows (revolutions) on its ramp, but it has 5"),
    "no rows": ({"to_rpm": 1031, "rate_rpm_per_s": 229}, "must have rows, but it has none"),
    "thinned rows": ({"to_rpm": 4900}, "must be a ramp of one rate with a row a revolution"),
    "a range the wrong way": ({"from_rpm": 3000}, "must have from_rpm < to_rpm"),
    "volts without a scale": ({"scale": None}, "must have a scale (such as 7.87 V/mm) for voltages"),
    "a velocity": ({"scale": "4 mV/(mm/s)"}, "must be displacements"),
    "no rate": ({"rate_rpm_per_s": 0}, "must have a rate_rpm_per_s that is not 0"),
}


@pytest.mark.parametrize("what", MISTAKES)
def test_a_mistake_is_one_sentence(what: str) -> None:
    """Of a file, or of the section itself."""
    change, words = MISTAKES[what]
    with pytest.raises((DataError, ValueError), match=re.escape(words)):
        read_run_up(RunUpConfig(**SETTINGS | change))
