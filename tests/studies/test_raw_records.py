"""Raw records in the form of the measured rig's deposit come back as the vectors that they were made of."""

from __future__ import annotations

from itertools import product
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import pytest
import raw_records
from conftest import assert_says
from running import ROOT

pytestmark = pytest.mark.slow

MIL, VOLT, RUNOUT = 25.4e-6, 127e-6, 20e-6 * np.exp(1j * np.array([0.4, 2.0, -1.1, 3.0]))
SPEEDS = {"N1": 1004.7, "N2": 1205.3}
WEIGHTS = {
    "BASE": ("baseline", 0, 0, 0, 0),
    "A001": ("D1", 0.1, 0, 0, 0),
    "B040": ("antiphase", 1.6, 112.5, 1.6, 292.5),
}


def moments(weights: tuple[Any, ...]) -> np.ndarray:
    """(2,) complex g mm, 30 mm out."""
    return 30 * np.array(weights[1::2]) * np.exp(1j * np.radians(weights[2::2]))


def respond(rpm: np.ndarray, weights: tuple[Any, ...] = WEIGHTS["BASE"]) -> np.ndarray:
    """(.., 4) m at each probe, as leads: one mode at 1600 rpm, moved by an unbalance of its own and by both weights.

    The angles of weights grow against the rotation, as lags do: here they are conjugated.
    """
    ratio, own = (rpm / 1600)[..., None], 20 + moments(weights).conj() @ [1.0, 0.5]
    return 3e-7 * own * np.array([1.0, 0.8j, 1.6 - 0.2j, 1.3j]) * ratio**2 / (1 - ratio**2 + 0.1j * ratio)


def write(path: Path, turns: np.ndarray, vectors: np.ndarray) -> None:
    """A file of 8 s whose shaft has turned ``turns`` (n,): 1X and 2X, a gap that drifts, noise, and the keyphasor.

    Its pulse falls by 2.2 V in 4 degrees around a whole turn, and is back 18 degrees behind it.
    """
    phi, after = 2 * np.pi * turns[:, None], np.mod(turns + 0.5, 1.0) * 360 - 180
    motion = np.real(vectors * np.exp(1j * phi)) + 3e-6 * np.cos(2 * phi + 1) + 2e-6 * phi / phi[-1]
    every = (motion + 1e-8 * np.random.default_rng(5).standard_normal(motion.shape)).T / VOLT
    np.savez(
        path,
        fs=12800,
        condition_id="A001",
        keyphasor=np.interp(after, [-2, 2, 14, 18], [0.1, -2.1, -2.1, 0.1]),
        **dict(zip(("plane1_x", "plane1_y", "plane2_x", "plane2_y"), every, strict=True)),
    )


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Three conditions at two speeds, two records each, a blind one without files, the slow roll and the run-up."""
    folder, time = tmp_path_factory.mktemp("raw"), np.arange(102_400) / 12800
    rows = [
        (f"{name}_{speed_id}_m1_a{acq}_17.npz", name, speed_id, rpm, 1, acq)
        for name, (speed_id, rpm), acq in product((*WEIGHTS, "BLND01"), SPEEDS.items(), (1, 2))
    ]
    names = ["file", "condition_id", "speed_id", "rpm_measured", "mount_idx", "acq_idx"]
    pd.DataFrame(rows, columns=names).to_csv(folder / "index.csv", index=False)
    for file, name, _, rpm, _, acq in rows[:-4]:
        # 0.2 % faster and slower
        turns = rpm / 60 * (time + 0.002 * np.sin(time)) + acq / 7
        write(folder / file, turns, respond(np.array(rpm), WEIGHTS[name]) + RUNOUT)
    names = ["config", "disk1_mass_g", "disk1_angle_deg", "disk2_mass_g", "disk2_angle_deg"]
    table = pd.DataFrame.from_dict({**WEIGHTS, "BLND01": ("sealed", *4 * [None])}, "index", columns=names)
    table.assign(block="A_severity", radius_mm=30.0).to_csv(folder / "conditions.csv", index_label="condition_id")
    write(folder / raw_records.SLOW_ROLL, 251 / 60 * (time + 0.02 * np.sin(time)), RUNOUT)
    write(folder / raw_records.RUN_UP, 15 * time + 1.907 * time**2, respond(900 + 228.84 * time) + RUNOUT)
    return folder


def assert_same(found: np.ndarray, true: np.ndarray) -> None:
    """To 0.1 % and 0.1 degree."""
    assert max(*np.abs(np.abs(found / true) - 1) / 1e-3, *np.degrees(np.abs(np.angle(found / true))) / 0.1) < 1


def test_the_vectors_come_back(folder: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """Records in mil as lags without runout, and their weights; the run-up in V; and the stages read both tables."""
    assert raw_records.main([str(folder), f"output={tmp_path}", "stage=[ingest,runup]", "tracking=none"]) == 0
    assert_says(capsys.readouterr().out, "6 records of 3 conditions at 2 speeds, 4 probes")
    table = pd.read_csv(tmp_path / "records.csv")
    assert list(table) == list(pd.read_csv(ROOT / "examples" / "rk4" / "records.csv", nrows=1))
    parts = table.loc[:, "U1_re":].drop(columns="rpm").to_numpy()
    for row, read in zip(table.itertuples(), parts[:, ::2] + 1j * parts[:, 1::2], strict=True):
        weights, rpm = WEIGHTS[row.condition], np.array(SPEEDS[row.speed_id])
        assert (row.config, row.rpm) == (weights[0], pytest.approx(rpm, rel=2e-3))
        assert read[:2] == pytest.approx(moments(weights), abs=1e-6)
        assert_same(read[2:], respond(rpm, weights).conj() / MIL)
    rpm, size, phase = pd.read_csv(tmp_path / "run_up_1x.csv").to_numpy().T
    assert_same(size * np.exp(1j * np.radians(phase)), (respond(rpm) + RUNOUT)[:, 0] / VOLT)


@pytest.mark.parametrize("damaged", [False, True])
@pytest.mark.parametrize("file", ["A001_N1_m1_a2_17.npz", raw_records.SLOW_ROLL, "conditions.csv"])
def test_a_folder_that_lacks_a_file_or_has_it_damaged_ends_in_a_sentence(
    folder: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str], file: str, damaged: bool
) -> None:
    for path in (path for path in folder.iterdir() if path.name != file):
        (tmp_path / path.name).symlink_to(path)
    if damaged:
        (tmp_path / file).write_bytes((folder / file).read_bytes()[:100])
    assert raw_records.main([str(tmp_path), f"output={tmp_path / 'out'}"]) == 2
    assert_says(capsys.readouterr().err, file, ":")
