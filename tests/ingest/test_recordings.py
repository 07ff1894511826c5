"""Universal files and time signals: vectors of the runs, and what does not fit."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import pytest
from conftest import assert_says, refused
from measured_files import PROBES, probes_config, rotating, tacho_of, uff_set, write_hdf5, write_tdms, write_uff
from reading import GRID, RPM, RUNOUT, RUNS, TURNS, check_read, check_steady, notes, read, response, seen, steady, waves
from scipy.io import wavfile

from pipeline.data.csv_format import CsvConfig
from pipeline.ingest.recordings import read_recording

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


RATE = 4000.0
SCALE = {"A": 8000.0, "B": -8000.0, "C": 8000.0, "D": 200e-3 / 25.4e-6}  # V/m
SCALES = {"A": "8 V/mm", "B": "-8 mV/um", "C": "8 V/mm", "D": "200 mV/mil"}


def volts(seconds: float, turn: float, first: float, slope: float = 0.0, **runout: complex) -> dict[str, np.ndarray]:
    """Volts of the probes and the tacho, with a gap, from ``first`` rpm at ``slope`` rpm/s."""
    t = np.arange(int(seconds * RATE)) / RATE
    phi = 2 * np.pi * (first * t + slope * t**2 / 2) / 60 + 0.3
    vectors = seen(turn, first + slope * t).of
    channels = {name: SCALE[name] * (rotating(vectors[name] + runout.get(name, 0), phi) + 5e-4) for name in PROBES}
    return channels | {"tacho": tacho_of(phi), "time": t}


def run_up(turn: float) -> dict[str, np.ndarray]:
    """20 s from 200 to 2900 rpm, with a runout."""
    return volts(20, turn, 200, 135, **RUNOUT)


CONTAINERS: dict[str, tuple[Callable[..., object], str, dict[str, Any]]] = {
    "csv": (
        lambda path, channels, rate: pd.DataFrame(channels).round(9).to_csv(path, index=False),
        "",
        {"sample_rate": None, "time": "time", "time_unit": "s"},
    ),
    "h5": (write_hdf5, "", {"sample_rate": None, "sample_rate_attribute": "fs"}),
    "tdms": (write_tdms, "run/", {"sample_rate": None}),
    "npz": (
        lambda path, channels, rate: np.savez(path, **channels, fs=np.array([rate])),
        "",
        {"sample_rate": None, "sample_rate_attribute": "fs"},
    ),
}


def signal_config(prefix: str, runs: list[dict[str, Any]], **changes: Any) -> dict[str, Any]:
    """Channels of a container."""
    return {
        **waves(runs=runs, sample_rate=f"{RATE} Hz"),
        "probes": probes_config(channel=lambda name: f"{prefix}{name}", scale=lambda name: SCALES[name]),
        "tacho": {"channel": f"{prefix}tacho", "edge": "rising"},
        **changes,
    }


TRACKED = np.arange(800.0, 2501.0, 100.0)


@pytest.mark.slow
@pytest.mark.parametrize("ending", CONTAINERS)
def test_run_ups(ending: str, tmp_path: Path) -> None:
    """CSV, HDF5, TDMS and NPZ: the vectors of the grid within 0.02 %, runout subtracted, one negative scale."""
    write, prefix, clock = CONTAINERS[ending]
    runs = [run | {"file": str(tmp_path / f"{run['name']}.{ending}")} for run in RUNS[: 2 if ending == "h5" else 1]]
    for run in runs:
        write(Path(run["file"]), run_up(TURNS[run["name"]]), RATE)
    explicit = {
        "vectors": {name: {"amplitude": abs(v), "phase": f"{np.angle(v)} rad"} for name, v in RUNOUT.items()},
        "amplitude": "zero_to_peak",
        "phase": "lead",
    }
    dataset = read(signal_config(prefix, runs, **clock, slow_roll=explicit))
    if len(runs) == 2:
        check_read(dataset, 2e-4, TRACKED)
    assert np.abs(dataset.displacement[:, 0, 0] / response(0, 0.0, TRACKED)[0] - 1).max() < 1.6e-4


def test_run_ups_of_other_ranges(tmp_path: Path) -> None:
    """Each is tracked where it was, and how far that is, is said; orbits are judged there alone."""
    seconds = {"one": 20.0, "two": 12.0}  # up to 1820 rpm
    runs = [
        run | {"file": str(write_hdf5(tmp_path / f"{n}.h5", volts(seconds[n], TURNS[n], 200, 135)))}
        for run in RUNS
        if (n := run["name"])
    ]
    dataset = read(signal_config("", runs))
    assert dataset.present.sum(axis=0).tolist() == [18, 11]  # 1800 rpm is less than half a window from the end
    for r, turn in enumerate(TURNS.values()):
        rows = dataset.present[:, r]
        assert dataset.displacement[rows, 2, r] == pytest.approx(response(2, turn, TRACKED[rows])[0], rel=2e-3)
    assert notes(signal_config("", runs)).count("each of the 18 speeds: 'one' at 18, 'two' at 11;") == 1


def test_slow_roll_of_a_run_up(tmp_path: Path) -> None:
    """The mean vector of the windows below the limit: the runout and what little the unbalance does there."""
    runs = [RUNS[0] | {"file": str(write_hdf5(tmp_path / "one.h5", run_up(0.0)))}]
    found = read(signal_config("", runs, slow_roll={"below_rpm": 420}))
    low = response(2, 0.0, np.linspace(300, 420, 10))[0].mean()
    assert np.abs(found.displacement[:, 2, 0] - (response(2, 0.0, TRACKED)[0] - low)).max() < 0.07e-6
    with refused("must have data below machine.recordings.slow_roll.below_rpm=250", "windows fit from"):
        read(signal_config("", runs, slow_roll={"below_rpm": 250}))


def test_tracks_are_kept_by_what_they_are_made_from(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Another weight reads no signal again and gives the same bits; another file is read, and a damaged entry made
    anew."""
    monkeypatch.setattr("pipeline.files.CACHE", tmp_path / "cache")
    path = write_hdf5(tmp_path / "one.h5", run_up(0.0))
    section = signal_config("", [RUNS[0] | {"file": str(path)}], slow_roll={"below_rpm": 420})
    first = read(section)
    (entry,) = (tmp_path / "cache" / "tracks").iterdir()
    for damaged in (entry.read_bytes()[:-1], entry.read_bytes().replace(b"1", b"2")):
        entry.write_bytes(damaged)
        assert read(section).displacement.tobytes() == first.displacement.tobytes()
    monkeypatch.setattr("pipeline.ingest.order_tracking._fit_each", lambda *_: pytest.fail("it is fitted again"))
    other = read(section | {"runs": [section["runs"][0] | {"unbalances": RUNS[1]["unbalances"]}]})
    assert other.displacement.tobytes() == first.displacement.tobytes()
    write_hdf5(path, run_up(0.5))
    with pytest.raises(pytest.fail.Exception):
        read(section)


def test_records_at_constant_speed(tmp_path: Path) -> None:
    """A file a speed, in any order, one vector each; then as they are, or interpolated."""
    speeds = [1207.0, 803.0, 1601.0]
    files = {
        name: [str(write_hdf5(tmp_path / f"{name}{rpm}.h5", volts(2, turn, rpm))) for rpm in speeds]
        for name, turn in TURNS.items()
    }
    runs = [run | {"files": files[run["name"]]} for run in RUNS]
    section = signal_config("", runs, records="constant_speed", speeds=None)
    dataset = read(section)
    assert dataset.speeds == pytest.approx(np.sort(speeds) * RPM, rel=1e-6)
    for r, turn in enumerate(TURNS.values()):
        assert dataset.displacement[:, 3, r] == pytest.approx(response(2, turn, np.sort(speeds))[1], rel=1e-3)
    assert len(read(section | {"speeds": {"start_rpm": 900, "stop_rpm": 1500, "step_rpm": 100}}).speeds) == 7
    runs[1] = runs[1] | {
        "files": [str(write_hdf5(tmp_path / f"two{rpm}.h5", volts(2, 1.1, rpm))) for rpm in (1208, 900)]
    }
    apart = read(section | {"runs": runs})
    assert apart.present.tolist() == [[True, False], [False, True], [True, True], [True, False]]
    assert apart.displacement[1, 3, 1] == pytest.approx(response(2, 1.1, np.array([900.0]))[1][0], rel=1e-3)


def test_a_sharp_tacho_at_a_whole_number_of_samples_is_warned_of(tmp_path: Path) -> None:
    """All its phases are off together, and nothing in the record shows by how much."""
    phi = 2 * np.pi * 25 * np.arange(8000) / RATE + 0.01
    channels = {name: SCALE[name] * rotating(np.array(1e-5), phi) for name in PROBES} | {"tacho": tacho_of(phi, 1e-6)}
    runs = [RUNS[0] | {"files": [str(write_hdf5(tmp_path / "a.h5", channels))]}]
    section = signal_config("", runs, records="constant_speed", speeds=None)
    assert "all its phases may be off by 1.1 deg together" in notes(section)


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


Change = Callable[[dict[str, np.ndarray]], dict[str, np.ndarray]]
BAD_SIGNALS: dict[str, tuple[Change, dict[str, Any], str]] = {
    "no such channel": (
        lambda c: {k: v for k, v in c.items() if k != "B"},
        {},
        "must have the dataset 'B', but it has",
    ),
    "no sample rate": (lambda c: c, {"sample_rate": None}, "must come with a sample rate, but it has none"),
    "no such attribute": (
        lambda c: c,
        {"sample_rate": None, "sample_rate_attribute": "rate"},
        "must have the attribute 'rate' at a channel, its group or the file, but it has none",
    ),
    "NaN": (lambda c: c | {"A": np.where(np.arange(len(c["A"])) == 7, np.nan, c["A"])}, {}, "'A' has nan at sample 8"),
    "unequal lengths": (lambda c: c | {"A": c["A"][:-1]}, {}, "must have as many samples in every channel"),
    "time that stands": (
        lambda c: c | {"time": np.round(c["time"], 3)},
        {"sample_rate": None, "time": "time", "time_unit": "s"},
        "must have ascending times in 'time'",
    ),
    "time that goes back": (
        lambda c: c | {"time": np.where(c["time"] > 1, c["time"] - 0.5, c["time"])},
        {"sample_rate": None, "time": "time", "time_unit": "s"},
        "is not after the one before (1 in all)",
    ),
    "no pulses": (lambda c: c | {"tacho": 0 * c["tacho"]}, {}, "must have tacho pulses, but the signal stays"),
    "too few pulses": (lambda c: {k: v[:1500] for k, v in c.items()}, {}, "must have at least 6 tacho pulses"),
    "the wrong channel": (lambda c: c | {"tacho": np.sin(np.arange(len(c["tacho"])) ** 1.7)}, {}, "evenly spaced"),
    "not the range": (
        lambda c: c,
        {"speeds": {"start_rpm": 3000, "stop_rpm": 3500, "step_rpm": 100}},
        "must cover machine.recordings.speeds (3000 to 3500 rpm) with windows of 8 revolutions, but it covers",
    ),
    "a speed that changes": (lambda c: c, {"records": "constant_speed"}, "must have a constant speed (to 1 %)"),
    "a table in a channel": (
        lambda c: c | {"A": np.stack([c["A"], c["A"]])},
        {},
        "must have one row of numbers in 'A'",
    ),
    "nothing": (lambda c: {k: v[:0] for k, v in c.items()}, {}, "must have samples, but its channels have 0"),
}


@pytest.mark.parametrize("case", BAD_SIGNALS)
def test_a_recording_that_does_not_fit(case: str, tmp_path: Path) -> None:
    change, changes, words = BAD_SIGNALS[case]
    path = write_hdf5(tmp_path / "one.h5", change(run_up(0.0)))
    with refused(words, "one.h5"):
        read(signal_config("", [RUNS[0] | {"file": str(path)}], **changes))


def test_a_file_that_says_another_rate(tmp_path: Path) -> None:
    path = write_tdms(tmp_path / "one.tdms", run_up(0.0), RATE)
    with refused("must have the sample rate of the configuration (5000 Hz), but it says 4000 Hz"):
        read(signal_config("run/", [RUNS[0] | {"file": str(path)}], sample_rate="5 kHz"))


def test_a_file_of_an_unknown_kind(tmp_path: Path) -> None:
    (tmp_path / "one.mp3").write_bytes(b"x")
    with refused(
        "must end in .csv, .txt, .xlsx, .parquet, .npz, .wav, .h5, .hdf5, .tdms or .mat, but it ends in '.mp3'"
    ):
        read(signal_config("", [RUNS[0] | {"file": str(tmp_path / "one.mp3")}]))


@pytest.mark.parametrize("kind", ["int16", "int32", "uint8", "float32"])
def test_full_scale_of_a_wav_file_is_one(kind: str, tmp_path: Path) -> None:
    signals = np.linspace(-0.9, 0.9, 50)[:, None] * [1.0, -0.5]
    full, middle = {"int16": (32767, 0), "int32": (2147483647, 0), "uint8": (127, 128), "float32": (1, 0)}[kind]
    wavfile.write(tmp_path / "a.wav", 5120, (signals * full + middle).astype(kind))
    time, channels = read_recording(tmp_path / "a.wav", ["2", "1"], CsvConfig())
    assert time[1] == 1 / 5120
    np.testing.assert_allclose(np.stack([channels["1"], channels["2"]], axis=1), signals, atol=0.02)
    with refused("must have the channel '3'"):
        read_recording(tmp_path / "a.wav", ["3"], CsvConfig())
