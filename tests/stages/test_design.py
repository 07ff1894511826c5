"""stage=design: what can be reached and what can't, its files put to use, and fits of the designed runs."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest
from conftest import Run, assert_says
from problem.test_design import COARSE, FEW

from pipeline.config.compose import compose_config
from pipeline.errors import ConfigError
from pipeline.stages import robustness


@pytest.mark.slow
def test_what_can_be_reached_is_written_and_can_be_used(run: Run, tmp_path: Path) -> None:
    """Sixteen coefficients at 5 % with a force that turns backward."""
    run("design", ["experiment=realistic", "design.accuracy=0.05"], tmp_path)
    about = json.loads((tmp_path / "design.json").read_text())
    assert (about["reached"], len(about["predicted"])) == (True, 16)
    assert max(about["predicted"].values()) <= 0.05
    config = compose_config(["experiment=realistic", f"machine.runs_file='{tmp_path / 'designed_excitation.yaml'}'"])
    assert [one.name for one in config.machine.runs] == about["runs"]
    assert any(force.whirl == "backward" for one in config.machine.runs for force in one.forces)


@pytest.mark.slow
def test_what_cannot_be_reached_is_said_with_a_cure(
    run: Run, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """Weights alone whirl forward."""
    run("design", [*COARSE, "design.accuracy=0.1", "machine.candidates.force_nodes=[]"], tmp_path)
    about = json.loads((tmp_path / "design.json").read_text())
    assert not about["reached"]
    assert (
        about["cures"]["a force that turns backward"]
        <= 0.1
        < min(of for name, of in about["cures"].items() if name != "a force that turns backward")
    )
    assert_says(
        capsys.readouterr().out,
        *("10 % can't be reached with 3 runs for 16 of 16 coefficients; the worst, node", "(enough)"),
    )


def test_a_wrong_accuracy_is_refused() -> None:
    """By name."""
    with pytest.raises(ConfigError, match=r"design\.accuracy"):
        compose_config(["stage=design", "experiment=realistic", "design.accuracy=0"])


@pytest.mark.slow
def test_fits_of_the_designed_runs_are_as_accurate_as_predicted(run: Run, tmp_path: Path) -> None:
    """Median errors of normal deviates are 0.6745 of the deviation: their mean ratio, as built."""
    run("design", [*FEW, "design.accuracy=0.02"], tmp_path)
    about = json.loads((tmp_path / "design.json").read_text())
    series = ["model=chebyshev", "model.count=3", "model.trend=false", "model.input_scaling=rpm"]
    file = f"machine.runs_file='{tmp_path / 'designed_excitation.yaml'}'"
    config = compose_config(["stage=robustness", *FEW, *series, file])
    error = np.array([robustness.measure_again(config, seed).error for seed in range(6)])
    ratio = error / (67.45 * np.array(list(about["predicted"].values())))
    print(f"error over prediction {ratio.mean():.2f}")
    assert 0.6 < ratio.mean() < 1.6


@pytest.mark.slow
def test_design_beats_the_papers_runs_and_simulations_confirm_it(
    run: Run, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """The worst deviation falls at least 150 times; 200 noisy fits at 0.1 % give the same ratio within 20 %."""
    folder = tmp_path / "my design"
    run("design", ["experiment=all_coefficients"], folder)
    summary = json.loads((folder / "design.json").read_text())
    print(f"gain {summary['gain']:.3g}, in simulations {summary['simulated_gain']:.3g}")
    assert summary["stated_noise"] == {"additive": 0.0, "multiplicative": 0.001, "drift": 0.0, "record": 0.0}
    assert len(summary["runs"]) == len(compose_config(["experiment=all_coefficients"]).machine.runs)
    assert summary["gain"] >= 150
    assert summary["simulated_gain"] == pytest.approx(summary["gain"], rel=0.2)
    assert "machine.runs_file=" in capsys.readouterr().out


@pytest.mark.slow
def test_a_design_can_be_used_at_once(run: Run, tmp_path: Path) -> None:
    """``machine.runs_file`` takes it; a file that holds something else is refused by name."""
    few = ("experiment=all_coefficients", "machine.speeds.step_rpm=500", "design.speeds=5", "design.simulations=0")
    run("design", few, tmp_path / "a")
    file = tmp_path / "a" / "designed_excitation.yaml"
    config = compose_config(["experiment=all_coefficients", f"machine.runs_file='{file}'"])
    assert [run.name for run in config.machine.runs] == json.loads((tmp_path / "a" / "design.json").read_text())["runs"]
    assert config.machine.speeds.step_rpm == 500
    run("generate", ["experiment=all_coefficients", f"machine.runs_file='{file}'"], tmp_path / "b")
    (tmp_path / "c.yaml").write_text("- 1")
    (tmp_path / "e.yaml").write_text(file.read_text() + "rotor: {file: x}\n")
    for name, law in (
        ("c", r"machine\.runs_file must have speeds and runs"),
        ("e", r"nothing else, but '.*e\.yaml' has speeds, runs, rotor"),
        ("absent", r"machine\.runs_file must be speeds and runs such as stage=design writes"),
    ):
        with pytest.raises(ConfigError, match=law):
            compose_config([f"machine.runs_file='{tmp_path / name}.yaml'"])
