"""What the tests of stage=ingest share: runs of two probes' nodes, sections of the configuration, and what is read."""

from __future__ import annotations

import csv
import json
from collections.abc import Callable, Iterable, Mapping, Sequence
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import pytest
from measured_files import PROBES, Vectors, probes_config, rotating, table_config, tacho_of, vectors_of, wide
from pydantic import TypeAdapter

from pipeline.config.compose import compose_mapping, validate
from pipeline.config.schema import Config
from pipeline.data.dataset import VibrationDataset
from pipeline.data.vibration_files import read_measured
from pipeline.ingest.dataset import RecordingsConfig, read_measured_runs

RPM = np.pi / 30
GRID = np.arange(500.0, 3001.0, 250.0)
DISC = {"node": 1, "magnitude": "20 g mm", "phase": "30 deg"}


def response(node: int, turn: float = 0.0, rpm: np.ndarray = GRID) -> tuple[np.ndarray, np.ndarray]:
    """x and y (S,) of a node, complex, in m: an elliptic orbit that grows and turns with the speed."""
    ratio = rpm / 2200
    size = (8e-6 + 3e-6 * node) * ratio**2 / (1 - ratio**2 + 0.24j * ratio) * np.exp(1j * turn)
    return size, -0.7j * size * np.exp(0.2j * node)


def seen(turn: float = 0.0, rpm: np.ndarray = GRID, probes: Mapping[str, Any] = PROBES) -> Vectors:
    """What the probes of a run see."""
    return vectors_of(rpm, lambda node: response(node, turn, rpm)[0], lambda node: response(node, turn, rpm)[1], probes)


def read_rows(folder: Path, rows: Iterable[list[str]], *given: Any, **options: Any) -> VibrationDataset:
    """The data set of a table with these rows, the header first, beside the excitation that lies in the ``folder``."""
    path = folder / "theirs.csv"
    with path.open("w", newline="") as file:
        csv.writer(file).writerows(rows)
    return read_measured(path, folder / "excitation.csv", *given, **options)


TURNS = {"one": 0.0, "two": 1.1}
RUNS = [{"name": "one", "unbalances": [DISC]}, {"name": "two", "unbalances": [DISC | {"magnitude": "4e-5 kg m"}]}]


def parsed(mapping: dict[str, Any]) -> Any:
    """The section ``ingest`` as the schema makes it."""
    return TypeAdapter(RecordingsConfig).validate_python(mapping)


def read(mapping: dict[str, Any]) -> VibrationDataset:
    """The data set of a section ``ingest``."""
    return read_measured_runs(parsed(mapping)).dataset


def notes(mapping: dict[str, Any]) -> str:
    """What the reading warns of."""
    return "\n".join(read_measured_runs(parsed(mapping)).notes)


def wide_runs(folder: Path, ending: str = ".csv", **more: Vectors) -> list[dict[str, Any]]:
    """A wide table a run in ``folder``, and the runs of the configuration."""
    runs = []
    for run in RUNS:
        name = str(run["name"])
        path = folder / f"{name}{ending}"
        table = wide(more.get(name, seen(TURNS[name])))
        table.to_excel(path, index=False) if ending == ".xlsx" else table.to_csv(path, index=False)
        runs.append(run | {"file": str(path)})
    return runs


def long_table(
    folder: Path, table: pd.DataFrame, runs: Sequence[dict[str, Any]] = RUNS, **changes: Any
) -> dict[str, Any]:
    """The section of a ``table`` with a row a run, probe and speed, which is written to ``folder``."""
    table.to_csv(folder / "all.csv", index=False)
    return table_config(runs, "long", file=str(folder / "all.csv"), **changes)


def check_read(dataset: VibrationDataset, tolerance: float = 1e-12, rpm: np.ndarray = GRID) -> None:
    """x and y of both nodes in both runs, as they were made."""
    assert (dataset.channels, dataset.runs, dataset.speeds) == (
        ((0, 0.0), (0, 90.0), (2, 0.0), (2, 90.0)),
        ("one", "two"),
        pytest.approx(rpm * RPM, rel=1e-9),
    )
    for r, turn in enumerate(TURNS.values()):
        for n, node in enumerate((0, 2)):
            for d, true in enumerate(response(node, turn, rpm)):
                assert np.abs(dataset.displacement[:, 2 * n + d, r] - true).max() < tolerance * np.abs(true).max()


@cache
def _mapping() -> str:
    return json.dumps(compose_mapping(["experiment=ball_bearing", "tracking=none"]))


def with_ingest(section: dict[str, Any], **more: Any) -> Config:
    """The configuration of ball_bearing with a section ``ingest``."""
    mapping = json.loads(_mapping())
    mapping["machine"]["recordings"] = section
    return validate(mapping | {"stage": "ingest"} | more)


ONE = RUNS[0] | {"file": "a.csv"}
BARE = {"name": "two", "file": "b.csv"}


def waves(**changes: Any) -> dict[str, Any]:
    """A section for time signals."""
    return {
        "format": "waveform",
        "records": "run_up",
        "signal_unit": "V",
        "sample_rate": "5 kHz",
        "tacho": {"channel": "tacho", "edge": "rising"},
        "probes": probes_config(channel=lambda name: name, scale=lambda name: "8 V/mm"),
        "shaft_angle": "from_x",
        "speeds": {"start_rpm": 800, "stop_rpm": 2500, "step_rpm": 100},
        "runs": [ONE],
    } | changes


STEADY = np.array([903.0, 1502.0])  # rpm


def steady(write: Callable[[str, dict[str, np.ndarray]], Path], order: int = 0, **changes: Any) -> dict[str, Any]:
    """A section of records at two constant speeds, a file each, which ``write`` makes of a name and its channels: the
    probes' motions by the derivative of the order, in um, um/s .., the tacho and the time in s.
    """
    time, files = np.arange(20000) / 5000, []
    for rpm in STEADY:
        w, vectors = rpm * RPM, seen(0.0, np.array([rpm])).of
        motions = {name: 1e6 * rotating((1j * w) ** order * vector, w * time) for name, vector in vectors.items()}
        files.append(str(write(f"{rpm:g}", motions | {"tacho": tacho_of(w * time), "time": time})))
    plain = {"signal_unit": "um", "probes": probes_config(channel=lambda name: name), "speeds": None}
    return waves(records="constant_speed", runs=[RUNS[0] | {"files": files}], **plain | changes)


def check_steady(section: dict[str, Any]) -> VibrationDataset:
    """What is read of :func:`steady`: x and y of the first node, as they were made."""
    dataset, true = read(section), np.stack(response(0, 0.0, STEADY), axis=1)
    assert dataset.displacement[:, :2, 0] == pytest.approx(true, rel=1e-3)
    return dataset


RUNOUT = {"A": 3e-6 * np.exp(0.5j), "B": 2e-6 * np.exp(-2j), "C": 1e-6 + 0j, "D": 4e-6 * np.exp(3j)}
