"""Where MLflow's pages show the trials of a study."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING, Any

from pipeline.tracking.quiet import quiet_mlflow

if TYPE_CHECKING:
    from pipeline.config.schema import TrackingConfig

_LOCAL = "http://127.0.0.1:5000"


def find_trial_pages(settings: TrackingConfig) -> Callable[[str], dict[int, str]]:
    """A function from the name of a study to a note on the page of each trial, by the trial's number.

    It gives none where there is no record of the study, or the store does not answer.
    """
    file = settings.uri.removeprefix("sqlite:///")
    if file != settings.uri and not (Path(file).is_file() and Path(file).stat().st_size):
        return lambda study: {}  # no need to import MLflow

    def find(study: str) -> dict[int, str]:
        try:
            with quiet_mlflow(settings.timeout_seconds):
                return _find(settings.uri, study)
        except Exception:  # a page more or less stops nobody from looking at trials
            return {}

    return find


def _find(uri: str, study: str) -> dict[int, str]:
    from mlflow import MlflowClient

    client, server = MlflowClient(tracking_uri=uri), uri if uri.startswith("http") else _LOCAL
    start = "" if uri.startswith("http") else f" (served by `mlflow ui --backend-store-uri {uri}`)"
    experiments = [experiment.experiment_id for experiment in client.search_experiments()]
    named = study.replace("'", "\\'")
    stages: list[Any] = client.search_runs(experiments, f"tags.study = '{named}'")
    pages: dict[int, str] = {}
    for stage in reversed(stages):  # the latest record of a trial counts
        below = f"tags.`mlflow.parentRunId` = '{stage.info.run_id}'"
        for run in client.search_runs([stage.info.experiment_id], below):
            word, _, number = (run.info.run_name or "").partition(" ")
            if word == "trial" and number.isdigit():
                page = f"{server}/#/experiments/{run.info.experiment_id}/runs/{run.info.run_id}"
                pages[int(number)] = f"[Its run in MLflow]({page}){start}"
    return pages
