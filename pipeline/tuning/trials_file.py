"""A study as text that is kept beside its report: a line on the study, then a line for each finished trial.

Optuna's database is of one machine; from these files ``stage=dashboard`` makes the same studies again in another one,
so that optuna-dashboard shows them beside those that run there.
"""

from __future__ import annotations

import json
import warnings
from collections.abc import Callable, Mapping, Sequence
from datetime import datetime
from pathlib import Path
from types import SimpleNamespace
from typing import TYPE_CHECKING, Any

from pipeline.config.tuning import TuningConfig
from pipeline.errors import DataError
from pipeline.files import hash_file
from pipeline.tuning.storage import WORKER, list_results, open_storage, settle, translate_errors

if TYPE_CHECKING:
    import optuna
    from optuna.trial import FrozenTrial

TRIALS = "trials.jsonl"
_FILE = "file"
"""The attribute of a committed study: the hash of its text."""


def format_trials(study: optuna.Study) -> str:
    """The study with its note and attributes, and every finished trial with all that the dashboard shows."""
    from optuna_dashboard import get_note

    with warnings.catch_warnings(action="ignore"):  # experimental, in Optuna's words
        note, metrics = get_note(study), study.metric_names
    lines: list[dict[str, Any]] = [
        {"study": study.study_name, "metrics": metrics, "note": note, "attributes": study.user_attrs}
    ]
    lines += [_describe(trial) for trial in study.get_trials(deepcopy=False) if trial.state.is_finished()]
    return "".join(json.dumps(line) + "\n" for line in lines)


def _describe(trial: FrozenTrial) -> dict[str, Any]:
    from optuna.distributions import distribution_to_json

    return {
        "state": trial.state.name,
        "value": trial.value,
        "parameters": trial.params,
        "ranges": {
            name: json.loads(distribution_to_json(distribution)) for name, distribution in trial.distributions.items()
        },
        "curve": {str(step): value for step, value in trial.intermediate_values.items()},
        "attributes": {name: value for name, value in trial.user_attrs.items() if name != WORKER},
        "started": trial.datetime_start and trial.datetime_start.isoformat(),
        "ended": trial.datetime_complete and trial.datetime_complete.isoformat(),
    }


def add_trials(path: Path, name: str, storage: optuna.storages.BaseStorage) -> optuna.Study:
    """Make the study of the file at ``path`` in ``storage``, by the name ``name``, which no study there has.

    :raises DataError: where the file is not what :func:`format_trials` gives
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
    _add_at_once(study, trials, storage)
    for key, value in attributes.items():
        study.set_user_attr(key, value)
    return study


def _add_at_once(study: optuna.Study, trials: Sequence[FrozenTrial], storage: Any) -> None:
    """``study.add_trials``, in a database in one transaction, by the classes of Optuna's tables: it would ask for each
    value of each trial, which takes 22 s of a processor for 290 trials, and this takes 1 s.
    """
    from optuna.distributions import distribution_to_json
    from optuna.storages import RDBStorage
    from optuna.storages._rdb import models
    from optuna.storages._rdb.storage import _create_scoped_session

    if not isinstance(storage, RDBStorage):
        study.add_trials(trials)
        return
    values, steps = models.TrialValueModel, models.TrialIntermediateValueModel

    def store(number: int, trial: FrozenTrial) -> models.TrialModel:
        """A trial as rows of Optuna's tables; a private matter of theirs, which constraints.txt pins."""
        final = [(k, *values.value_to_stored_repr(value)) for k, value in enumerate(trial.values or ())]
        curve = [(k, *steps.intermediate_value_to_stored_repr(v)) for k, v in trial.intermediate_values.items()]
        return models.TrialModel(
            number=number,
            study_id=study._study_id,
            state=trial.state,
            datetime_start=trial.datetime_start,
            datetime_complete=trial.datetime_complete,
            values=[values(objective=k, value=value, value_type=kind) for k, value, kind in final],
            params=[
                models.TrialParamModel(
                    param_name=name,
                    param_value=span.to_internal_repr(trial.params[name]),
                    distribution_json=distribution_to_json(span),
                )
                for name, span in trial.distributions.items()
            ],
            user_attributes=[
                models.TrialUserAttributeModel(key=key, value_json=json.dumps(value))
                for key, value in trial.user_attrs.items()
            ],
            intermediate_values=[
                steps(step=step, intermediate_value=value, intermediate_value_type=kind) for step, value, kind in curve
            ],
        )

    with _create_scoped_session(storage.scoped_session) as session:
        session.add_all(store(number, trial) for number, trial in enumerate(trials))


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
