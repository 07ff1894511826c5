"""A study in the eyes of who looks at it: Optuna's dashboard in a real browser, and MLflow's records."""

from __future__ import annotations

import json
import os
import shutil
import socket
import subprocess
import sys
import time
import urllib.request
from collections.abc import Iterator
from contextlib import closing, suppress
from dataclasses import dataclass
from html.parser import HTMLParser
from pathlib import Path
from typing import Any

import pytest

from pipeline.config.compose import compose_config
from pipeline.config.schema import Config
from pipeline.stages import run_stage
from pipeline.tracking.quiet import quiet_mlflow

pytestmark = pytest.mark.slow

STUDY = [
    "experiment=ball_bearing",
    "stage=tune",
    *(f"excitation.speeds.{key}" for key in ("start_rpm=500", "stop_rpm=5500", "step_rpm=500")),
    # So few steps that the losses of the trials differ.
    *("optimizer.adam.steps=60", "optimizer.levenberg_marquardt.steps=3"),
    *("tuning.space.adam_epochs.high=150", "tuning.space.lbfgs_epochs.high=40"),
    *("tuning.space.lm_epochs.low=2", "tuning.space.lm_epochs.high=5"),
    *("tuning.n_trials=10", "tuning.startup_trials=5", "tuning.finalists=1", "tuning.seeds=[0]"),
]
BROWSER = next(filter(None, map(shutil.which, ("chromium", "chromium-browser", "google-chrome"))), None)


@dataclass(frozen=True)
class Studied:
    """A study with all that ``stage=tune`` makes of it."""

    config: Config
    study: Any

    @property
    def best(self) -> Any:
        """Its best trial."""
        return self.study.best_trial


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


# --- Optuna's dashboard ----------------------------------------------------------------------------


class _Texts(HTMLParser):
    """The texts of a page, each in its element."""

    def __init__(self) -> None:
        super().__init__()
        self.inside: list[str] = []
        self.texts: list[tuple[str, str]] = []

    def handle_starttag(self, tag: str, attrs: object) -> None:
        self.inside.append(tag)

    def handle_endtag(self, tag: str) -> None:
        while tag in self.inside and self.inside.pop() != tag:
            pass

    def handle_data(self, data: str) -> None:
        element = self.inside[-1] if self.inside else ""
        if data.strip() and element not in ("style", "script"):
            self.texts.append((element, " ".join(data.split())))


@dataclass(frozen=True)
class Page:
    """What a browser shows."""

    texts: list[tuple[str, str]]

    def __contains__(self, text: str) -> bool:
        return text in " | ".join(words for _, words in self.texts)


@dataclass(frozen=True)
class Dashboard:
    """A running dashboard."""

    address: str
    home: Path

    def data(self, path: str) -> Any:
        """What its own API answers."""
        with urllib.request.urlopen(f"{self.address}/api/{path}", timeout=30) as answer:
            return json.load(answer)

    @property
    def study(self) -> int:
        """The number of its only study."""
        return int(self.data("studies")["study_summaries"][0]["study_id"])

    def page(self, path: str) -> Page:
        """A page with its data, as the browser shows it."""
        quiet = ("background-networking", "component-update", "sync", "quic", "gpu")
        command = [
            *(str(BROWSER), "--headless", "--no-sandbox", "--no-first-run", *(f"--disable-{part}" for part in quiet)),
            *(f"--user-data-dir={self.home / 'browser'}", "--virtual-time-budget=15000", "--dump-dom"),
            f"{self.address}/dashboard/{path}",
        ]
        environment = os.environ | {"HOME": str(self.home)}
        done = subprocess.run(command, env=environment, capture_output=True, text=True, timeout=90)
        parser = _Texts()
        parser.feed(done.stdout)
        assert parser.texts, done.stderr
        return Page(parser.texts)


@pytest.fixture(scope="module")
def dashboard(studied: Studied, tmp_path_factory: pytest.TempPathFactory) -> Iterator[Dashboard]:
    """``optuna-dashboard URL``, as the last line of ``stage=tune`` says."""
    with closing(socket.create_server(("127.0.0.1", 0))) as listening:
        port = listening.getsockname()[1]
    home = tmp_path_factory.mktemp("home")
    program = "import sys; from optuna_dashboard._cli import main; sys.exit(main())"
    command = [sys.executable, "-c", program, studied.config.tuning.storage, "--host", "127.0.0.1", "--port", str(port)]
    with (home / "log").open("w") as log:
        process = subprocess.Popen(command, env=os.environ | {"HOME": str(home)}, stdout=log, stderr=log)
    made = Dashboard(f"http://127.0.0.1:{port}", home)
    try:
        ends = time.monotonic() + 60
        while True:
            with suppress(OSError):
                made.data("studies")
                break
            assert process.poll() is None, (home / "log").read_text()
            assert time.monotonic() < ends, "the dashboard never answered"
            time.sleep(0.1)
        yield made
    finally:
        process.terminate()
        try:
            process.wait(10)
        except subprocess.TimeoutExpired:
            process.kill()
            process.wait()


def test_the_dashboard_has_the_study(dashboard: Dashboard, studied: Studied) -> None:
    """Its API: the study, its metric and note, and every trial with parameters, curve and user attributes."""
    (summary,) = dashboard.data("studies")["study_summaries"]
    assert (summary["study_name"], summary["directions"]) == ("ball_bearing", ["minimize"])
    detail = dashboard.data(f"studies/{summary['study_id']}")
    assert detail["objective_names"] == ["log10 of the held-out loss"]
    assert detail["has_intermediate_values"]
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
        attributes = {a["key"] for a in shown["user_attrs"]}
        assert {"outcome", "epochs", "held_out_loss", "training_seconds"} <= attributes
    (default,) = (a["value"] for a in detail["trials"][0]["user_attrs"] if a["key"] == "note")
    assert default == "the configured default"


@pytest.mark.skipif(BROWSER is None, reason="needs Chromium")
def test_the_dashboard_in_a_browser(dashboard: Dashboard, studied: Studied) -> None:
    """The pages of the study, of its best trial and of its note show what a person looks for."""
    best = studied.best
    study = dashboard.page(f"studies/{dashboard.study}")
    assert f"Best Trial (number={best.number})" in study
    assert f"{best.value:.15g}"[:8] in study
    assert ", ".join(f"{name}: {value}" for name, value in best.params.items()) in study
    for caption in ("log10 of the held-out loss", "Hyperparameter Importance", "Intermediate values"):
        assert caption in study
    assert all(f"trial #{trial.number}" in study for trial in studied.study.get_trials())

    trial = dashboard.page(f"studies/{dashboard.study}/trials?numbers={best.number}")
    assert f"Trial {best.number} (trial_id={best._trial_id})" in trial
    for name, value in (best.params | best.user_attrs).items():
        assert f"{name} {value}" in trial
    for percent, value in best.intermediate_values.items():
        assert f"{percent} " + f"{value:.15g}"[:8] in trial

    note = dashboard.page(f"studies/{dashboard.study}/note")
    assert {"Question:", "Objective:", "Trial 0", "Go on:"} <= {
        text for element, text in note.texts if element == "strong"
    }
    assert ("code", "ball_bearing") in note.texts


# --- MLflow ----------------------------------------------------------------------------------------


@pytest.fixture
def client(studied: Studied) -> Iterator[Any]:
    """MLflow's client on the study's database."""
    with quiet_mlflow(10.0):
        from mlflow import MlflowClient

        yield MlflowClient(studied.config.tracking.uri)


def test_mlflow_has_the_trials_below_the_study(client: Any, studied: Studied) -> None:
    """One run ``tune``, and for every trial a run below it: parameters, final metrics, learning curve, times."""
    experiment = client.get_experiment_by_name("ball_bearing").experiment_id
    (parent,) = client.search_runs([experiment], "attributes.run_name = 'tune'")
    children = client.search_runs([experiment], f"tags.`mlflow.parentRunId` = '{parent.info.run_id}'")
    assert len(client.search_runs([experiment])) == len(children) + 2, "besides them tune and generate"
    by_name = {run.info.run_name: run for run in children}
    trials = studied.study.get_trials()
    assert by_name.keys() == {f"trial {trial.number}" for trial in trials}
    for trial in trials:
        run = by_name[f"trial {trial.number}"]
        assert run.data.params == {name: str(value) for name, value in trial.params.items()}
        assert run.data.tags["state"] == trial.state.name.lower()
        assert run.data.tags["outcome"] == trial.user_attrs["outcome"]
        for name in ("held_out_loss", "training_seconds", "epochs"):
            assert run.data.metrics[name] == pytest.approx(trial.user_attrs[name], rel=1e-9)
            assert len(client.get_metric_history(run.info.run_id, name)) == 1, "no point of a curve"
        curve = {m.step: m.value for m in client.get_metric_history(run.info.run_id, "learning_curve")}
        assert curve == pytest.approx({step: 10**value for step, value in trial.intermediate_values.items()})
        assert run.info.status == "FINISHED"
        assert run.info.start_time == round(1000 * trial.datetime_start.timestamp())
        assert parent.info.start_time <= run.info.start_time <= run.info.end_time <= parent.info.end_time


def test_mlflow_has_the_report_of_the_study(client: Any, studied: Studied) -> None:
    """The run ``tune``: what was promoted and counted, the configuration, figures, tables and the report."""
    experiment = client.get_experiment_by_name("ball_bearing").experiment_id
    (parent,) = client.search_runs([experiment], "attributes.run_name = 'tune'")
    assert parent.info.status == "FINISHED"
    assert parent.data.tags["study"] == "ball_bearing"
    assert parent.data.params["tuning.sampler"] == "tpe"
    states = [trial.state.name.lower() for trial in studied.study.get_trials()]
    for state in set(states):
        assert parent.data.metrics[f"trials.{state}"] == states.count(state)
    assert parent.data.metrics["promoted_trial"] in range(10)
    files = {item.path for folder in ("figures", "files") for item in client.list_artifacts(parent.info.run_id, folder)}
    figures = ("history", "slice", "parallel_coordinates", "learning_curves", "finalists")
    assert {f"figures/{name}.png" for name in figures} <= files
    assert {"files/README.md", "files/trials.csv", "files/finalists.csv", "files/best.yaml"} <= files
    kept = Path(client.download_artifacts(parent.info.run_id, "figures/history.png"))
    written = Path(studied.config.tuning.folder) / "figures" / "history.png"
    assert kept.read_bytes() == written.read_bytes()
