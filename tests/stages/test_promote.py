"""stage=promote: a study's values in force, and what can not be promoted."""

from __future__ import annotations

import json
from pathlib import Path

import pytest
import yaml
from running import contents

from pipeline.config.compose import compose_config
from pipeline.errors import ConfigError
from pipeline.stages import run_stage


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
