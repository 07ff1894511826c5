"""A machine from outside, as docs/recordings.md says it: from a copied folder to the results in a few commands."""

from __future__ import annotations

import json
import shlex
import shutil
from pathlib import Path

import pandas as pd
import pytest
from conftest import assert_says
from machine_files import given_by, machine_file
from running import EXAMPLE, ROOT, composed

from pipeline.__main__ import main
from pipeline.config.loader import RESULTS, STAGES
from pipeline.config.schema import Config
from pipeline.errors import ConfigError, IdentifiabilityError
from pipeline.stages import identify
from pipeline.stages.analysis import Analysis, record

TRUTH = {  # of make_recordings.py
    1: {"kxx": 2.4e7, "kyy": 1.7e7, "cxx": 9e3, "cyy": 7e3},
    5: {"kxx": 2.0e7, "kyy": 1.4e7, "cxx": 8e3, "cyy": 6e3},
}
COMMANDS = [
    shlex.split(line.strip(), comments=True)
    for line in (ROOT / "docs" / "recordings.md").read_text(encoding="utf-8").replace("\\\n", "").splitlines()
    if line.startswith("    ") and "my rig" in line
]
COPY, *PIPELINE = COMMANDS


def check_answer(folder: Path) -> None:
    found = pd.read_csv(folder / "identified_coefficients.csv").groupby("bearing_node").median()
    for node, truth in TRUTH.items():
        for name, value in truth.items():
            assert found.loc[node, name] == pytest.approx(value, rel=0.003 if name.startswith("k") else 0.015)


@pytest.mark.slow
@pytest.mark.usefixtures("no_pictures")
def test_the_recipes_of_readme_run_on_the_examples(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    """Recordings, tables and processed vibration: one command each to all results, in a folder with a space."""
    monkeypatch.chdir(tmp_path)
    assert COPY == ["cp", "-r", "examples/measured_demo", "my rig"]
    shutil.copytree(EXAMPLE, tmp_path / COPY[-1])
    whole = [words for words in PIPELINE if "stage=identify" in words]
    assert len(whole) == 3
    for words in PIPELINE:
        assert words[:3] == ["python", "-m", "pipeline"]
        assert main([*words[3:], "tracking=none"]) == 0
        if words in whole:
            assert "skipped" not in capsys.readouterr().out
            folder = tmp_path / "artifacts" / Path(words[-1]).stem
            for file in (file for stage, file in RESULTS.items() if stage in STAGES):
                assert (folder / file).exists()
            assert json.loads((folder / "training.json").read_text())["outcome"] == "converged"
            check_answer(folder)
    assert [path.name for path in sorted((tmp_path / "my rig").iterdir())] == sorted(p.name for p in EXAMPLE.iterdir())


class Stages:
    """Stands for the stages: notes each, and fails where it is told to."""

    def __init__(self, **failures: Exception) -> None:
        self.failures, self.seen = failures, list[str]()

    def run(self, stage: str) -> None:
        self.seen.append(stage)
        if stage in self.failures:
            raise self.failures[stage]


@pytest.fixture
def config(tmp_path: Path) -> Config:
    return composed("experiment=ball_bearing", "tracking=none", "stage=identify").model_copy(
        update={"output": str(tmp_path)}
    )


def test_a_result_that_can_not_be_made_is_skipped_with_its_reason(
    config: Config, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    """What an earlier command left of it goes, so that nobody takes it for this one's; a script sees the exit code."""
    stages = Stages(predict=ConfigError("machine.prediction must be given"))
    monkeypatch.setattr(Analysis, "run", stages.run)
    (tmp_path / "prediction.json").write_text("{}")
    (tmp_path / "metrics.json").write_text("{}")
    with pytest.raises(SystemExit, match=r"^1$"):
        record(Analysis(config), identify.run)
    assert stages.seen == ["generate", "diagnose", "train", *[stage for stage in RESULTS if stage in STAGES]]
    assert (tmp_path / "metrics.json").exists()
    assert not (tmp_path / "prediction.json").exists()
    said = capsys.readouterr()
    assert_says(said.err + said.out, "stage=predict is skipped: machine.prediction must be given", "skipped: predict")


def test_data_that_determine_nothing_stop_it(config: Config, monkeypatch: pytest.MonkeyPatch) -> None:
    stages = Stages(train=IdentifiabilityError("rank 1 of 2; add a run"))
    monkeypatch.setattr(Analysis, "run", stages.run)
    with pytest.raises(IdentifiabilityError, match="add a run"):
        identify.run(Analysis(config))
    assert stages.seen == ["generate", "diagnose", "train", "report"]  # of what was measured


def test_data_of_other_programs_are_not_generated(config: Config, monkeypatch: pytest.MonkeyPatch) -> None:
    stages = Stages()
    monkeypatch.setattr(Analysis, "run", stages.run)
    data = config.data.model_copy(update={"vibration": "v.csv", "excitation": "e.csv"})
    assert identify.run(Analysis(config.model_copy(update={"data": data}))).exit_code == 0
    assert stages.seen[:2] == ["diagnose", "train"]


@pytest.mark.slow
def test_a_machine_file_needs_no_guesses_and_no_plans(tmp_path: Path) -> None:
    """Without prediction and candidates: those of the first run's weights. A rotor of ROSS brings its bearings."""
    bare = composed(given_by(machine_file(tmp_path, prediction=None, candidates=None)), "tracking=none").machine
    assert [one.node for one in bare.prediction.unbalances] == [one.node for one in bare.runs[0].unbalances]
    assert bare.candidates.unbalance_nodes == (2, 4)
    saved = machine_file(tmp_path, "saved.yaml", rotor={"file": str(EXAMPLE / "rotor.toml")}, bearings=None)
    assert composed(given_by(saved), "tracking=none").machine.bearings.kind == "rotor_file"
