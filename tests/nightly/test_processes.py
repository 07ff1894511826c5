"""Commands killed, side by side, and started by every launcher."""

from __future__ import annotations

import json
import subprocess
from pathlib import Path

import pytest
import test_interrupt as interrupt
import test_launchers as launchers
from conftest import ANSWER, DATA, Run
from running import ENVIRONMENT, at_night, names_in, strict_json

from pipeline.config.compose import compose_config

pytestmark = pytest.mark.slow
one_by_one = launchers.one_by_one
test_jobs_side_by_side = at_night(launchers.test_jobs_side_by_side, "launcher", [["submitit_local"]], ids="-".join)
test_a_job_that_fails_is_named = at_night(launchers.test_a_job_that_fails_is_named, "launcher", ["joblib"])


def test_two_trainings_of_one_experiment_at_once(run: Run, tmp_path: Path) -> None:
    folder = tmp_path / "x"
    few = ["optimizer.adam.steps=30", "optimizer.levenberg_marquardt.steps=10"]
    processes = [
        subprocess.Popen(
            interrupt.command(folder, *few, f"seed={seed}"),
            cwd=tmp_path,
            env=ENVIRONMENT,
            text=True,
            stdout=subprocess.PIPE,
            stderr=subprocess.PIPE,
        )
        for seed in (1, 2)
    ]
    said = [process.communicate(timeout=120) for process in processes]
    assert [process.returncode for process in processes] == [0, 0], said
    assert names_in(folder) == DATA | ANSWER
    assert strict_json(folder / "training.json")["seed"] in (1, 2)
    run("evaluate", compose_config([*interrupt.COARSE, *few]), folder)
    errors = json.loads((folder / "metrics.json").read_text())["coefficients"]
    assert all(error["mean_error_percent"] < 1e-10 for of in errors.values() for error in of.values())
