"""Universal files: order tracks, angles and time signals in them, and what does not fit."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from config.test_motion import ON
from conftest import assert_says, refused
from measured_files import probes_config, uff_set, write_uff
from reading import GRID, RPM, RUNS, TURNS, check_read, check_steady, notes, read, seen, steady

UFF = {"length": "um", "amplitude": "rms", "phase": "lead", "speed": "rpm"}


RESPONSES = {"A": [10, 1], "B": [10, 2], "C": [20, 1], "D": [20, 2]}


def uff_sets(**changes: Any) -> list[dict[str, Any]]:
    """Order-1 functions of both runs."""
    return [
        uff_set(GRID, vector * 1e6 / 2**0.5, *RESPONSES[name], texts=[name, f"run {run}"], **changes)
        for run, turn in TURNS.items()
        for name, vector in seen(turn).of.items()
    ]


def uff_config(path: Path, **changes: Any) -> dict[str, Any]:
    """Records found by their response."""
    return {
        "format": "uff58",
        "conventions": dict(UFF),
        "probes": probes_config(response=lambda name: RESPONSES[name]),
        "shaft_angle": "from_x",
        "file": str(path),
        "runs": [run | {"label": f"run {run['name']}"} for run in RUNS],
    } | changes


@pytest.mark.parametrize("binary", [0, 1])
@pytest.mark.parametrize("spacing", [0, 1])
def test_order_tracks_of_a_universal_file(binary: int, spacing: int, tmp_path: Path) -> None:
    """ASCII and binary, even and uneven abscissa, by response or by ID; pyuff writes eleven digits."""
    path = write_uff(tmp_path / "runs.uff", uff_sets(binary=binary, abscissa_spacing=spacing))
    check_read(read(uff_config(path)), 1e-9)
    check_read(read(uff_config(path, probes=probes_config(record=lambda name: name))), 1e-9)


def test_complex_numbers_whose_angle_is_a_lag(tmp_path: Path) -> None:
    """Conjugated numbers give the same with phase: lag; speeds in Hz too."""
    sets = [one | {"data": one["data"].conj(), "x": one["x"] / 60} for one in uff_sets(abscissa_spec_data_type=18)]
    section = uff_config(write_uff(tmp_path / "runs.uff", sets), conventions=UFF | {"phase": "lag", "speed": "Hz"})
    check_read(read(section | {"speeds": {"start_rpm": 500, "stop_rpm": 3000, "step_rpm": 250}}), 1e-3)
    assert notes(section) == ""


def test_what_a_universal_file_says_otherwise_is_warned_of(tmp_path: Path) -> None:
    """Labels of length and speed, dataset 164, and numbers per force: the configuration is followed."""
    labelled = uff_sets(ordinate_axis_units_lab="mm", abscissa_axis_units_lab="Hz", orddenom_spec_data_type=13)
    assert_says(
        notes(uff_config(write_uff(tmp_path / "a.uff", labelled))),
        "its lengths are in 'mm', and machine.recordings.conventions.length is um",
        "its abscissa is in Hz, and machine.recordings.conventions.speed is rpm",
        "is per force",
    )
    units = {"type": 164, "units_code": 5, "length": 1000.0, "force": 1000.0, "temp": 1.0, "temp_offset": 0.0}
    assert "its lengths are in 0.001 m (dataset 164)" in notes(
        uff_config(write_uff(tmp_path / "b.uff", [units, *uff_sets()]))
    )
    assert notes(uff_config(write_uff(tmp_path / "c.uff", uff_sets(ordinate_axis_units_lab="um pk-pk")))) == ""


BAD_UFF: dict[str, tuple[Callable[[list[dict[str, Any]]], list[dict[str, Any]]], dict[str, Any], str]] = {
    "no such response": (lambda sets: sets, {"probes": probes_config(response=lambda n: [7, 1])}, "response [7, 1]"),
    "no such ID": (
        lambda sets: sets,
        {"probes": probes_config(record=lambda n: f"{n}x")},
        "must have a record with ID",
    ),
    "no such run": (lambda sets: sets[:4], {}, "ID 'run two' and response [10, 1] for probe 'A' in run 'two'"),
    "two that fit": (lambda sets: sets, {"runs": [dict(RUNS[0])]}, "must have one record with response [10, 1]"),
    "real numbers": (
        lambda sets: [s | {"data": np.abs(s["data"]), "abscissa_spec_data_type": 19} for s in sets],
        {},
        "must have complex values (amplitude and phase), but they are real",
    ),
    "time signals": (
        lambda sets: [s | {"data": np.abs(s["data"]), "abscissa_spec_data_type": 17} for s in sets],
        {},
        "must be a function of the speed, but it is one of the time",
    ),
    "accelerations": (
        lambda sets: [s | {"ordinate_spec_data_type": 12} for s in sets],
        {},
        "must hold displacements, but it says that it holds accelerations",
    ),
    "a speed twice": (lambda sets: [s | {"x": np.full(11, 600.0)} for s in sets], {}, "must have one row a speed"),
    "other datasets": (
        lambda sets: [{"type": 164, "units_code": 1, "length": 1.0, "force": 1.0, "temp": 1.0, "temp_offset": 0.0}],
        {},
        "must have datasets 58 (functions at nodal DOF), but it has datasets 164",
    ),
}


@pytest.mark.parametrize("case", BAD_UFF)
def test_a_universal_file_that_does_not_fit(case: str, tmp_path: Path) -> None:
    change, changes, words = BAD_UFF[case]
    with refused(words, "runs.uff"):
        read(uff_config(write_uff(tmp_path / "runs.uff", change(uff_sets())), **changes))


def test_numbers_that_are_none_in_a_universal_file(tmp_path: Path) -> None:
    path = write_uff(tmp_path / "runs.uff", [s | {"data": s["data"] * (s["x"] != 750)} for s in uff_sets()])
    assert "probe 'A' of run 'one' is exactly zero at 1 of 11 speeds" in notes(uff_config(path))
    path.write_text(
        path.read_text().replace("  7.50000e+02   0.00000000000e+00", "  7.50000e+02                 nan", 1)
    )
    with refused("must have finite numbers, but record A [10, 1] has NaN"):
        read(uff_config(path))


def test_time_signals_of_a_universal_file(tmp_path: Path) -> None:
    def write(name: str, channels: dict[str, np.ndarray]) -> Path:
        time = channels.pop("time")
        sets = [uff_set(time, values, 1, 1, [channel], abscissa_spacing=1) for channel, values in channels.items()]
        return write_uff(tmp_path / f"{name}.uff", sets)

    probes = probes_config(record=lambda name: name, scale=lambda name: "1 V/um")
    section = steady(write, tacho={"record": "tacho", "edge": "rising"}, probes=probes, signal_unit="V")
    section = {key: value for key, value in section.items() if key != "sample_rate"} | {"format": "uff58"}
    check_steady(section)
    wrong = {
        "tacho": {},
        "conventions": {key: value for key, value in UFF.items() if key != "length"} | {"voltage": "V"},
        "signal_unit": None,
        "records": None,
        "runs": [RUNS[0] | {"file": section["runs"][0]["files"][0]}],
    }
    with refused("must be a function of the speed, but it is one of the time: give the record of the tacho"):
        read(section | wrong)


@pytest.mark.parametrize(
    ("kind", "unit", "of", "order", "size"), [("velocity", "mm/s", 11, 1, 1e-3), ("acceleration", "g", 12, 2, 9.80665)]
)
def test_functions_of_universal_files(kind: str, unit: str, of: int, order: int, size: float, tmp_path: Path) -> None:
    """Ordinate types 11 and 12; the other is refused."""
    sets = [
        uff_set(
            GRID,
            vector * (1j * GRID * RPM) ** order / size,
            *(i + 1, 1),
            texts=[name, f"run {run}"],
            ordinate_spec_data_type=of,
            ordinate_axis_units_lab=unit,
        )
        for run, turn in TURNS.items()
        for i, (name, vector) in enumerate(seen(turn).of.items())
    ]
    conventions = {"amplitude": "zero_to_peak", "phase": "lead", "speed": "rpm"}
    section = {
        "format": "uff58",
        "conventions": conventions | {kind: unit},
        "probes": probes_config(record=lambda name: name, **ON),
        "shaft_angle": "from_x",
        "file": str(write_uff(tmp_path / "a.uff", sets)),
        "runs": [run | {"label": f"run {run['name']}"} for run in RUNS],
    }
    check_read(read(section), 1e-9)
    with refused("must hold displacements, but it says that it holds", f"machine.recordings.conventions.{kind}"):
        read(
            section | {"conventions": conventions | {"length": "um"}, "probes": probes_config(record=lambda name: name)}
        )
