"""From three oil temperatures to a fourth: what the twin, the summary, the report and the export say there."""

from __future__ import annotations

import html
import json
from pathlib import Path

import numpy as np
import pandas as pd
import pytest
from conftest import Run, assert_says

from pipeline.errors import ConfigError

pytestmark = [pytest.mark.slow, pytest.mark.usefixtures("no_pictures")]  # fits of bearing laws, of a second each

MACHINE = [
    *("experiment=noisy_all", "machine=compressor_oil_temperatures", "model=law"),
    *("machine.speeds.step_rpm=340", "machine.prediction.speed_rpm=1620", "training=to_the_minimum"),
]


def asked(celsius: float) -> str:
    return f"machine.prediction.operating.oil_temperature={celsius:g} degC"


@pytest.fixture(scope="module")
def folder(run: Run, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Readings at 45, 55 and 65 degC, their fit, and the summary at 70 degC."""
    made = tmp_path_factory.mktemp("warm")
    run("summary", [*MACHINE, asked(70)], made)
    return made


def predict(run: Run, folder: Path, celsius: float) -> tuple[dict, pd.DataFrame]:
    run("predict", [*MACHINE, asked(celsius)], folder)
    return json.loads((folder / "prediction.json").read_text()), pd.read_csv(folder / "prediction.csv")


def test_the_twin_answers_at_a_temperature_that_was_not_measured(
    run: Run, folder: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """Oracle: the machine's own bearings at 70 degC, which no file of the experiment has."""
    found, table = predict(run, folder, 70)
    words = "oil temperature: 70 degC lies outside the measured 45 to 65 degC"
    assert (found["operating"], found["outside_measured"]) == ({"oil_temperature": pytest.approx(343.15)}, [words])
    assert words in capsys.readouterr().err
    assert (table["speed_rpm"].is_unique, set(table["oil_temperature_degC"])) == (True, {70.0})
    assert set(pd.read_csv(folder / "modes.csv")["oil_temperature_degC"]) == {70.0}
    assert max(found["displacement"][d]["mean_error_percent"] for d in "xy") < 2
    inside, at_60 = predict(run, folder, 60)
    assert inside["outside_measured"] == []
    size, spread = "y_identified_amplitude_m", "y_identified_amplitude_std_m"
    assert np.median(table[spread] / table[size]) > np.median(at_60[spread] / at_60[size])


def test_the_screen_names_states_numbers_and_what_lies_outside(folder: Path) -> None:
    lines = (folder / "summary.txt").read_text().splitlines()
    assert len(lines) <= 40
    text = " ".join(" ".join(lines).split())
    assert_says(
        text,
        *("45 degC", "65 degC", "numbers ", "node 8 radial clearance", " um", "mPa s", "1620 rpm at 70 degC"),
        "oil temperature: 70 degC lies outside the measured",
    )


def test_the_report_follows_the_condition_that_is_asked_for(run: Run, folder: Path) -> None:
    run("report", [*MACHINE, asked(72)], folder)
    page = (folder / "report.html").read_text()
    assert_says(page, "72 degC (not measured)", "Numbers of the bearing laws", "outside the measured 45 to 65 degC")


def test_the_export_has_a_table_a_measured_state(run: Run, folder: Path) -> None:
    run("export", [*MACHINE, "export.formats=[csv,dyrobes]"], folder)
    table = pd.read_csv(folder / "export" / "coefficients.csv")
    assert sorted(set(table["oil_temperature_degC"])) == [45.0, 55.0, 65.0]
    assert not table.duplicated(["bearing_node", "speed_rpm", "oil_temperature_degC"]).any()
    assert (folder / "export" / "dyrobes_node_21_55_degC.txt").exists()
    numbers = pd.read_csv(folder / "export" / "physical_numbers.csv").set_index("name")
    clearance = numbers.loc["node 21 radial clearance"]
    assert abs(clearance["value"] - 85.0) < 4 * clearance["std"] < 8.0


@pytest.mark.parametrize(
    ("override", "words"),
    [
        ("+machine.prediction.operating.load=500 N", "must name conditions of the data, but got load"),
        ("machine.prediction.operating.oil_temperature=70 mm", "oil_temperature must convert to kelvin"),
    ],
)
def test_conditions_that_are_missing_or_unknown_are_refused(override: str, words: str, run: Run, folder: Path) -> None:
    with pytest.raises(ConfigError, match=words):
        run("predict", [*MACHINE, override], folder)


def test_a_speed_between_those_of_the_data_is_predicted(
    run: Run, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """Oracle: data of the same machine that have this speed. What can't be predicted is said before the fit, and
    summary and report come without it."""
    machine = ["experiment=ball_bearing", "machine.speeds={start_rpm: 900, stop_rpm: 3000, step_rpm: 300}"]
    run("generate", machine, tmp_path)
    run("diagnose", [*machine, "machine.prediction.speed_rpm=9000"], tmp_path)
    reason = "must lie within the data's speeds, 900 to 3000 rpm, but got 9000"
    assert (
        f"no prediction can follow a fit, and summary and report will lack it: machine.prediction.speed_rpm {reason}"
        in (capsys.readouterr().err)
    )
    run("predict", [*machine, "machine.prediction.speed_rpm=1480"], tmp_path)
    between = pd.read_csv(tmp_path / "prediction.csv").set_index("speed_rpm")
    finer = [machine[0], "machine.speeds={start_rpm: 1480, stop_rpm: 2000, step_rpm: 20}"]
    run("predict", [*finer, "machine.prediction.speed_rpm=1480"], tmp_path / "finer")
    there = pd.read_csv(tmp_path / "finer" / "prediction.csv").set_index("speed_rpm")
    assert list(between.index) == [900, 1200, 1480, *range(1500, 3001, 300)]
    for system in ("modelled", "identified"):
        names = [f"{d}_{system}_amplitude_m" for d in "xy"]
        assert np.allclose(between.loc[1480, names], there.loc[1480, names], rtol=1e-7)
    for stage, file in (("summary", "summary.txt"), ("report", "report.html")):
        run(stage, [*machine, "machine.prediction.speed_rpm=9000"], tmp_path)
        said = html.unescape(" ".join((tmp_path / file).read_text().split()))
        assert reason in said
        assert "Stiffness and damping" in said or "node 0 kxx" in said
