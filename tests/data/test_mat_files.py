"""MAT files of old and new versions."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import h5py
import numpy as np
import pandas as pd
import pytest
import scipy.io
from conftest import refused
from measured_files import long, probes_config, table_config, wide
from reading import GRID, RUNS, TURNS, check_read, check_steady, read, seen, steady, waves

from pipeline.data.mat_files import read_mat


def turned_tables() -> pd.DataFrame:
    """A row a run, probe and speed."""
    return long({name: seen(turn) for name, turn in TURNS.items()})


def write_new(path: Path, content: dict[str, Any]) -> Path:
    """A file as MATLAB 7.3 has it: columns first, texts as codes, cells as references."""
    with h5py.File(path, "w", userblock_size=512) as file:

        def write(place: Any, name: str, value: Any) -> None:
            if isinstance(value, dict):
                group = place.create_group(name)
                group.attrs["MATLAB_class"] = np.bytes_(b"struct")
                for inside, one in value.items():
                    write(group, inside, one)
            elif isinstance(value, list):
                made = []
                for text in value:
                    place_of = f"#refs#/{len(file.get('#refs#', {}))}"
                    one = file.create_dataset(place_of, data=np.array([[ord(letter)] for letter in text]))
                    one.attrs["MATLAB_class"] = np.bytes_(b"char")
                    made.append(one.ref)
                cells = np.array([made], dtype=h5py.ref_dtype)
                place.create_dataset(name, data=cells).attrs["MATLAB_class"] = np.bytes_(b"cell")
            else:
                place.create_dataset(name, data=np.atleast_2d(value).T).attrs["MATLAB_class"] = np.bytes_(b"double")

        for name, value in content.items():
            write(file, name, value)
    return path


def write_old(path: Path, content: dict[str, Any]) -> Path:
    """A file of version 5; texts as a cell array."""
    scipy.io.savemat(
        path,
        {name: np.array(value, dtype=object) if isinstance(value, list) else value for name, value in content.items()},
    )
    return path


WRITERS = [write_old, write_new]


@pytest.mark.parametrize("write", WRITERS)
def test_long_tables(write: Any, tmp_path: Path) -> None:
    """Texts in cell arrays, numbers in columns."""
    table = turned_tables()
    numbers = {name: table[name].to_numpy() for name in ("speed", "amplitude", "phase")}
    path = write(tmp_path / "all.mat", numbers | {name: list(table[name]) for name in ("run", "probe")})
    check_read(read(table_config(RUNS, "long", file=str(path))))


@pytest.mark.parametrize("write", WRITERS)
def test_wide_tables_in_structs_and_matrices(write: Any, tmp_path: Path) -> None:
    """``run.speed``, and a column of a matrix as MATLAB writes it."""
    runs = []
    for run in RUNS:
        matrix = wide(seen(TURNS[str(run["name"])])).drop(columns="speed").to_numpy()
        path = write(tmp_path / f"{run['name']}.mat", {"run": {"speed": GRID, "data": matrix}})
        runs.append(run | {"file": str(path)})
    places = {name: 2 * i + 1 for i, name in enumerate(seen().of)}
    pairs = probes_config(
        columns=lambda name: {
            "amplitude": f"run.data(:,{places[name]})",
            "phase": f"run.data(:, {places[name] + 1})",
        }
    )
    check_read(read(table_config(runs, columns={"speed": "run.speed"}, probes=pairs)))


@pytest.mark.parametrize("write", WRITERS)
@pytest.mark.parametrize(
    "clock",
    [
        {},
        {"sample_rate": None, "sample_rate_attribute": "fs"},
        {"sample_rate": None, "time": "t", "time_unit": "ms"},
    ],
    ids=["sample_rate", "variable", "time"],
)
def test_waveforms(write: Any, clock: dict[str, Any], tmp_path: Path) -> None:
    def write_channels(name: str, channels: dict[str, np.ndarray]) -> Path:
        clocks = {"fs": 5000.0, "t": 1e3 * channels.pop("time"), "tacho": channels.pop("tacho")}
        return Path(write(tmp_path / f"{name}.mat", {"probe": channels} | clocks))

    check_steady(steady(write_channels, probes=probes_config(channel=lambda name: f"probe.{name}")) | clock)


@pytest.mark.parametrize("write", WRITERS)
def test_what_a_mat_file_lacks_is_named(write: Any, tmp_path: Path) -> None:
    content = {"run": {"speed": GRID, "data": np.ones((11, 4))}, "fs": np.array([1.0, 2.0]), "text": ["a", "b"]}
    path = write(tmp_path / "a.mat", content)
    for name, fragments in (
        ("run.sped", ("must have the variable 'run.sped', but it has not: did you mean 'run.speed'?", "table2struct")),
        ("run.data", ("must have one row of values in 'run.data', but its shape is (11, 4): name a column",)),
        ("run.data(:,5)", ("must have the column 5 of 'run.data', but its shape is (11, 4)",)),
    ):
        with refused(*fragments):
            read_mat(path, [name])
    run = RUNS[0] | {"file": str(path)}
    for channel, clock, words in (
        (
            "run.speed",
            {"sample_rate": None, "sample_rate_attribute": "fs"},
            "a rate in Hz in the variable 'fs', but it has [1. 2.]",
        ),
        ("text", {}, "one row of numbers in 'text'"),
    ):
        probes = probes_config(channel=lambda name, channel=channel: channel, scale=lambda name: "8 V/mm")
        with refused(f"must have {words}"):
            read(waves(runs=[run], probes=probes, tacho={"channel": "run.speed", "edge": "rising"}) | clock)
    with refused("must have as many values in every variable, but it has 'run.speed' 11, 'fs' 2"):
        pair = probes_config(columns=lambda name: {"amplitude": "fs", "phase": "run.speed"})
        read(table_config([run], columns={"speed": "run.speed"}, probes={"A": pair["A"]}))
    path.write_bytes(path.read_bytes()[:400])
    with refused("must be a complete MAT file", "copy it again"):
        read_mat(path, ["run.speed"])
