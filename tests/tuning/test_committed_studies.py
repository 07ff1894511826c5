"""Committed studies open in a database of any machine; a study changes what training uses by promotion alone."""

from __future__ import annotations

import json
import shutil
from pathlib import Path

import pandas as pd
import pytest
import yaml
from dashboard import add_trials, gather_studies
from running import ROOT, contents

from pipeline.config.compose import compose_config
from pipeline.errors import ConfigError, DataError
from pipeline.stages import run_stage
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


@pytest.fixture
def found(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> list[str]:
    """A study ``mine`` of ball_bearing in the working folder, and what names it on the command line."""
    monkeypatch.chdir(tmp_path)
    folder = tmp_path / "artifacts" / "studies" / "mine"
    folder.mkdir(parents=True)
    best = {"study": "mine", "trial": 4, "values": {"optimizer.adam.steps": 77}}
    best["held_out_loss"] = {"configured": 1e-3, "promoted": 1e-9}
    (folder / "best.yaml").write_text(yaml.safe_dump(best))
    (folder / "summary.json").write_text(json.dumps({"experiment": "ball_bearing"}))
    (folder / "README.md").write_text("# Study `mine`\n")
    (folder / ".lock").write_text("")
    return ["stage=promote", "experiment=ball_bearing", "tuning.study=mine", "tracking=none"]


def test_a_promoted_study_is_in_force(found: list[str], tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """What changes is said; then training has the values, and a second promotion changes nothing."""
    run_stage(compose_config(found))
    said = " ".join(capsys.readouterr().out.split())
    assert "optimizer.adam.steps as configured 77" in said
    assert all(f"studies/ball_bearing/{name} new" in said for name in ("README.md", "best.yaml", "summary.json"))
    target = contents(tmp_path / "studies")
    assert sorted(target) == [f"ball_bearing/{name}" for name in ("README.md", "best.yaml", "summary.json")]
    assert compose_config(["experiment=ball_bearing"]).optimizer.adam.steps == 77
    assert compose_config(["experiment=ball_bearing", "tuned=false"]).optimizer.adam.steps == 5000
    run_stage(compose_config(found))
    assert "nothing changes" in capsys.readouterr().out
    assert contents(tmp_path / "studies") == target


@pytest.mark.parametrize(
    ("override", "words"),
    [
        ("tuning.study=other", r"there is no 'artifacts/studies/other/best\.yaml'"),
        ("experiment=hydrostatic_stiffness", "is of ball_bearing, not of hydrostatic_stiffness"),
    ],
)
def test_what_can_not_be_promoted(override: str, words: str, found: list[str], tmp_path: Path) -> None:
    """A study that has not ended, and one of another experiment: nothing is written."""
    with pytest.raises(ConfigError, match=words):
        run_stage(compose_config([*found, override]))
    assert not (tmp_path / "studies").exists()
