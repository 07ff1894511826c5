"""A study in the eyes of who looks at it: Optuna's dashboard, and MLflow's records."""

from __future__ import annotations

import json
import os
import socket
import subprocess
import sys
import urllib.request
from collections.abc import Callable, Iterator
from contextlib import closing, contextmanager, suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import pytest
from dashboard import show
from running import BROWSER, FEW_SPEEDS, NO_BROWSER, ROOT, open_in_browser

from pipeline.config.compose import compose_config
from pipeline.config.schema import Config
from pipeline.stages import run_stage
from pipeline.tracking.store import quiet_mlflow
from studies import wait_until

pytestmark = pytest.mark.slow

STUDY = [
    "experiment=ball_bearing",
    "stage=tune",
    *FEW_SPEEDS,
    *("tuned=false", "optimizer=adam_levenberg_marquardt", "loss.scaling=per_speed", "model.parametrisation=log"),
    # So few steps that the losses of the trials differ.
    *("optimizer.adam.steps=60", "optimizer.levenberg_marquardt.steps=3"),
    *("tuning.space.adam_epochs.high=150", "tuning.space.lbfgs_epochs.high=40"),
    *("tuning.space.lm_epochs.low=2", "tuning.space.lm_epochs.high=5"),
    *("tuning.n_trials=10", "tuning.startup_trials=5", "tuning.finalists=1", "tuning.seeds=[0]"),
]


@dataclass(frozen=True)
class Studied:
    """A study with all that ``stage=tune`` makes of it."""

    config: Config
    study: Any


@pytest.fixture(scope="module")
def studied(tmp_path_factory: pytest.TempPathFactory) -> Studied:
    """Ten trials of a tenth of a second, in an SQLite file and in MLflow."""
    from pipeline.tuning.storage import open_storage

    folder = tmp_path_factory.mktemp("studied")
    places = {
        "output": folder / "data",
        "tuning.folder": folder / "study",
        "tuning.storage": f"sqlite:///{folder}/optuna.db",
        "tracking.uri": f"sqlite:///{folder}/mlflow.db",
    }
    config = compose_config([*STUDY, *(f"{key}='{place}'" for key, place in places.items())])
    run_stage(config)
    import optuna

    study = optuna.load_study(study_name=config.tuning.study, storage=open_storage(config.tuning))
    assert len({trial.value for trial in study.get_trials()}) > 5
    return Studied(config, study)


Data = Callable[[str], Any]


@contextmanager
def serve(storage: str, tmp_path: Path) -> Iterator[str]:
    """The address of ``optuna-dashboard URL``, as the last line of ``stage=tune`` says."""
    with closing(socket.create_server(("127.0.0.1", 0))) as listening:
        port = listening.getsockname()[1]
    program = Path(sys.executable).with_name("optuna-dashboard")
    command = [program, storage, "--host", "127.0.0.1", "--port", str(port)]

    def answers() -> bool:
        with suppress(OSError), urllib.request.urlopen(f"http://127.0.0.1:{port}/api/studies", timeout=30):
            return True
        assert process.poll() is None, (tmp_path / "log").read_text()
        return False

    with (tmp_path / "log").open("w") as log:
        process = subprocess.Popen(command, env=os.environ | {"HOME": str(tmp_path)}, stdout=log, stderr=log)
    try:
        wait_until(answers)
        yield f"http://127.0.0.1:{port}"
    finally:
        process.kill()
        process.wait()


@pytest.fixture
def dashboard(studied: Studied, tmp_path: Path) -> Iterator[Data]:
    """What its API answers."""
    with serve(studied.config.tuning.storage, tmp_path) as address:
        yield lambda path: json.load(urllib.request.urlopen(f"{address}/api/{path}", timeout=30))


@pytest.mark.skipif(BROWSER is None, reason=NO_BROWSER)
def test_the_committed_studies_open_in_a_browser(tmp_path: Path) -> None:
    """As ``make dashboard`` shows them: their names, and the figures of each."""
    storage = f"sqlite:///{tmp_path}/optuna.db"
    show([f"tuning.storage={storage}", "tracking=none"])
    studies = [path.parent.name for path in (ROOT / "studies").glob("*/trials.jsonl")]
    with serve(storage, tmp_path) as address:
        page, _ = open_in_browser(f"{address}/dashboard/")
        assert [name for name in studies if f"{name} (committed)" not in page] == []
        for number in range(1, len(studies) + 1):
            page, _ = open_in_browser(f"{address}/dashboard/studies/{number}")
            assert page.count("js-plotly-plot") >= 3


def test_the_dashboard_has_the_study(dashboard: Data, studied: Studied) -> None:
    """Its API: the study, its metric and note, and every trial with parameters, curve and user attributes."""
    (summary,) = dashboard("studies")["study_summaries"]
    assert (summary["study_name"], summary["directions"]) == ("ball_bearing", ["minimize"])
    detail = dashboard(f"studies/{summary['study_id']}")
    assert (detail["objective_names"], detail["has_intermediate_values"]) == (["log10 of the held-out loss"], True)
    assert detail["note"]["body"].startswith("**Question:** which hyperparameters identify kxx, kyy of `ball_bearing`")
    assert "python -m pipeline stage=tune experiment=ball_bearing" in detail["note"]["body"]
    assert {part["name"] for part in detail["union_search_space"]} <= set(studied.config.tuning.space)
    assert [trial["number"] for trial in detail["trials"]] == list(range(10))
    for shown, trial in zip(detail["trials"], studied.study.get_trials(), strict=True):
        assert shown["state"].upper() == trial.state.name
        assert {p["name"]: p["param_external_value"] for p in shown["params"]} == {
            name: str(value) for name, value in trial.params.items()
        }
        assert {v["step"]: v["value"] for v in shown["intermediate_values"]} == trial.intermediate_values
        assert {"outcome", "epochs", "held_out_loss", "training_seconds"} <= {a["key"] for a in shown["user_attrs"]}
    (default,) = (a["value"] for a in detail["trials"][0]["user_attrs"] if a["key"] == "note")
    assert default == "the configured default"


@pytest.fixture
def client(studied: Studied) -> Iterator[Any]:
    """MLflow's client on the study's database."""
    with quiet_mlflow(10.0):
        from mlflow import MlflowClient

        yield MlflowClient(studied.config.tracking.uri)


def test_mlflow_has_the_trials_below_the_study(client: Any, studied: Studied) -> None:
    """One run ``tune``, and for every trial a run below it: parameters, final metrics, learning curve, times."""
    experiment = client.get_experiment_by_name("ball_bearing").experiment_id
    (parent,) = client.search_runs([experiment], "attributes.run_name LIKE 'tune ball_bearing %'")
    children = client.search_runs([experiment], f"tags.`mlflow.parentRunId` = '{parent.info.run_id}'")
    assert len(client.search_runs([experiment])) == len(children) + 2, "besides them tune and generate"
    by_name = {run.info.run_name: run for run in children}
    trials = studied.study.get_trials()
    assert by_name.keys() == {f"trial {trial.number}" for trial in trials}
    for trial in trials:
        run = by_name[f"trial {trial.number}"]
        assert run.data.params == {name: str(value) for name, value in trial.params.items()}
        tags = (run.info.status, run.data.tags["state"], run.data.tags["outcome"])
        assert tags == ("FINISHED", trial.state.name.lower(), trial.user_attrs["outcome"])
        for name in ("held_out_loss", "training_seconds", "epochs"):
            assert run.data.metrics[name] == pytest.approx(trial.user_attrs[name], rel=1e-9)
            assert len(client.get_metric_history(run.info.run_id, name)) == 1, "no point of a curve"
        curve = {m.step: m.value for m in client.get_metric_history(run.info.run_id, "learning_curve")}
        assert curve == pytest.approx({step: 10**value for step, value in trial.intermediate_values.items()})
        assert run.info.start_time == round(1000 * trial.datetime_start.timestamp())
        assert parent.info.start_time <= run.info.start_time <= run.info.end_time <= parent.info.end_time


def test_mlflow_has_the_report_of_the_study(client: Any, studied: Studied) -> None:
    """The run ``tune``: what was promoted and counted, the configuration, figures, tables and the report."""
    experiment = client.get_experiment_by_name("ball_bearing").experiment_id
    (parent,) = client.search_runs([experiment], "attributes.run_name LIKE 'tune ball_bearing %'")
    assert (parent.info.status, parent.data.tags["study"], parent.data.params["tuning.sampler"]) == (
        "FINISHED",
        "ball_bearing",
        "tpe",
    )
    states = [trial.state.name.lower() for trial in studied.study.get_trials()]
    for state in set(states):
        assert parent.data.metrics[f"trials.{state}"] == states.count(state)
    assert parent.data.metrics["promoted_trial"] in range(10)
    files = {item.path for folder in ("figures", "files") for item in client.list_artifacts(parent.info.run_id, folder)}
    figures = ("history", "slice", "parallel_coordinates", "learning_curves", "finalists")
    tables = {"files/README.md", "files/trials.csv", "files/finalists.csv", "files/best.yaml"}
    assert tables | {f"figures/{name}.png" for name in figures} <= files
    kept = Path(client.download_artifacts(parent.info.run_id, "figures/history.png"))
    assert kept.read_bytes() == (Path(studied.config.tuning.folder) / "figures" / "history.png").read_bytes()
