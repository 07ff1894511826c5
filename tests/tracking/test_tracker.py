"""What a stage hands to the tracker is in MLflow afterwards, or a sentence says why it is not."""

from __future__ import annotations

import json
import os
import shutil
import socket
import sqlite3
import subprocess
import sys
import time
from contextlib import closing
from pathlib import Path
from unittest.mock import Mock

import numpy as np
import pytest
from conftest import assert_says, unknown_at_all
from running import PYTHON

import pipeline
from pipeline.config.schema import TrackingConfig
from pipeline.tracking import StageRecord, track, tracker
from pipeline.tracking.model import exemplify, tabulate_identified
from pipeline.tracking.store import prepare_database, quiet_mlflow

pytestmark = pytest.mark.slow  # it trains, or starts processes

CHECKOUT = Path(pipeline.__file__).resolve().parents[1]
STARTED, ENDED = 1_700_000_000.0, 1_700_000_060.0


def at(uri: str, timeout_seconds: float = 10.0) -> TrackingConfig:
    """Where to log."""
    return TrackingConfig(enabled=True, uri=uri, timeout_seconds=timeout_seconds)


def record(**changes: object) -> StageRecord:
    """A small stage's record, with ``changes``."""
    of = {"experiment": "rotor rig", "stage": "train", "started": STARTED, "ended": ENDED}
    return StageRecord(**(of | {"parameters": {"seed": 3}, "tags": {}, "metrics": {}} | changes))


@pytest.fixture(scope="session")
def fresh_database(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A database just made: making one takes two seconds, copying it none."""
    path = tmp_path_factory.mktemp("fresh") / "mlflow.db"
    with quiet_mlflow(10.0):
        prepare_database(path, 10.0)
    return path


@pytest.fixture
def settings(fresh_database: Path, tmp_path: Path) -> TrackingConfig:
    """A database of the test's own, in a folder with spaces."""
    folder = tmp_path / "my project"
    folder.mkdir()
    shutil.copy(fresh_database, folder / "mlflow.db")
    return at(f"sqlite:///{folder}/mlflow.db")


def clean_environment() -> dict[str, str]:
    """The environment without what would let a new process find this checkout or a tracking store."""
    return {name: value for name, value in os.environ.items() if name != "PYTHONPATH" and "MLFLOW_TRACKING" not in name}


def python(code: str, *arguments: object, folder: Path) -> subprocess.CompletedProcess[str]:
    """Run ``code`` in a new interpreter in ``folder``, with warnings as errors."""
    command = [*PYTHON, "-c", code, *map(str, arguments)]
    return subprocess.run(command, cwd=folder, capture_output=True, text=True, timeout=120, env=clean_environment())


class Logged:
    """The runs in a store, as MLflow's own client reads them."""

    def __init__(self, settings: TrackingConfig) -> None:
        with quiet_mlflow(10.0):
            from mlflow import MlflowClient

            self.client = MlflowClient(settings.uri)
            self.runs = self.client.search_runs([e.experiment_id for e in self.client.search_experiments()])

    @property
    def run(self):
        (run,) = self.runs
        return run

    def files(self) -> dict[str, Path]:
        """Every artifact of the one run by its name in MLflow."""
        root = Path(self.client.download_artifacts(self.run.info.run_id, ""))
        return {path.relative_to(root).as_posix(): path for path in root.rglob("*") if path.is_file()}


def test_everything_in_a_record_is_read_back(
    settings: TrackingConfig,
    tmp_path: Path,
    capfd: pytest.CaptureFixture[str],
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    elsewhere = tmp_path / "elsewhere"
    elsewhere.mkdir()
    monkeypatch.chdir(elsewhere)
    table, figure = tmp_path / "identified_coefficients.csv", tmp_path / "loss.png"
    table.write_text("bearing_node,kxx\n3,1e7\n")
    figure.write_bytes(b"\x89PNG")
    history = [{"step": step, "loss": 1 / step, "held_out_loss": 2 / step, "phase": "adam"} for step in range(1, 601)]

    full = record(
        parameters={"model": {"hidden": [8, 8], "activation": "tanh"}, "data": {"file": None}, "seed": 3},
        title="train rig seed=3",
        data=tmp_path / "vibration.parquet",
        tags={"data_fingerprint": "abc", "pipeline.group": "g1"},
        metrics={"coefficients/kxx/mean_error_percent": 1.5},
        history=history,
        files=[table, figure],
    )
    assert track(full, settings) == []
    assert capfd.readouterr() == ("", "")
    logged = Logged(settings)
    run = logged.run
    assert logged.client.get_experiment(run.info.experiment_id).name == "rotor rig"
    assert (run.info.run_name, run.info.status) == ("train rig seed=3", "FINISHED")
    ((kept, source),) = ((read.dataset, json.loads(read.dataset.source)) for read in run.inputs.dataset_inputs)
    assert (kept.name, kept.digest, source["uri"]) == ("rotor rig", "abc", str(tmp_path / "vibration.parquet"))
    assert (run.info.start_time, run.info.end_time) == (1000 * STARTED, 1000 * ENDED)
    assert run.data.params == {
        "model.hidden": "[8, 8]",
        "model.activation": "tanh",
        "data.file": "null",
        "seed": "3",
    }
    for tag, value in {
        **{"data_fingerprint": "abc", "pipeline.experiment": "rotor rig", "pipeline.stage": "train"},
        **{"version.torch": "2.", "version.python": "3."},
    }.items():
        assert run.data.tags[tag].startswith(value)
    assert run.data.metrics["coefficients/kxx/mean_error_percent"] == 1.5
    losses = logged.client.get_metric_history(run.info.run_id, "loss")
    assert [(loss.step, loss.value) for loss in losses] == [(row["step"], row["loss"]) for row in history]
    assert STARTED < losses[0].timestamp / 1000 < losses[-1].timestamp / 1000 <= ENDED
    assert run.data.metrics.keys() == {"coefficients/kxx/mean_error_percent", "loss", "held_out_loss"}
    files = logged.files()
    assert files.keys() == {"config.yaml", "files/identified_coefficients.csv", "figures/loss.png"}
    assert files["files/identified_coefficients.csv"].read_text() == table.read_text()
    assert "activation: tanh" in files["config.yaml"].read_text()
    assert list(elsewhere.iterdir()) == [], "artifacts belong beside the database"
    assert (tmp_path / "my project" / "mlruns" / "rotor rig" / run.info.run_id).is_dir()


def test_long_values_many_parameters_files_of_one_name_and_a_status(settings: TrackingConfig, tmp_path: Path) -> None:
    files = [tmp_path / folder / "metrics.json" for folder in ("a", "b")]
    for file in files:
        file.parent.mkdir()
        file.write_text(str(file))
    parameters = {"long": "x" * 20_000, "many": {f"p{i}": i for i in range(250)}}
    long = record(parameters=parameters, tags={"long": "y" * 20_000}, files=files, status="KILLED")
    assert track(long, settings) == []
    logged = Logged(settings)
    assert (logged.run.info.status, len(logged.run.data.params)) == ("KILLED", 251)
    assert {"files/metrics.json", "files/b/metrics.json"} <= logged.files().keys()
    assert (logged.run.data.params["long"][-6:], logged.run.data.tags["long"][-6:]) == ("xxx...", "yyy...")
    assert "x" * 20_000 in logged.files()["config.yaml"].read_text()


def test_disabled_tracking_does_nothing(tmp_path: Path) -> None:
    code = (
        "import sys\n"
        "from pipeline.tracking import *\n"
        "from pipeline.config.schema import TrackingConfig\n"
        "off = TrackingConfig(enabled=False, uri='sqlite:///x.db', timeout_seconds=10)\n"
        "problems = track(StageRecord(experiment='e', stage='s', ended=1.0), off)\n"
        "assert problems == []\n"
        "heavy = {'mlflow', 'pandas', 'torch', 'filelock', 'yaml'} & sys.modules.keys()\n"
        "assert not heavy, heavy\n"
    )
    done = python(f"import sys; sys.path.insert(0, {str(CHECKOUT)!r})\n{code}", folder=tmp_path)
    assert done.returncode == 0, done.stderr
    assert list(tmp_path.iterdir()) == []


def test_values_that_are_not_finite_are_named(settings: TrackingConfig) -> None:
    history = [{"step": 0, "loss": 1.0}, {"step": 1, "loss": float("nan")}]
    (problem,) = track(record(metrics={"good": 1.0, "bad": float("inf")}, history=history), settings)
    assert "the values of bad, loss that are not finite" in problem
    assert Logged(settings).run.data.metrics == {"good": 1.0, "loss": 1.0}


def test_a_part_that_fails_does_not_take_the_others_with_it(settings: TrackingConfig, tmp_path: Path) -> None:
    gone = record(
        files=[tmp_path / "gone.csv"], model=tmp_path / "no model", tags={"good": "x"}, metrics={"bad": "three"}
    )
    assert [problem.partition(" of stage")[0] for problem in track(gone, settings)] == [
        "MLflow does not have the model",
        "MLflow does not have the metrics",
        f"MLflow does not have the file {tmp_path / 'gone.csv'}",
    ]
    run = Logged(settings).run
    assert (run.data.tags["good"], run.info.status) == ("x", "FINISHED")


def test_interrupt_passes_through_and_marks_the_run(settings: TrackingConfig, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(tracker, "collect_history", Mock(side_effect=KeyboardInterrupt))
    with pytest.raises(KeyboardInterrupt):
        track(record(), settings)
    assert Logged(settings).run.info.status == "KILLED"


def test_deleted_experiment(settings: TrackingConfig) -> None:
    assert track(record(), settings) == []
    logged = Logged(settings)
    logged.client.delete_experiment(logged.run.info.experiment_id)
    (problem,) = track(record(), settings)
    assert_says(problem, "'rotor rig' was deleted", "mlflow experiments restore")


@pytest.mark.parametrize("uri", ["http://127.0.0.1:9", "http://anna:secret@127.0.0.1:9"])
def test_unreachable_server(uri: str) -> None:
    (problem,) = track(record(), at(uri, timeout_seconds=2.0))
    assert problem.startswith("Stage 'train' of 'rotor rig' is not in MLflow (http://")
    assert_says(problem, "can't be reached (connection refused)", "tracking.enabled=false")
    assert "secret" not in problem


@pytest.mark.usefixtures("quiet")
def test_server_that_never_answers() -> None:
    with socket.create_server(("127.0.0.1", 0)) as server:
        (problem,) = track(record(), at(f"http://127.0.0.1:{server.getsockname()[1]}", timeout_seconds=1.0))
    assert "no answer within 1 s" in problem


def _foreign(path: Path) -> None:
    with closing(sqlite3.connect(path)) as connection:
        connection.execute("CREATE TABLE trials (number)")


def _below_a_file(path: Path) -> None:
    path.parent.rmdir()
    path.parent.write_text("a file")


@pytest.mark.parametrize(
    ("spoil", "reason"),
    [
        (
            lambda path: path.write_bytes(bytes(range(256)) * 100),
            "is not a sound SQLite database (file is not a database); move it away",
        ),
        (_foreign, "is a database, but not MLflow's"),
        (_below_a_file, "can't be made there"),
        (Path.mkdir, "can't be made there"),
    ],
)
def test_unusable_database(spoil, reason: str, tmp_path: Path) -> None:
    path = tmp_path / "folder" / "mlflow.db"
    path.parent.mkdir()
    spoil(path)
    (problem,) = track(record(), at(f"sqlite:///{path}"))
    assert_says(problem, reason, str(path))


def test_locked_database(settings: TrackingConfig) -> None:
    with closing(sqlite3.connect(settings.uri.removeprefix("sqlite:///"), isolation_level=None)) as other:
        other.execute("BEGIN IMMEDIATE")
        (problem,) = track(record(), at(settings.uri, timeout_seconds=0.2))
    assert "database is locked" in problem


@pytest.mark.parametrize("uri", ["sqlite://", "sqlite:///:memory:", "sqlite:///a.db?mode=ro", "nonsense://x", ""])
def test_uri_that_names_no_store(uri: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    (problem,) = track(record(), at(uri))
    assert "is not in MLflow" in problem
    assert list(tmp_path.iterdir()) == []


def test_two_processes_make_a_fresh_database_together(tmp_path: Path) -> None:
    code = """if True:
        import sys, time
        from pathlib import Path
        sys.path.insert(0, sys.argv[1])
        from pipeline.config.schema import TrackingConfig
        from pipeline.tracking import StageRecord, track
        from pipeline.tracking.store import quiet_mlflow
        with quiet_mlflow(10.0):
            from mlflow.store.tracking import sqlalchemy_store
        Path(f"ready-{sys.argv[2]}").touch()
        while not Path("go").exists():
            time.sleep(0.001)
        settings = TrackingConfig(enabled=True, uri="sqlite:///mlflow.db", timeout_seconds=10.0)
        print(track(StageRecord(
            {"m": 1.0}, experiment="e", stage=sys.argv[2], started=1.0, ended=2.0, parameters={"a": 1}
        ), settings))
    """
    command = [sys.executable, "-W", "error", "-c", code, str(CHECKOUT)]
    processes = [
        subprocess.Popen(
            [*command, name],
            cwd=tmp_path,
            text=True,
            stdout=subprocess.PIPE,
            stderr=subprocess.PIPE,
            env=clean_environment(),
        )
        for name in ("a", "b")
    ]
    try:
        deadline = time.monotonic() + 60
        while not all((tmp_path / f"ready-{name}").exists() for name in ("a", "b")):
            assert time.monotonic() < deadline
            time.sleep(0.01)
        (tmp_path / "go").touch()
        outputs = [process.communicate(timeout=60) for process in processes]
    finally:
        for process in processes:
            process.kill()
            process.wait()
    assert outputs == [("[]\n", "")] * 2
    assert {run.info.run_name for run in Logged(at(f"sqlite:///{tmp_path}/mlflow.db")).runs} == {"a", "b"}
    assert not list(tmp_path.glob("mlflow.db-new*"))


@pytest.fixture(scope="session")
def model_folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A network with two bearings of its own, saved as the train stage saves it."""
    import torch

    from pipeline.identification.identified import IdentifiedModel
    from pipeline.identification.model import CoefficientModel
    from pipeline.identification.storage import save_model

    model = CoefficientModel(
        unknowns=("kxx", "cyy"),
        inputs=("speed",),
        parametrisation="scaled",
        scale=((2e7, 3e4), (5e7, 6e4)),
        hidden=(3,),
        ranges=((100.0, 500.0),),
    )
    numbers = torch.linspace(-1.0, 1.0, 2 * model.n_parameters, dtype=torch.float64)
    folder = tmp_path_factory.mktemp("a model")
    save_model(folder, IdentifiedModel(model, unknown_at_all((3, 7), model.unknowns), (3, 7), numbers.reshape(2, -1)))
    return folder


def test_logged_model_predicts_in_a_new_process(settings: TrackingConfig, model_folder: Path, tmp_path: Path) -> None:
    from pipeline.identification.storage import load_model

    folder = shutil.copytree(model_folder, tmp_path / "model")
    assert track(record(model=folder, example=exemplify(load_model(folder))), settings) == []
    shutil.rmtree(folder)
    run = Logged(settings).run
    (output,) = run.outputs.model_outputs
    code = """if True:
        import sys, warnings
        with warnings.catch_warnings():
            # MLflow's own: at the import of its models, and at the first use of its database.
            warnings.filterwarnings("ignore", ".*Any type hint is inferred as AnyType", UserWarning)
            warnings.filterwarnings("ignore", "The ``noload`` loader strategy", DeprecationWarning)
            import mlflow, pandas
            mlflow.set_tracking_uri(sys.argv[1])
            models = [mlflow.pyfunc.load_model(uri) for uri in sys.argv[2:]]
        speeds = pandas.DataFrame({"speed_rpm": [1500.0, 3000.0]})
        for model in models:
            print(model.predict(speeds).to_json(double_precision=15))
        import pipeline
        print(pipeline.__file__)
        assert not {"ross", "hydra", "omegaconf", "optuna"} & sys.modules.keys(), "not among the requirements"
    """
    uris = f"models:/{output.model_id}", f"runs:/{run.info.run_id}/model"
    done = python(code, settings.uri, *uris, folder=tmp_path)
    assert done.returncode == 0, done.stderr
    *tables, package = done.stdout.splitlines()
    assert not Path(package).is_relative_to(CHECKOUT), "the model brings its own code"
    expected = tabulate_identified(load_model(model_folder), np.array([1500.0, 3000.0]))
    assert len(tables) == 2
    for table in map(json.loads, tables):
        assert list(table) == ["bearing_node", "speed_rpm", "kxx", "cyy"]
        assert list(table["bearing_node"].values()) == [3, 3, 7, 7]
        for name in ("speed_rpm", "kxx", "cyy"):
            np.testing.assert_allclose(list(table[name].values()), expected[name], rtol=1e-12)


def test_logged_model_says_what_it_is(settings: TrackingConfig, model_folder: Path, quiet: None) -> None:
    from pipeline.identification.storage import load_model

    example = exemplify(load_model(model_folder))
    assert track(record(model=model_folder, example=example, metrics={"loss": 0.5}), settings) == []
    from mlflow.models import Model

    logged = Logged(settings)
    (output,) = logged.run.outputs.model_outputs
    model = logged.client.get_logged_model(output.model_id)
    assert (model.status, model.params) == ("READY", {"seed": "3"})
    assert [(metric.key, metric.value) for metric in model.metrics] == [("loss", 0.5)]
    artifacts = Path(model.artifact_location.removeprefix("file://").replace("%20", " "))
    description = Model.load(str(artifacts))
    assert description.signature.inputs.input_names() == ["speed_rpm"]
    assert description.signature.outputs.input_names() == ["bearing_node", "speed_rpm", "kxx", "cyy"]
    names = {path.name for path in artifacts.rglob("*")}
    assert {"model.safetensors", "model.json", "predictor.py", "input_example.json"} <= names
    assert not [name for name in names if name.endswith((".pkl", ".pyc"))]
    requirements = (artifacts / "requirements.txt").read_text().split()
    assert {requirement.partition("==")[0] for requirement in requirements} >= {
        "torch",
        "safetensors",
        "numpy",
        "pandas",
    }
    assert not [requirement for requirement in requirements if "+" in requirement]


def test_model_is_logged_without_a_look_through_all_packages(
    settings: TrackingConfig, model_folder: Path, quiet: None
) -> None:
    from mlflow.utils import environment, requirements_utils

    from pipeline.identification.storage import load_model

    check = environment.warn_dependency_requirement_mismatches
    assert track(record(model=model_folder, example=exemplify(load_model(model_folder))), settings) == []
    assert requirements_utils._PACKAGES_TO_MODULES is None
    assert environment.warn_dependency_requirement_mismatches is check


def test_parts_are_given_up_once_failures_have_taken_the_time() -> None:
    def slow_failure() -> None:
        time.sleep(0.02)
        raise OSError("no answer")

    parts = [("the metrics", slow_failure), ("the history", lambda: pytest.fail("tried"))]
    assert tracker.try_parts(parts, "train", patience_seconds=0.01) == [
        "MLflow does not have the metrics of stage 'train': no answer.",
        "MLflow took too long to answer, so these were not tried: the history.",
    ]
