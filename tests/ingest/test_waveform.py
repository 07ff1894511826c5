"""Time signals with a tacho: the vectors of run-ups and of constant speeds, and what does not fit."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import pytest
from conftest import refused
from measured_files import PROBES, probes_config, rotating, tacho_of, write_hdf5, write_tdms
from reading import RPM, RUNOUT, RUNS, TURNS, check_read, notes, read, response, seen, waves

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
