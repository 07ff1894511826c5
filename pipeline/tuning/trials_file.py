"""A study as text that is kept beside its report: a line on the study, then a line for each finished trial.

Optuna's database is of one machine; from this file ``stage=dashboard`` makes the same study again in another one.
"""

from __future__ import annotations

import json
import warnings
from datetime import datetime
from pathlib import Path
from typing import TYPE_CHECKING, Any

from pipeline.errors import DataError
from pipeline.tuning.storage import WORKER

if TYPE_CHECKING:
    import optuna
    from optuna.trial import FrozenTrial

TRIALS = "trials.jsonl"


def format_trials(study: optuna.Study) -> str:
    """The study with its note and attributes, and every finished trial with all that the dashboard shows."""
    from optuna_dashboard import get_note

    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # experimental, in Optuna's words
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
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # experimental, in Optuna's words
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
