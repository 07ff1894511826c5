"""stage=diagnose: machines with bearing laws, a second temperature that lacks, and what is not identifiable."""

from __future__ import annotations

import json
from pathlib import Path

import pandas as pd
import pytest
from conftest import Run, assert_says
from running import composed, strict_json

from pipeline.errors import ConfigError, IdentifiabilityError

pytestmark = pytest.mark.slow

SIZES = "kind: short_journal, journal_diameter: 100 mm, length: 30 mm"
OIL = "{law: exponential, reference: 55 degC, viscosity: {guess: 40 mPa s}, slope: {guess: 0.03 1/K, within: 2}}"


def machine(temperatures: str, load: str = "525 N") -> list[str]:
    bearing = f"{{{SIZES}, radial_clearance: {{guess: 0.1 mm}}, static_load: {load}}}"
    return [
        *("experiment=noisy_all", "model=law", "loss=response", "tracking=none"),
        *(f"machine.speeds.{key}" for key in ("start_rpm=600", "stop_rpm=3000", "step_rpm=400")),
        f"machine.operating={{oil_temperature: {temperatures}}}",
        f"machine.laws={{oil: {OIL}, bearings: {{1: {bearing}, 5: {bearing}}}}}",
    ]


def test_two_temperatures_tell_every_number(run: Run, tmp_path: Path) -> None:
    run("diagnose", composed(*machine("[45 degC, 60 degC]")), tmp_path)
    found = strict_json(tmp_path / "diagnosis.json")
    assert found["free_combinations"] == []
    numbers = found["physical_numbers"]
    assert list(numbers) == ["oil.viscosity", "oil.slope", "1.radial_clearance", "5.radial_clearance"]
    for of in numbers.values():
        assert of["determined"]
        assert of["deviation_percent_15_K_warmer"] < of["deviation_percent"] < 0.1 * of["prior_percent"]


def test_one_temperature_leaves_the_slope_and_names_the_next_step(
    run: Run, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    config = composed(*machine("[45 degC]", load="{guess: 525 N}"))
    run("diagnose", config, tmp_path)
    assert_says(
        " ".join(capsys.readouterr().out.split()),
        "these data do not tell oil.slope: give it as a known number",
        "5.static_load together: give one of them as a known number",
    )
    with pytest.raises(IdentifiabilityError, match="measure at a further oil temperature, 15 K apart"):
        run("train", config, tmp_path)


def test_a_design_says_which_temperatures_and_its_command_reaches_them(
    run: Run, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """Two temperatures, the slope at its prior with one; the numbers of the plan are what diagnose then finds."""
    could = ["design.operating={oil_temperature: [45 degC, 55 degC, 60 degC]}", "design.accuracy=0.02"]
    run("design", composed(*machine("[45 degC]"), *could), tmp_path)
    found = strict_json(tmp_path / "design.json")
    assert found["reached"]
    one, two = found["by_number_of_states"]
    assert (len(one["states"]), len(two["states"])) == (1, 2)
    assert one["worst"] > 0.5 > 0.02 > two["worst"]
    assert "machine.operating={oil_temperature: [45 degC, 60 degC]}" in " ".join(capsys.readouterr().out.split())
    designed = [f"machine.runs_file={tmp_path / 'designed_excitation.yaml'}"]
    run("diagnose", composed(*machine("[45 degC, 60 degC]"), *designed), tmp_path / "designed")
    numbers = strict_json(tmp_path / "designed" / "diagnosis.json")["physical_numbers"]
    for name, deviation in found["predicted"].items():
        assert numbers[name]["deviation_percent"] == pytest.approx(100 * deviation, rel=0.3)


@pytest.mark.parametrize(
    ("overrides", "words"),
    [
        ((), "must have design.accuracy"),
        (("design.accuracy=0.02", "design.numbers=[oil.slopes]"), "did you mean 'oil.slope'"),
        (("design.accuracy=0.02", "machine.operating=null"), "design.operating must have oil_temperature"),
    ],
)
def test_a_design_that_lacks_something_says_what(
    run: Run, tmp_path: Path, overrides: tuple[str, ...], words: str
) -> None:
    with pytest.raises(ConfigError, match=words):
        run("design", composed(*machine("[45 degC]"), *overrides), tmp_path)


@pytest.mark.slow
def test_diagnose_writes_its_account(run: Run, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """JSON, a table with a row a bearing and speed, a figure; the verdict. No modelled coefficient is read."""
    chosen = ("experiment=compressor_journal_and_isotropic", "machine.speeds.step_rpm=300")
    run("generate", chosen, tmp_path / "my data")
    (tmp_path / "my data" / "modelled_coefficients.csv").unlink()
    run("diagnose", chosen, tmp_path / "my data")
    said = capsys.readouterr().out
    assert_says(said, "bearing at node 8: not identifiable, because", "bearing at node 21: identifiable")
    account = json.loads((tmp_path / "my data" / "diagnosis.json").read_text())["bearings"]
    assert (account["8"]["rank"], account["8"]["orbit_rank"]) == ({"least": 4, "most": 4}, {"least": 1, "most": 1})
    assert set(account["8"]["median_deviation_percent"].values()) == {None}
    assert account["21"]["verdict"] == "identifiable"
    table = pd.read_csv(tmp_path / "my data" / "diagnosis.csv")
    assert len(table) == 2 * 15
    assert (table.loc[table["bearing_node"] == 8, "rank"] == 4).all()
    assert (tmp_path / "my data" / "figures" / "diagnosis.png").stat().st_size > 20_000
