"""Committed studies have their trials, and open in a database of any machine."""

from __future__ import annotations

import shutil
from pathlib import Path

import pandas as pd
import pytest
from dashboard import add_trials, gather_studies
from running import ROOT

from pipeline.config.compose import compose_config
from pipeline.errors import DataError
from pipeline.tuning.finalists import TRIALS, format_trials
from pipeline.tuning.storage import open_storage

FILES = sorted((ROOT / "studies").glob(f"*/{TRIALS}"))


def test_every_report_has_its_trials() -> None:
    reports = {path.parent.name for path in (ROOT / "studies").glob("*/trials.csv")}
    assert {path.parent.name for path in FILES} == reports
    assert {"ball_bearing", "hydrostatic_stiffness", "hydrostatic_damping", "realistic"} <= reports


@pytest.mark.parametrize("path", FILES, ids=lambda path: path.parent.name)
def test_a_committed_study_is_the_one_of_its_report(path: Path) -> None:
    """In memory: as many trials as the table has, with their losses and states; written again it is the same text."""
    from optuna.storages import InMemoryStorage

    study = add_trials(path, path.parent.name, InMemoryStorage())
    table = pd.read_csv(path.parent / "trials.csv")
    trials = study.get_trials()
    assert [trial.state.name.lower().replace("fail", "failed") for trial in trials] == list(table["state"])
    for trial, loss in zip(trials, table["held_out_loss"], strict=True):
        assert trial.value is None or 10**trial.value == pytest.approx(max(loss, 1e-13), rel=1e-6)
    if study.study_name != "realistic":  # fits of seconds have no learning curve
        assert any(trial.intermediate_values for trial in trials)
    assert format_trials(study).splitlines()[1:] == path.read_text().splitlines()[1:]


@pytest.mark.slow
def test_studies_are_gathered_once_and_beside_those_of_this_machine(tmp_path: Path) -> None:
    """A file that changed is read anew; a trial with a page has it as its note; a study that runs here stays."""
    import optuna
    from optuna_dashboard._note import get_note_from_system_attrs

    config = compose_config([f"tuning.storage=sqlite:///{tmp_path}/optuna.db"]).tuning
    storage = open_storage(config)
    optuna.create_study(study_name="paper", storage=storage).enqueue_trial({})
    copy = tmp_path / "paper" / TRIALS
    copy.parent.mkdir()
    shutil.copy(ROOT / "studies" / "hydrostatic_stiffness_paper" / TRIALS, copy)
    for _ in range(2):
        shown = gather_studies(config, [copy], lambda study: {3: "its page"} if "committed" in study else {})
        assert shown == [("paper", 1, 0), ("paper (committed)", 20, 1)]
    study = optuna.load_study(study_name="paper (committed)", storage=storage)
    attributes = storage.get_study_system_attrs(study._study_id)
    assert get_note_from_system_attrs(attributes, study.get_trials()[3]._trial_id)["body"] == "its page"
    copy.write_text("".join(copy.read_text().splitlines(keepends=True)[:-1]))
    assert [trials for _, trials, _ in gather_studies(config, [copy], lambda study: {})] == [1, 19]
    copy.write_text("{}\n")
    with pytest.raises(DataError, match="must hold a study and its trials"):
        gather_studies(config, [copy], lambda study: {})
