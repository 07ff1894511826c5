"""Commands killed, side by side, and started by every launcher."""

from __future__ import annotations

import json
import os
import shutil
import signal
import subprocess
import time
from collections.abc import Sequence
from pathlib import Path

import numpy as np
import pytest
import test_interrupt as interrupt
import test_launchers as launchers
from conftest import ANSWER, DATA, Run
from running import ENVIRONMENT, FEW_SPEEDS, at_night, contents, names_in

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
    assert interrupt.account(folder)["seed"] in (1, 2)
    run("evaluate", compose_config([*interrupt.COARSE, *few]), folder)
    errors = json.loads((folder / "metrics.json").read_text())["coefficients"]
    assert all(error["mean_error_percent"] < 1e-10 for of in errors.values() for error in of.values())


@pytest.mark.filterwarnings("ignore:.*multi-threaded:DeprecationWarning")  # of a fork, where Python is 3.12
@pytest.mark.parametrize(
    ("stage", "of"),
    [
        ("ingest", ["experiment=measured_demo", "machine.recordings.speeds.step_rpm=200"]),
        ("identify", ["experiment=ball_bearing", *FEW_SPEEDS]),
        ("tune", ["experiment=ball_bearing", *FEW_SPEEDS, "tuning.n_trials=6", "tuning.finalists=2"]),
    ],
)
def test_a_command_is_killed_at_any_moment(stage: str, of: Sequence[str], run: Run, tmp_path: Path) -> None:
    """After SIGKILL, the same command again leaves what it leaves undisturbed, to the last bit, and nothing hidden."""
    folder = tmp_path / "x"
    run(stage, of, folder)  # which imports what the forks need
    shutil.rmtree(folder)
    begins = time.monotonic()
    run(stage, of, folder)
    whole, undisturbed = time.monotonic() - begins, _dated_alike(folder)
    for share in np.random.default_rng(30).random(50):
        shutil.rmtree(folder)
        if not (child := os.fork()):
            try:
                run(stage, of, folder)
            finally:
                os._exit(0)
        time.sleep(share * whole)
        os.kill(child, signal.SIGKILL)
        os.waitpid(child, 0)
        run(stage, of, folder)
        assert _dated_alike(folder) == undisturbed


def _dated_alike(folder: Path) -> dict[str, bytes]:
    """Everything in ``folder``, hidden files too, but what has the time of day."""
    return {name: content for name, content in contents(folder).items() if not name.startswith("report.")}
