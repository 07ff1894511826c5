"""The command line: help, sentences, exit codes, multiruns. No stage runs here; fakes stand in for them."""

from __future__ import annotations

import os
import pickle
import signal
import subprocess
import sys
from collections.abc import Callable
from contextlib import nullcontext
from pathlib import Path

import pytest
from conftest import assert_says
from running import ENVIRONMENT, PYTHON, python

from pipeline import __version__
from pipeline.__main__ import Job, main
from pipeline.config.compose import compose_config, expand_sweeps
from pipeline.config.loader import list_options
from pipeline.config.schema import Config
from pipeline.errors import DataError
from pipeline.stages import STAGES
from studies import FOREIGN

COMMAND = [*PYTHON, "-m", "pipeline"]
HEAVY = {"torch", "ross", "pandas", "numpy", "mlflow", "pint", "pydantic", "hydra", "optuna"}

Run = Callable[[Config], None]


@pytest.fixture
def runs(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> list[Config]:
    """The configurations that a fake ``run_stages`` was called with, in a folder of its own."""
    seen: list[Config] = []
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr("pipeline.stages.run_stages", seen.extend)
    monkeypatch.setattr("pipeline.tracking.recorder_beside", nullcontext)  # MLflow takes seconds to start
    return seen


def _failing(monkeypatch: pytest.MonkeyPatch, error: BaseException, where: Run = lambda config: None) -> None:
    def run_stages(configs: list[Config]) -> None:
        where(configs[0])
        raise error

    monkeypatch.setattr("pipeline.stages.run_stages", run_stages)


@pytest.mark.parametrize("option", ["--help", "-h"])
def test_help_names_every_stage_and_experiment(option: str, capsys: pytest.CaptureFixture[str]) -> None:
    assert main([option]) == 0
    words = capsys.readouterr().out
    assert_says(words, *STAGES, *list_options("experiment"), "--cfg job", "artifacts/NAME", "-m")
    assert all(len(line) <= 110 for line in words.splitlines())


def test_help_imports_nothing_heavy_and_is_no_mistake(tmp_path: Path) -> None:
    code = (
        f"import sys, pipeline.__main__ as m; code = m.main(['-h']); print({HEAVY} & set(sys.modules)); sys.exit(code)"
    )
    answer = python("-c", code, cwd=tmp_path)
    assert (answer.returncode, answer.stderr) == (0, "")
    assert answer.stdout.splitlines()[-1] == "set()"


@pytest.mark.slow
def test_a_stage_may_compose_while_it_runs(
    runs: list[Config], monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr(
        "pipeline.stages.run_stages", lambda configs: print(configs[0].seed, compose_config(["seed=9"]).seed)
    )
    assert (main(["seed=1"]), capsys.readouterr().out) == (0, "1 9\n")


MISTAKES = [
    (["stage=trian"], ["stage must be one of the stages", "'trian'", "did you mean 'train'?"]),
    (["-m", "seed=1,x"], ["seed: must be a valid integer, but got 'x'", "--cfg job"]),
    (["-m", "seed=1,1"], ["folders of their own", "'artifacts/hydrostatic_stiffness/seed-1'"]),
    (["-m", "experiment=glob(*)", "output=same"], ["folders of their own", "'same'", "${name}"]),
    (["--nothing"], ["the options must be Hydra's", "--nothing", "--help"]),
    (["--config-name=other"], ["conf/config.yaml"]),
    (["-m", "--cfg", "job"], ["more than one of"]),
    (["--resolve"], ["--cfg job"]),
    (["-m", "hydra/launcher=joblib", "stage=train,evaluate"], ["one after the other"]),
]


@pytest.mark.slow
@pytest.mark.parametrize(("arguments", "fragments"), MISTAKES)
def test_a_mistake_is_answered_before_anything_runs(
    arguments: list[str], fragments: list[str], runs: list[Config], capsys: pytest.CaptureFixture[str]
) -> None:
    assert main(arguments) == 2
    out, err = capsys.readouterr()
    assert (out, runs, list(Path().iterdir())) == ("", [], [])
    assert [fragment for fragment in fragments if fragment not in err] == []
    assert [word for word in FOREIGN if word in err] == []


@pytest.mark.slow
@pytest.mark.parametrize(
    ("arguments", "code", "words"),
    [
        (["--version"], 0, f"{__version__}\n"),
        (["seed=77", "--cfg", "job"], 0, "seed: 77"),
        (["--cfg", "job", "--package", "nothing"], 2, ""),
        (["hydra.run.dir=${nothing}"], 2, "nothing"),
    ],
)
def test_what_is_answered_without_a_run(
    arguments: list[str], code: int, words: str, runs: list[Config], capsys: pytest.CaptureFixture[str]
) -> None:
    """Also what only Hydra can see is a sentence."""
    assert main(arguments) == code
    assert words in capsys.readouterr()[bool(code)]
    assert runs == []


@pytest.mark.slow
@pytest.mark.parametrize(
    ("error", "code", "fragment"),
    [
        (DataError("a column must be there, but is not; add it"), 2, "a column must be there"),
        (
            OSError(28, "No space left on device", "artifacts/x"),
            2,
            "'artifacts/x' must be readable or writable",
        ),
        (SystemExit(1), 1, ""),
        (KeyboardInterrupt(), 130, "interrupted"),
        (ZeroDivisionError("boom"), 70, "ZeroDivisionError: boom"),
    ],
    ids=lambda value: type(value).__name__ if isinstance(value, BaseException) else None,
)
def test_exit_code_of_what_a_stage_raises(
    error: BaseException,
    code: int,
    fragment: str,
    runs: list[Config],
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    _failing(monkeypatch, error)
    assert main([]) == code
    out, err = capsys.readouterr()
    assert fragment in err
    assert (bool(fragment), out) == (bool(err), "")
    assert ("Traceback" in err) == ("please report" in err) == (code == 70), "a bug keeps its traceback"


@pytest.mark.slow
def test_an_interrupt_in_a_real_process(tmp_path: Path) -> None:
    code = (
        "import sys, time, pipeline.stages, pipeline.__main__ as command\n"
        "pipeline.stages.run_stages = lambda configs: (print('ready', flush=True), time.sleep(60))\n"
        "sys.exit(command.main([]))"
    )
    with subprocess.Popen(
        [sys.executable, "-c", code],
        cwd=tmp_path,
        env=ENVIRONMENT,
        text=True,
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        # A shell's background job hands down an ignored SIGINT.
        preexec_fn=lambda: signal.signal(signal.SIGINT, signal.default_int_handler),
    ) as process:
        assert process.stdout.readline() == "ready\n"
        process.send_signal(signal.SIGINT)
        _, err = process.communicate(timeout=20)
    assert process.returncode == 130
    assert err.startswith("interrupted")
    assert "Traceback" not in err


@pytest.mark.skipif(not Path("/dev/full").exists(), reason="needs /dev/full")
def test_an_output_that_is_full(tmp_path: Path) -> None:
    with open("/dev/full", "w") as full:
        answer = subprocess.run(
            [*COMMAND, "-h"], cwd=tmp_path, env=ENVIRONMENT, text=True, stdout=full, stderr=subprocess.PIPE
        )
    assert answer.returncode == 2
    assert "No space left on device" in answer.stderr
    assert "Traceback" not in answer.stderr


def test_an_output_that_is_closed(tmp_path: Path) -> None:
    reader, writer = os.pipe()
    os.close(reader)
    answer = subprocess.run(
        [*COMMAND, "-h"], cwd=tmp_path, env=ENVIRONMENT, text=True, stdout=writer, stderr=subprocess.PIPE
    )
    os.close(writer)
    assert (answer.returncode, answer.stderr) == (141, "")


@pytest.mark.slow
def test_a_run_stays_in_its_folder_and_writes_nothing_of_its_own(runs: list[Config], tmp_path: Path) -> None:
    before = list(sys.argv), dict(os.environ), Path.cwd()
    assert main(["seed=5", "output=my folder/x"]) == 0
    assert [(config.seed, config.output) for config in runs] == [(5, "my folder/x")]
    assert (list(sys.argv), dict(os.environ), Path.cwd()) == before
    assert list(tmp_path.iterdir()) == []


@pytest.mark.slow
def test_how_the_configuration_was_composed_is_printed(tmp_path: Path) -> None:
    answer = python(
        "-m", "pipeline", "seed=77", "--info", "config", cwd=tmp_path
    )  # it prints through a logger that would stay
    assert (answer.returncode, answer.stderr, list(tmp_path.iterdir())) == (0, "", [])
    assert "seed: 77" in answer.stdout


@pytest.mark.slow
def test_each_job_has_a_folder_named_by_what_was_swept(
    runs: list[Config], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert main(["threads=1", "-m", "seed=1,2", "optimizer.adam.steps=5", "experiment=ball_bearing"]) == 0
    assert [config.output for config in runs] == [f"artifacts/ball_bearing/seed-{seed}" for seed in (1, 2)]
    assert "-> artifacts/ball_bearing/seed-2\n" in capsys.readouterr().out
    assert [path.name for path in tmp_path.iterdir()] == ["artifacts"]
    assert {path.name for path in (tmp_path / "artifacts").iterdir()} == {".multirun", "ball_bearing"}
    assert [[path.name for path in Path(config.output).iterdir()] for config in runs] == [["config.yaml"]] * 2


@pytest.mark.parametrize(
    ("overrides", "names"),
    [
        (["experiment=ball_bearing,hydrostatic_stiffness", "stage=train,evaluate"], ["out"] * 4),
        (["name=a,b"], ["out", "out"]),
        (["output=a b,c"], ["out", "out"]),
        (["seed=3", "+threads=2"], ["out"]),
        (["seed=1,2", "hydra.sweep.dir=x"], ["out/seed-1", "out/seed-2"]),
        (["name=a,b", "seed=range(1,3)"], ["out/seed-1", "out/seed-2"] * 2),
        (["machine=one_disc,two_discs", "seed=7"], ["out/machine-one_disc", "out/machine-two_discs"]),
        (["experiment=glob(ball*)"], ["out"]),
    ],
)
def test_folders_say_what_was_swept(overrides: list[str], names: list[str]) -> None:
    jobs, fixed = expand_sweeps(overrides)
    assert [Job(True, fixed).folder("out", job) for job in jobs] == names


@pytest.mark.slow
def test_the_stages_of_an_experiment_share_its_folder(runs: list[Config]) -> None:
    assert main(["hydra.mode=MULTIRUN", "stage=train,evaluate", "name=a"]) == 0
    assert [(config.stage, config.output) for config in runs] == [
        ("train", "artifacts/a"),
        ("evaluate", "artifacts/a"),
    ]


def test_values_that_are_no_file_names_get_folders_of_their_own(runs: list[Config]) -> None:
    jobs, fixed = expand_sweeps(["machine.rotor.shaft.0.length=150 mm,150/mm,'150:mm'", "seed=3"])
    folders = [Job(True, fixed, len(jobs)).folder("out", job) for job in jobs]
    assert len(set(folders)) == len(jobs) == 3
    assert all(Path(folder).parent == Path("out") and " " not in folder for folder in folders)
    assert len(Path(Job(True).folder("out", ["data.vibration=" + "x" * 300])).name) < 255


@pytest.mark.slow
def test_a_failing_job_lets_the_others_run_and_fails_the_command(
    runs: list[Config], monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    def run_stages(configs: list[Config]) -> None:
        runs.extend(configs)
        if configs[0].seed == 2:
            raise DataError("the data must be there, but are not; make them")

    monkeypatch.setattr("pipeline.stages.run_stages", run_stages)
    assert main(["-m", "seed=2,3"]) == 2
    assert [config.seed for config in runs] == [2, 3]
    err = capsys.readouterr().err
    assert_says(err, "the data must be there", "[1/2] seed=2 failed")
    assert "Traceback" not in err


@pytest.mark.slow
def test_an_interrupt_ends_a_multirun(runs: list[Config], monkeypatch: pytest.MonkeyPatch) -> None:
    _failing(monkeypatch, KeyboardInterrupt(), runs.append)
    assert main(["-m", "seed=1,2"]) == 130
    assert len(runs) == 1


def test_workers_find_the_job_by_name() -> None:
    job = Job(multirun=True, fixed=frozenset({"seed"}), count=2)
    assert Job.__module__ == "pipeline.__main__"
    assert pickle.loads(pickle.dumps(job)) == job
