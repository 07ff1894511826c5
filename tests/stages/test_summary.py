"""stage=summary: the results on one screen and in one picture, of modelled and of measured machines."""

from __future__ import annotations

from pathlib import Path

import pytest
from conftest import Run, assert_says, pictures_left_out

from pipeline.config.compose import compose_config
from pipeline.reporting.summary import WIDTH

FEW = [
    *("machine.speeds.start_rpm=500", "machine.speeds.stop_rpm=5500", "machine.speeds.step_rpm=250"),
    *("optimizer.adam.steps=5", "optimizer.lbfgs.steps=2", "optimizer.levenberg_marquardt.steps=8"),
]
EXPERIMENTS = {
    "ball_bearing": FEW,  # constants, without deviations, two critical speeds
    "hydrostatic_damping": FEW,  # a network
    "noisy_all": FEW,  # sixteen coefficients with deviations
    "measured_demo": ["machine=measured_demo_table"],  # synthetic recordings, a run that is not fitted
}
BY_DAY = ("ball_bearing", "measured_demo")


@pytest.fixture(
    scope="module",
    params=[pytest.param(name, marks=[] if name in BY_DAY else pytest.mark.slow) for name in EXPERIMENTS],
)
def experiment(request: pytest.FixtureRequest) -> str:
    """The experiment's name."""
    return str(request.param)


@pytest.fixture(scope="module")
@pictures_left_out()
def folder(experiment: str, run: Run, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The artifacts after ``stage=summary`` alone, without pictures."""
    made = tmp_path_factory.mktemp(experiment)
    run("summary", [f"experiment={experiment}", *EXPERIMENTS[experiment]], made)
    return made


def test_the_results_fit_on_a_screen(experiment: str, folder: Path) -> None:
    *others, last = (folder / "summary.txt").read_text(encoding="utf-8").splitlines()
    assert len(others) < 40
    assert max(len(line) for line in others) <= WIDTH
    assert last == f"picture      {folder / 'figures' / 'summary.png'}"
    assert all(line.isascii() for line in others)


def test_the_screen_says_what_an_engineer_asks(experiment: str, folder: Path) -> None:
    """Machine, data, every coefficient of both bearings, fit, critical speeds, stability, vibration."""
    text = (folder / "summary.txt").read_text(encoding="utf-8")
    assert_says(
        text, "machine ", "data ", "identified", "fit ", "critical ", "stability ", "prediction ", "run", "error %"
    )
    config = compose_config([f"experiment={experiment}", *EXPERIMENTS[experiment]])
    rows = [line.split(",")[0].split()[2] for line in text.splitlines() if line.startswith("  node ")]
    assert sorted(rows) == sorted(2 * config.identify.named())
    stated = config.loss.kind == "response"
    assert ("+- one standard deviation" in text, "chi-square" in text) == (stated, stated)
    assert ("held-out run both_discs predicted" in text) == (experiment == "measured_demo")


@pytest.mark.slow
def test_the_same_again(experiment: str, run: Run, folder: Path) -> None:
    files = [folder / "summary.txt", folder / "figures" / "summary.png"]
    run("summary", [f"experiment={experiment}", *EXPERIMENTS[experiment]], folder)
    first = [file.read_bytes() for file in files]
    assert first[1].startswith(b"\x89PNG")
    run("summary", [f"experiment={experiment}", *EXPERIMENTS[experiment]], folder)
    assert [file.read_bytes() for file in files] == first
