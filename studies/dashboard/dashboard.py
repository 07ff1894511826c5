"""Put the committed studies beside those of this machine, so that optuna-dashboard shows them all: `make dashboard`.

    python studies/dashboard/dashboard.py [tuning.storage=URL] [tracking.uri=URL]

Optuna's database is of one machine. From the text that is kept beside each report (``studies/NAME/trials.jsonl``) the
same studies are made again in it. Each trial that MLflow has gets a note with the page of its run.
"""

from __future__ import annotations

import json
import sys
import warnings
from collections.abc import Callable, Mapping, Sequence
from datetime import datetime
from pathlib import Path
from types import SimpleNamespace
from typing import TYPE_CHECKING, Any

from pipeline.config.compose import compose_config
from pipeline.config.schema import TrackingConfig
from pipeline.config.tuning import TuningConfig
from pipeline.errors import DataError, exit_code, without_password
from pipeline.files import hash_file
from pipeline.reporting.console import say, table
from pipeline.tracking.store import quiet_mlflow
from pipeline.tuning.finalists import TRIALS
from pipeline.tuning.storage import list_results, open_storage, settle, translate_errors

if TYPE_CHECKING:
    import optuna
    from optuna.trial import FrozenTrial

_FILE = "file"
"""The attribute of a committed study: the hash of its text."""


def main(overrides: Sequence[str]) -> int:
    """Run the command line; the exit code is that of the pipeline's own commands."""
    return exit_code(lambda: show(overrides))


def show(overrides: Sequence[str]) -> None:
    """Every ``studies/NAME/trials.jsonl`` in the database, and a table of all studies there."""
    config = compose_config([*overrides, "stage=tune"])
    files = sorted(Path(__file__).parents[1].glob(f"*/{TRIALS}"))
    shown = gather_studies(config.tuning, files, find_trial_pages(config.tracking))
    storage = without_password(config.tuning.storage)
    rows = [[name, str(trials), str(linked)] for name, trials, linked in shown]
    table(f"studies in {storage}", ["study", "trials", "of these with a run in MLflow"], rows)
    say(f"look at them with: optuna-dashboard {storage}")


def gather_studies(
    config: TuningConfig, files: Sequence[Path], find_pages: Callable[[str], Mapping[int, str]]
) -> list[tuple[str, int, int]]:
    """Put each of ``files`` (``NAME/trials.jsonl``) into the database as ``NAME (committed)``, anew where it changed.

    A study of the same name that runs here keeps its own. ``find_pages`` gives the page of each trial of a study, by
    its place: it becomes the trial's note. Of each study in the database come its name, the number of its trials, and
    how many of these have a note on their run in MLflow.

    :raises StorageError: where the database can't be used
    :raises DataError: where a file holds no study
    """
    import optuna

    optuna.logging.set_verbosity(optuna.logging.ERROR)
    storage = open_storage(config)
    with translate_errors(config):
        present = {
            summary.study_name: summary for summary in optuna.get_all_study_summaries(storage, include_best_trial=False)
        }
        for path in files:
            name, mark = f"{path.parent.name} (committed)", hash_file(path)
            if name in present and present[name].user_attrs.get(_FILE) == mark:
                continue
            if name in present:
                optuna.delete_study(study_name=name, storage=storage)
            add_trials(path, name, storage).set_user_attr(_FILE, mark)
        every = [optuna.load_study(study_name=name, storage=storage) for name in optuna.get_all_study_names(storage)]
        shown = [(study.study_name, len(study.get_trials(deepcopy=False)), _link(study, find_pages)) for study in every]
    settle(config)
    return shown


def add_trials(path: Path, name: str, storage: optuna.storages.BaseStorage) -> optuna.Study:
    """Make the study of the file at ``path`` in ``storage``, by the name ``name``, which no study there has.

    :raises DataError: where the file is not what :func:`pipeline.tuning.finalists.format_trials` gives
    """
    import optuna
    from optuna_dashboard import save_note

    try:
        head, *lines = [json.loads(line) for line in path.read_text(encoding="utf-8").splitlines()]
        trials = [_make(line) for line in lines]
        note, metrics, attributes = head["note"], head["metrics"], dict(head["attributes"])
    except (OSError, ValueError, KeyError, TypeError, AttributeError) as error:
        raise DataError(
            f"'{path}' must hold a study and its trials, a line of JSON each, but it does not ({error}): "
            "take it from the repository again, or remove it"
        ) from None
    study = optuna.create_study(study_name=name, storage=storage, direction="minimize")
    with warnings.catch_warnings(action="ignore"):  # experimental, in Optuna's words
        if metrics:
            study.set_metric_names(metrics)
        save_note(study, note)
    study.add_trials(trials)
    for key, value in attributes.items():
        study.set_user_attr(key, value)
    return study


def _make(line: dict[str, Any]) -> FrozenTrial:
    from optuna.distributions import json_to_distribution
    from optuna.trial import TrialState, create_trial

    trial = create_trial(
        state=TrialState[line["state"]],
        value=line["value"],
        params=line["parameters"],
        distributions={name: json_to_distribution(json.dumps(span)) for name, span in line["ranges"].items()},
        user_attrs=line["attributes"],
        intermediate_values={int(step): value for step, value in line["curve"].items()},
    )
    for name, moment in (("datetime_start", line["started"]), ("datetime_complete", line["ended"])):
        setattr(trial, name, moment and datetime.fromisoformat(moment))
    return trial


def _link(study: optuna.Study, find_pages: Callable[[str], Mapping[int, str]]) -> int:
    """Note the page of its run on each trial that has one; how many they are."""
    from optuna_dashboard import save_note

    pages = find_pages(study.study_name)
    results = list_results(study) if pages else {}
    linked = [place for place in pages if place in results]
    for place in linked:
        # Optuna opens no finished trial again, and its dashboard keeps the notes of trials with the study.
        owner: Any = SimpleNamespace(storage=study._storage, study=study, _trial_id=results[place]._trial_id)
        save_note(owner, pages[place])
    return len(linked)


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

    client, server = MlflowClient(tracking_uri=uri), uri if uri.startswith("http") else "http://127.0.0.1:5000"
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


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
