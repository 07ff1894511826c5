"""Hydra's parallel launchers on real commands: the jobs of a multirun side by side, as if they ran one by one."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pandas as pd
import pytest
from conftest import ANSWER, DATA, assert_says
from running import FEW_SPEEDS, names_in, python

from pipeline.__main__ import main
from pipeline.identification.storage import load_model

pytestmark = pytest.mark.slow

CHEAP = [
    "tracking=none",
    *FEW_SPEEDS,
    *("optimizer.adam.steps=10", "optimizer.levenberg_marquardt.steps=0"),
]
# As a network of the speed, which begins elsewhere for each seed; single parameters all begin at the same guess.
SEEDS = ["-m", "stage=train", "seed=0,1", "experiment=ball_bearing", "model=network", *CHEAP]


@pytest.fixture(scope="module")
def one_by_one(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The folder of the two seeds, trained by Hydra's basic launcher."""
    folder = tmp_path_factory.mktemp("basic")
    with pytest.MonkeyPatch.context() as patch:
        patch.chdir(folder)
        assert main([*SEEDS, "hydra/launcher=basic", "output=out"]) == 0
    return folder / "out"


@pytest.mark.parametrize("launcher", [["joblib", "hydra.launcher.n_jobs=2"]], ids="-".join)
def test_jobs_side_by_side(launcher: list[str], one_by_one: Path, tmp_path: Path) -> None:
    """Two seeds: a folder each, complete, with the numbers of the jobs that ran one by one."""
    done = python("-m", "pipeline", *SEEDS, f"hydra/launcher={launcher[0]}", *launcher[1:], "output=out", cwd=tmp_path)
    assert done.returncode == 0, done.stderr
    assert "Traceback" not in done.stderr
    if launcher[0] == "joblib":  # submitit's jobs speak into files of their own
        assert all(f"[{seed + 1}/2] stage=train seed={seed} " in done.stdout for seed in range(2))
    assert {path.name for path in tmp_path.iterdir()} == {"artifacts", "out"}
    assert [path.name for path in (tmp_path / "artifacts").iterdir()] == [".multirun"]
    assert {path.name for path in (tmp_path / "out").iterdir()} == {"jobs.csv", "jobs.png", "seed-0", "seed-1"}
    answers = []
    for seed in range(2):
        here, there = tmp_path / "out" / f"seed-{seed}", one_by_one / f"seed-{seed}"
        assert names_in(here) == DATA | ANSWER | {"config.yaml"}
        told = [json.loads((folder / "training.json").read_text()) for folder in (here, there)]
        assert (told[0]["seed"], told[0]["steps"]) == (seed, told[1]["steps"])
        np.testing.assert_allclose(told[0]["held_out_loss"], told[1]["held_out_loss"], rtol=1e-6)
        values = [load_model(folder).values(np.array([100.0, 300.0, 500.0])) for folder in (here, there)]
        np.testing.assert_allclose(*values, rtol=1e-6)
        answers.append(values[0])
        assert (here / "vibration.parquet").read_bytes() == (there / "vibration.parquet").read_bytes()
    assert not np.allclose(answers[0], answers[1], rtol=1e-3), "each seed has its own answer"


@pytest.mark.parametrize("launcher", ["submitit_local"])
def test_a_job_that_fails_is_named(launcher: str, tmp_path: Path) -> None:
    """The other is done, the command's exit code is that of the mistake, and its reason is found."""
    (tmp_path / "out").mkdir()
    (tmp_path / "out" / "seed-1").write_text("in the way")
    given = ("stage=configure", "seed=0,1", "experiment=ball_bearing", "tracking=none", "output=out")
    done = python("-m", "pipeline", "-m", f"hydra/launcher={launcher}", *given, cwd=tmp_path)
    assert done.returncode == 2, done.stderr
    assert "Traceback" not in done.stderr
    assert "'seed=1'" in (said := done.stderr)
    if launcher == "submitit_local":
        assert "what the jobs said is in 'artifacts/.multirun/.submitit'" in said
        said = "".join(path.read_text() for path in (tmp_path / "artifacts/.multirun/.submitit").rglob("*.err"))
    assert_says(
        said,
        "[2/2] stage=configure seed=1 experiment=ball_bearing tracking=none output=out failed",
        "'out/seed-1/config.yaml' must be writable",
    )
    assert "Traceback" not in said
    assert (tmp_path / "out" / "seed-0" / "config.yaml").is_file()


def test_a_multirun_ends_with_its_jobs_side_by_side(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    """Two widths, trained and evaluated: a table, its file and a figure, with what the jobs' own files say."""
    stages = ["stage=[train,evaluate]", "model=network", "model.width=4,6", "tuned=false", "experiment=ball_bearing"]
    monkeypatch.chdir(tmp_path)
    assert main(["-m", *stages, *CHEAP, "output=out"]) == 0
    said = capsys.readouterr().out.partition("the jobs of this command")[2]
    rows = pd.read_csv(tmp_path / "out" / "jobs.csv").set_index("job")
    assert list(rows.index) == ["model.width=4", "model.width=6"]
    assert all(job in said for job in rows.index)
    for job, row in rows.iterrows():
        folder = tmp_path / "out" / str(job).replace("=", "-")
        training, metrics = (json.loads((folder / f"{name}.json").read_text()) for name in ("training", "metrics"))
        assert (row["outcome"], row["steps"]) == (training["outcome"], training["steps"])
        errors = [of["mean_error_percent"] for node in metrics["coefficients"].values() for of in node.values()]
        assert row["worst_mean_error_percent"] == pytest.approx(max(errors))
        assert f"width: {str(job)[-1]}\n" in (folder / "config.yaml").read_text()
        assert row["held_out_loss"] == pytest.approx(training["held_out_loss"])
    assert (tmp_path / "out" / "jobs.png").stat().st_size > 1000
