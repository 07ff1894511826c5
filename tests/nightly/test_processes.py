"""Commands killed, side by side, and started by every launcher."""

from __future__ import annotations

import json
import signal
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
import test_interrupt as interrupt
import test_launchers as launchers
from conftest import ANSWER, DATA, Run
from running import ENVIRONMENT, at_night, names_in, python

from pipeline.config.compose import compose_config
from pipeline.identification.storage import load_model
from studies import CHEAP

pytestmark = pytest.mark.slow
one_by_one = launchers.one_by_one
test_jobs_side_by_side = at_night(launchers.test_jobs_side_by_side, "launcher", [["submitit_local"]], ids="-".join)
test_a_job_that_fails_is_named = at_night(launchers.test_a_job_that_fails_is_named, "launcher", ["joblib"])


TELLING = """
import sys
from contextlib import contextmanager
from pipeline.__main__ import main
from pipeline.stages import train

@contextmanager
def progress(name):
    yield lambda phase, step, total, loss: print("training", flush=True) if step == 50 else None

train.training_progress = progress
sys.exit(main(sys.argv[1:]))
"""


def test_an_interrupt_without_a_terminal(tmp_path: Path) -> None:
    arguments = interrupt.command(tmp_path / "x", *interrupt.LONG)[5:]
    with subprocess.Popen(
        [sys.executable, "-W", "error", "-c", TELLING, *arguments],
        cwd=tmp_path,
        env=ENVIRONMENT,
        text=True,
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        # A shell's background job hands down an ignored SIGINT.
        preexec_fn=lambda: signal.signal(signal.SIGINT, signal.default_int_handler),
    ) as process:
        assert process.stdout is not None
        said = []
        while (line := process.stdout.readline()) not in ("training\n", ""):  # generate speaks first
            said.append(line)
        process.send_signal(signal.SIGINT)
        out, err = process.communicate(timeout=30)
    assert process.returncode == 130, said
    assert "Traceback" not in err
    assert "interrupted: the best state so far was kept" in out
    assert names_in(tmp_path / "x") == DATA | ANSWER
    assert np.isfinite(load_model(tmp_path / "x").values(np.array([100.0]))).all()


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


def test_experiments_side_by_side(tmp_path: Path) -> None:
    """Two experiments of different machines, models and optimisers: each in the folder of its name."""
    names = ("ball_bearing", "hydrostatic_stiffness")
    experiments = f"experiment={','.join(names)}"
    done = python("-m", "pipeline", "-m", "stage=train", experiments, "hydra/launcher=joblib", *CHEAP, cwd=tmp_path)
    assert done.returncode == 0, done.stderr
    assert "Traceback" not in done.stderr
    for number, name in enumerate(names, start=1):
        assert f"[{number}/2] stage=train experiment={name} " in done.stdout
        assert {path.name for path in (tmp_path / "artifacts" / name).iterdir()} == DATA | ANSWER
    models = [load_model(tmp_path / "artifacts" / name) for name in names]
    assert [bool(model.model.hidden) for model in models] == [False, True]
    assert {path.name for path in tmp_path.iterdir()} == {"artifacts"}
