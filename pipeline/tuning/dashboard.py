"""What optuna-dashboard shows: the studies of this machine, the committed ones beside them, and pages in MLflow."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from types import SimpleNamespace
from typing import TYPE_CHECKING, Any

from pipeline.config.tuning import TuningConfig
from pipeline.files import hash_file
from pipeline.tuning.attempts import list_results
from pipeline.tuning.storage import open_storage, settle, translate_errors
from pipeline.tuning.trials_file import add_trials

if TYPE_CHECKING:
    import optuna

_FILE = "file"
"""The attribute of a committed study: the hash of its text."""


@dataclass(frozen=True)
class ShownStudy:
    """A study of the database."""

    name: str
    trials: int
    linked: int  # trials with a note on their run in MLflow


def gather_studies(
    config: TuningConfig, files: Sequence[Path], find_pages: Callable[[str], Mapping[int, str]]
) -> list[ShownStudy]:
    """Put each of ``files`` (``NAME/trials.jsonl``) into the database as ``NAME (committed)``, anew where it changed.

    A study of the same name that runs here keeps its own. ``find_pages`` gives the page of each trial of a study, by
    its place: it becomes the trial's note.

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
        shown = [
            ShownStudy(study.study_name, len(study.get_trials(deepcopy=False)), _link(study, find_pages))
            for study in every
        ]
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
