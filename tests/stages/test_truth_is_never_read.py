"""Training, and the choice of a model, never see the modelled coefficients: the truth of modelled data."""

from __future__ import annotations

import shutil
import sys
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import pytest
from conftest import ANSWER as WRITTEN
from conftest import DATA, Run, known_names

from pipeline.config.compose import compose_config
from pipeline.config.schema import Config
from pipeline.data.coefficient_files import read_coefficients
from pipeline.errors import DataError
from pipeline.problem.measurement import Measurement
from pipeline.stages import robustness, train, tune

pytestmark = [pytest.mark.slow, pytest.mark.usefixtures("no_pictures")]  # it trains, or starts processes

COARSE = [
    "tracking=none",
    *(f"machine.speeds.{key}" for key in ("start_rpm=500", "stop_rpm=5500", "step_rpm=250")),
    "optimizer.adam.steps=5",
    "optimizer.levenberg_marquardt.steps=8",
    "robustness.count=4",
    "robustness.seeds=[0,1,2]",
]
EXPERIMENTS = ["ball_bearing", "hydrostatic_damping"]
ANSWER = ["identified_coefficients.csv", "model.safetensors", "model.json", "training.json", "history.csv"]


@pytest.fixture(scope="module", params=EXPERIMENTS)
def config(request: pytest.FixtureRequest) -> Config:
    """An experiment with constants, and one with a network that held-out speeds choose."""
    return compose_config([f"experiment={request.param}", *COARSE])


@contextmanager
def watched() -> Iterator[list[Any]]:
    """What robustness trains in the block, in the order of the calls."""
    made: list[Any] = []
    real = robustness.minimise

    def spy(*arguments: Any, **options: Any) -> Any:
        made.append(real(*arguments, **options))
        return made[-1]

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(robustness, "minimise", spy)
        yield made


@dataclass(frozen=True)
class Trained:
    """An experiment trained as usual, its folder with the truth, not to be written to, and what robustness trained."""

    folder: Path
    batch: Any


@pytest.fixture(scope="module")
def honest(run: Run, config: Config, tmp_path_factory: pytest.TempPathFactory) -> Trained:
    """The experiment trained as usual."""
    folder = tmp_path_factory.mktemp("trained") / config.name
    with watched() as batches:
        for stage in ("generate", "train", "robustness"):
            run(stage, config, folder)
    (batch,) = batches
    return Trained(folder, batch)


def _other_numbers(path: Path) -> None:
    table = pd.read_csv(path)
    table.iloc[:, 2:] = -7.0 * table.iloc[:, 2:] + 1.0
    table.to_csv(path, index=False)


def _folder(path: Path) -> None:
    path.unlink()
    path.mkdir()


LIES: dict[str, Callable[[Path], object]] = {
    "removed": Path.unlink,
    "garbage": lambda path: path.write_bytes(b"\x00\xff not a table"),
    "empty": lambda path: path.write_bytes(b""),
    "other numbers": _other_numbers,
    "a folder": _folder,
}


def _lie(of: Path, lie: str, folder: Path) -> Path:
    """The data of an experiment with another truth, or none, and no answer yet."""
    folder.mkdir()
    for name in DATA:
        shutil.copy(of / name, folder / name)
    LIES[lie](folder / "modelled_coefficients.csv")
    return folder


@pytest.fixture(params=LIES)
def lied(request: pytest.FixtureRequest, honest: Trained, tmp_path: Path) -> Path:
    """The data of ``honest`` with another truth, or none, and no answer yet."""
    return _lie(honest.folder, request.param, tmp_path / "lied")


def test_training_gives_the_same_bits_with_any_truth(run: Run, config: Config, honest: Trained, lied: Path) -> None:
    """Coefficients, model, account and history are the same whatever the truth says, or without it."""
    run("train", config, lied)
    assert [name for name in ANSWER if (lied / name).read_bytes() != (honest.folder / name).read_bytes()] == []


def test_robustness_ends_at_the_same_bits_with_any_truth(run: Run, config: Config, honest: Trained, lied: Path) -> None:
    """Parameters, losses and outcomes of all starts are the same; the truth only makes the errors."""
    with watched() as batches, suppress(DataError):  # a damaged truth is refused, when training is over
        run("robustness", config, lied)
    (batch,) = batches
    assert batch.parameters.numpy().tobytes() == honest.batch.parameters.numpy().tobytes()
    assert (batch.loss.tobytes(), batch.outcomes) == (honest.batch.loss.tobytes(), honest.batch.outcomes)
    if (lied / "robustness.csv").exists():
        told, lie = (pd.read_csv(folder / "robustness.csv") for folder in (honest.folder, lied))
        same = [name for name in told if not name.endswith("_error_percent")]
        pd.testing.assert_frame_equal(told[same], lie[same])
        assert not np.array_equal(told["mean_error_percent"], lie["mean_error_percent"])


def test_known_coefficients_hold_no_unknown(config: Config, honest: Trained) -> None:
    columns = list(pd.read_csv(honest.folder / "known_coefficients.csv"))
    assert columns == ["bearing_node", "speed_rpm", *known_names(config)]
    assert not set(columns) & set(config.identify.unknowns)


def test_what_training_is_given_holds_no_unknown(
    run: Run, config: Config, honest: Trained, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The known table that reaches the equations is zero where a coefficient is unknown."""

    seen: list[Measurement] = []
    real = train.prepare
    monkeypatch.setattr(train, "prepare", lambda given: seen.append(real(given)) or seen[-1])
    run("train", config, Path(shutil.copytree(honest.folder, tmp_path / "x")))
    (measurement,) = seen
    for name in config.identify.unknowns:
        assert not measurement.known.coefficient(name).any()
    truth = read_coefficients(
        honest.folder / "modelled_coefficients.csv", measurement.rotor.bearing_nodes, measurement.dataset.speeds
    )
    for name in known_names(config):
        np.testing.assert_array_equal(measurement.known.coefficient(name), truth.coefficient(name))


class Opened:
    """Files that the process opens, by Python's audit events; one hook serves all: it can't be taken away."""

    paths: list[str] | None = None
    installed = False

    @classmethod
    def hook(cls, event: str, arguments: tuple[Any, ...]) -> None:
        if cls.paths is not None and event == "open" and isinstance(arguments[0], (str, bytes)):
            cls.paths.append(arguments[0] if isinstance(arguments[0], str) else arguments[0].decode())


@pytest.fixture
def opened() -> Iterator[list[str]]:
    """Paths opened during the test."""
    if not Opened.installed:
        sys.addaudithook(Opened.hook)
        Opened.installed = True
    Opened.paths = []
    yield Opened.paths
    Opened.paths = None


def _names(paths: list[str]) -> set[str]:
    return {Path(path).name for path in paths}


def test_robustness_opens_the_truth_after_training(
    run: Run, config: Config, honest: Trained, tmp_path: Path, opened: list[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    """The errors of robustness need the truth: it is opened when the last step is done, not before."""
    at_the_end: list[bool] = []
    real = robustness.minimise

    def spy(*arguments: Any, **options: Any) -> Any:
        batch = real(*arguments, **options)
        at_the_end.append(any("modelled_coefficients" in path for path in opened))
        return batch

    monkeypatch.setattr(robustness, "minimise", spy)
    folder = Path(shutil.copytree(honest.folder, tmp_path / "x"))
    opened.clear()
    run("robustness", config, folder)
    assert at_the_end == [False]
    assert "modelled_coefficients.csv" in _names(opened)  # and the hook does see it


# --- the output error, with model parameters; the search for hyperparameters ----------------------------

REALISTIC = ["experiment=realistic", *(one for one in COARSE if not one.startswith("robustness"))]


@pytest.fixture(scope="module")
def realistic(run: Run, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Sixteen coefficients and sixteen model parameters, by the output error."""
    folder = tmp_path_factory.mktemp("realistic") / "honest"
    for stage in ("generate", "diagnose", "train", "verdict"):
        run(stage, REALISTIC, folder)
    return folder


@pytest.mark.parametrize("lie", ["removed", "other numbers"])
def test_the_output_error_gives_the_same_bits_with_any_truth(
    run: Run, realistic: Path, lie: str, tmp_path: Path, opened: list[str]
) -> None:
    """Diagnosis, budget, verdicts, coefficients with their deviations, model parameters; no truth is opened."""
    folder = _lie(realistic, lie, tmp_path / "lied")
    opened.clear()
    for stage in ("diagnose", "train", "verdict"):
        run(stage, REALISTIC, folder)
    assert [path for path in opened if "modelled_coefficients" in path] == []
    files = [*WRITTEN, *["diagnosis.json", "diagnosis.csv", "systematic_budget.csv", "verdicts.json", "verdicts.csv"]]
    assert [name for name in files if (folder / name).read_bytes() != (realistic / name).read_bytes()] == []


@pytest.mark.parametrize(
    "study",
    [
        ["experiment=ball_bearing"],
        ["experiment=noisy_stiffness", "tuning=response", "training.holdout_every=5"],
    ],
    ids=["residual", "output error"],
)
def test_a_study_chooses_before_any_truth_is_opened(
    run: Run, study: list[str], tmp_path: Path, opened: list[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    """With another truth the trials, the finalists and the choice are the same to the last bit."""

    chosen: list[Any] = []
    real = tune.choose

    def spy(*arguments: Any) -> Any:
        chosen.append((real(*arguments), [path for path in opened if "modelled_coefficients" in path]))
        return chosen[-1][0]

    monkeypatch.setattr(tune, "choose", spy)
    base = [*study, *COARSE[:4], "tuning.n_trials=2", "tuning.finalists=1", "tuning.seeds=[0,1]"]
    run("generate", base, tmp_path / "told")
    _lie(tmp_path / "told", "other numbers", tmp_path / "lied")
    trials = []
    for name in ("told", "lied"):
        own = [f"tuning.folder={tmp_path / name / 'study'}", f"tuning.storage=sqlite:///{tmp_path / name}.db"]
        opened.clear()
        run("tune", [*base, *own], tmp_path / name)
        assert "modelled_coefficients.csv" in _names(opened)  # the report has errors, when the choice is made
        trials.append(pd.read_csv(tmp_path / name / "study" / "trials.csv"))
    same = [name for name in trials[0] if "error" not in name and "seconds" not in name]
    pd.testing.assert_frame_equal(trials[0][same], trials[1][same])
    (told, before), (lied, also_before) = chosen
    assert before == also_before == []
    assert (told.trial, told.losses.tolist()) == (lied.trial, lied.losses.tolist())
