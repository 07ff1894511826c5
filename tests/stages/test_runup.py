"""stage=runup on the measured rig: its files, what its authors read, and a user's mistakes."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import pytest
from conftest import refused

from pipeline.config.compose import compose_config
from pipeline.errors import ConfigError
from pipeline.stages import run_stage


def made_rows(found: dict[str, Any]) -> list[tuple[dict[str, Any], int]]:
    """Fit and mode of the rows of the page's table that have a band."""
    whole = {
        "rpm": [found["natural_frequency"]["rpm"]],
        "deviation_rpm": [found["natural_frequency"]["deviation_rpm"]],
        "damping_ratio": [found["damping_ratio"]["value"]],
        "deviation_damping_ratio": [found["damping_ratio"]["deviation"]],
    }
    two = found["two_modes"]
    return [(found["one_mode"], 0), (two, 0), (two, 1), (found["decay"], 0), (whole, 0)]


def printed(row: tuple[dict[str, Any], int]) -> list[str]:
    fit, mode = row
    rpm, damping = fit["rpm"][mode], fit["damping_ratio"][mode]
    bands = 1.96 * fit["deviation_rpm"][mode], 1.96 * fit["deviation_damping_ratio"][mode]
    return [f"{rpm:.0f} +- {bands[0]:.0f}", f"{damping:.3f} +- {bands[1]:.3f}"]


def printed_rows() -> list[list[str]]:
    """Frequency and damping of the rows with a band in docs/run_up.md."""
    page = (Path(__file__).resolve().parents[2] / "docs" / "run_up.md").read_text(encoding="utf-8")
    rows = [line.split("|") for line in page.splitlines() if line.startswith("|") and "+-" in line]
    return [[cell.strip() for cell in row[2:4]] for row in rows]


@pytest.mark.slow
def test_the_run_up_of_the_measured_rig(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """The authors' steady reading comes out as they state it; the modes behind it lie lower and are less damped."""
    run_stage(compose_config(["experiment=rk4", "stage=runup", f"output={tmp_path}", "tracking=none"]))
    found = json.loads((tmp_path / "run_up.json").read_text())
    steady = found["steady_reading"]
    assert (steady["rpm"], steady["damping_ratio"], steady["amplification"]) == (
        pytest.approx(1648, abs=1),
        pytest.approx(0.04, rel=0.02),
        pytest.approx(12.4, rel=0.02),
    )
    assert (found["rate_rpm_per_s"], found["phase"], found["modes"]) == (pytest.approx(229, abs=1), "lead", 2)
    assert found["two_modes"]["misfit_percent"] < 13
    first = found["natural_frequency"]
    assert first["rpm"] + 1.96 * first["deviation_rpm"] < steady["rpm"]
    assert 2 * 1.96 * first["deviation_rpm"] < 0.04 * first["rpm"]
    assert found["damping_ratio"]["value"] < 0.5 * steady["damping_ratio"]
    rows = pd.read_csv(tmp_path / "run_up.csv")
    left = rows.measured_um * np.exp(1j * np.radians(rows.measured_lead_deg))
    left -= rows.ramp_um * np.exp(1j * np.radians(rows.ramp_lead_deg))
    share = np.sqrt((np.abs(left) ** 2).sum() / (rows.measured_um**2).sum())
    assert 100 * share == pytest.approx(found["two_modes"]["misfit_percent"], rel=1e-6)
    assert printed_rows() == [*map(printed, made_rows(found))]
    assert (tmp_path / "figures" / "run_up.png").stat().st_size > 20000
    said = capsys.readouterr()
    assert "free decay behind the peak" in said.out
    assert "the peak is no steady one" in said.err
    assert "check its columns" not in said.err


@pytest.mark.slow
def test_numbers_that_are_no_run_up_are_warned_of(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """The column of the amplitude in place of the phase."""
    overrides = ["experiment=rk4", "stage=runup", f"output={tmp_path}", "tracking=none"]
    run_stage(compose_config([*overrides, "machine.run_up.columns.phase=amp_1x"]))
    assert "check its columns, the sense and unit of the phase" in capsys.readouterr().err


@pytest.mark.slow
def test_a_machine_without_a_run_up_is_told(tmp_path: Path) -> None:
    with refused("machine.run_up is missing", kind=ConfigError):
        run_stage(compose_config(["experiment=ball_bearing", "stage=runup", f"output={tmp_path}", "tracking=none"]))
