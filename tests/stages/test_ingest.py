"""stage=ingest: data of every format, and records, become the files that training reads, or are refused."""

from __future__ import annotations

import json
import shutil
from contextlib import nullcontext
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import pytest
from conftest import Artifacts, MachineFactory, Run, assert_says, refused
from damaged import measured
from measured_files import CONVENTIONS, long, probes_config, table_config, vectors_of
from reading import RPM, _mapping, with_ingest
from running import composed, names_in, strict_json

from pipeline.__main__ import main
from pipeline.config.quantities import GuessConfig
from pipeline.config.schema import Config
from pipeline.data.coefficient_files import read_coefficients
from pipeline.data.vibration_files import read_dataset
from pipeline.errors import ConfigError, DataError, PipelineError
from pipeline.identification.output_error_fit import fit_output_error
from pipeline.identification.training import setup_of
from pipeline.ingest.plausibility import note_size, note_whirl, require_clearance
from pipeline.reporting import ingested
from pipeline.rotor.bearings import CylindricalBearingConfig
from pipeline.stages import run_stage
from pipeline.stages.measurement import load_dataset, load_measurement

KNOWN = ["kxy", "kyx", "cxx", "cxy", "cyx", "cyy"]


@pytest.fixture
def no_figures(monkeypatch: pytest.MonkeyPatch) -> None:
    """They take most of the time of the stage, and have a test of their own."""
    for name in ("draw_bode", "draw_measured_orbits"):
        monkeypatch.setattr(ingested, name, lambda path, *_: path)


@pytest.fixture
def ball_tables(machine: MachineFactory, tmp_path: Path) -> Path:
    """The vibration of the modelled ball-bearing rotor at its bearings, a long table, and its known coefficients."""
    made = machine("experiment=ball_bearing", "machine.speeds.step_rpm=245", TWO)
    rpm = made.speeds / RPM
    frames = {}
    for r, run in enumerate(made.runs):
        channels = {channel: made.dataset.displacement[:, i, r] for i, channel in enumerate(made.dataset.channels)}
        x, y = ({n: v for (n, a), v in channels.items() if a == axis} for axis in (0.0, 90.0))
        frames[run] = vectors_of(rpm, x.__getitem__, y.__getitem__)
    long(frames).to_csv(tmp_path / "all.csv", index=False)
    table = {"bearing_node": np.repeat(made.bearings.nodes, len(rpm)), "speed_rpm": np.tile(rpm, 2)}
    table |= {name: made.bearings.coefficient(name).ravel() for name in KNOWN}
    pd.DataFrame(table).to_excel(tmp_path / "known.xlsx", index=False)
    return tmp_path


TWO = (
    "machine.runs=[{name: one, unbalances: [{node: 1, magnitude: 1e-4}]},"
    "{name: two, unbalances: [{node: 1, magnitude: 2e-4, phase: 1}]}]"
)
BALL_RUNS = [
    {"name": "one", "unbalances": [{"node": 1, "magnitude": "100 g mm", "phase": "90 deg"}]},
    {"name": "two", "unbalances": [{"node": 1, "magnitude": "200 g mm", "phase": f"{90 - np.degrees(1)} deg"}]},
]


def ball_section(folder: Path, **changes: Any) -> dict[str, Any]:
    """Unbalances from the mark, against the rotation: p = 90 deg - s."""
    section = table_config(BALL_RUNS, "long", file=str(folder / "all.csv"), known=str(folder / "known.xlsx"))
    return section | {"shaft_angle": "against_rotation", "tacho": {"angle": "90 deg"}} | changes


@pytest.mark.slow
def test_ingest_then_train(ball_tables: Path, run: Run, capsys: pytest.CaptureFixture[str]) -> None:
    """The files of the stage are those that training reads, and it finds the modelled stiffness in them."""
    out = ball_tables / "out"
    run_stage(with_ingest(ball_section(ball_tables), output=str(out)))
    said = capsys.readouterr()
    assert_says(said.out, "read as um, peak-to-peak, phase lag in deg, speed in rpm", "A (node 0, 45 deg)")
    assert "warning" not in said.err
    assert {p.name for p in out.iterdir()} == {
        *("vibration.parquet", "excitation.csv", "known_coefficients.csv", "ingest.json"),
        "figures",
    }
    assert json.loads((out / "ingest.json").read_text())["runs"]["two"]["speeds"] == 25
    run(
        "train",
        ["experiment=ball_bearing", "optimizer=levenberg_marquardt"],
        ball_tables / "trained",
        data=measured(out),
    )
    identified = pd.read_csv(ball_tables / "trained" / "identified_coefficients.csv")
    assert (identified["kxx"].to_numpy(), identified["kyy"].to_numpy()) == (
        pytest.approx(464.16883e5, rel=1e-7),
        pytest.approx(1009.06269e5, rel=1e-7),
    )


@pytest.mark.slow
@pytest.mark.usefixtures("no_figures")
def test_ingest_in_place_is_what_training_takes_next(ball_tables: Path, machine: MachineFactory) -> None:
    """In the experiment's own folder training reads the measured data; generate does not replace them, ingest does."""
    out = ball_tables / "out"
    config = with_ingest(ball_section(ball_tables), output=str(out))
    run_stage(config)
    with refused("generate must not replace what it did not write"):
        run_stage(config.model_copy(update={"stage": "generate"}))
    before = (out / "vibration.parquet").read_bytes()
    run_stage(config)
    assert (out / "vibration.parquet").read_bytes() == before
    rotor = machine("experiment=ball_bearing").rotor
    second = read_dataset(out / "vibration.parquet", out / "excitation.csv", rotor).excitations[1]
    assert (second.phase, second.magnitude) == (pytest.approx(1.0), pytest.approx(2e-4))


@pytest.mark.usefixtures("no_figures")
def test_generated_and_foreign_data_are_not_replaced(ball_tables: Path) -> None:
    out = ball_tables / "out"
    config = with_ingest(ball_section(ball_tables), output=str(out))
    out.mkdir()
    shutil.copy(ball_tables / "all.csv", out / "vibration.parquet")
    for make in (False, True):
        if make:
            (out / "vibration.parquet").unlink()
            run_stage(config.model_copy(update={"stage": "generate"}))
        with refused("ingest must not replace what it did not write", "output=FOLDER"):
            run_stage(config)
    with refused("ingest must write the experiment's own files"):
        run_stage(config.model_copy(update={"data": config.data.model_copy(update={"vibration": "a.csv"})}))


@pytest.mark.usefixtures("no_figures")
def test_units_that_the_model_contradicts_are_warned_of(
    ball_tables: Path, capsys: pytest.CaptureFixture[str], machine: MachineFactory
) -> None:
    """An unbalance in kg mm for g mm: a thousand times off; probes read the wrong way round: backward orbits."""
    heavy = BALL_RUNS[0] | {"unbalances": [BALL_RUNS[0]["unbalances"][0] | {"magnitude": "100 kg mm"}]}
    wrong = ball_section(ball_tables, runs=[heavy, *BALL_RUNS[1:]], conventions=CONVENTIONS | {"phase": "lead"})
    run_stage(with_ingest(wrong, output=str(ball_tables / "wrong")))
    assert_says(
        capsys.readouterr().err,
        "the amplitudes of run 'one' are",
        "times smaller than the rotor's on bearings of",
        "the orbits of run 'one' turn backward at",
    )
    made = machine("experiment=ball_bearing", "machine.speeds.step_rpm=245", TWO)
    assert (note_size(made.dataset, made.rotor, 1e7, 1e3), note_whirl(made.dataset)) == ([], [])
    largest, sizes = float(np.abs(made.dataset.displacement).max()), {"journal_diameter": 1, "length": 1}
    for clearance, factor in ((largest, ""), (largest / 1000, "times as much: check the unit")):
        film = CylindricalBearingConfig(kind="cylindrical", radial_clearance=clearance, oil_viscosity=0.1, **sizes)
        law = film.model_copy(update={"radial_clearance": GuessConfig(guess=clearance / 8, within=2.0)})  # 3 of them: 8
        for source in (film, law):
            with pytest.raises(DataError, match=f"law.radial_clearance: .*{factor}") if factor else nullcontext():
                require_clearance(made.dataset, {node: {"law": source} for node in (0, 1, 2)})


@pytest.mark.usefixtures("no_figures")
def test_without_known_coefficients_it_says_what_training_needs(
    ball_tables: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """Where all eight are unknown the file is made; where some are known somebody must give them."""
    out = ball_tables / "out"
    section = ball_section(ball_tables, known=None)
    run_stage(with_ingest(section, output=str(out)))
    assert not (out / "known_coefficients.csv").exists()
    assert "must be known before a fit: give machine.recordings.known" in capsys.readouterr().out
    identify = json.loads(_mapping())["identify"] | {"unknowns": ["kxx", "kyy", *KNOWN]}
    run_stage(with_ingest(section, output=str(out), identify=identify))
    assert list(pd.read_csv(out / "known_coefficients.csv")) == ["bearing_node", "speed_rpm"]


@pytest.mark.slow
@pytest.mark.usefixtures("no_figures")
def test_nothing_to_read_and_nodes_that_the_rotor_lacks(ball_tables: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["stage=ingest", "experiment=ball_bearing", "tracking=none", f"output={ball_tables}/x"]) == 2
    assert (
        "ingest must have recordings to read, but machine.recordings.format is none: say in a machine file"
        in capsys.readouterr().err
    )
    elsewhere = [run | {"unbalances": [run["unbalances"][0] | {"node": 9}]} for run in BALL_RUNS]
    for section, words in (
        (
            ball_section(ball_tables, probes=probes_config({"A": (7, 0.0), "B": (7, 90.0)})),
            "machine.recordings.probes.A must use nodes 0 to 2 of the rotor, but got node 7",
        ),
        (ball_section(ball_tables, runs=elsewhere), "machine.recordings.runs, run 'one', must use nodes 0 to 2"),
    ):
        with refused(words, kind=ConfigError):
            run_stage(with_ingest(section, output=str(ball_tables / "x")))
    assert not (ball_tables / "x").exists()


def config_of(folder: Path, *overrides: str) -> Config:
    return composed("experiment=rk4", "tracking=none", f"output={folder}", *overrides)


@pytest.mark.slow
def test_the_files_and_the_words(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    run_stage(config_of(tmp_path, "stage=ingest"))
    assert_says(capsys.readouterr().out, "204 records of 68 conditions at 2 speeds, 4 probes", "angle a phase lag")
    summary = strict_json(tmp_path / "ingest.json")
    assert (summary["records"], summary["conditions"], summary["nodes"]) == (204, 68, [6, 22])
    assert "modelled_coefficients.csv" not in names_in(tmp_path)
    assert (tmp_path / "figures" / "ingest_records.png").stat().st_size > 10_000
    dataset = load_dataset(config_of(tmp_path))
    assert len(set(dataset.conditions or ())) == 68
    assert abs(dataset.frequencies / dataset.speeds[:, None] - 1).max() < 0.01
    cross = {node: ("kxy", "kyx", "cxy", "cyx") for node in (2, 26)}
    assert not read_coefficients(tmp_path / "known_coefficients.csv", (2, 26), dataset.speeds, cross).values.any()


@pytest.mark.slow
def test_weights_on_a_node_that_the_rotor_lacks(tmp_path: Path) -> None:
    config = config_of(tmp_path, "stage=ingest", "machine.recordings.weights.0.node=99")
    with pytest.raises(PipelineError, match=r"machine\.recordings\.weights"):
        run_stage(config)


NEEDED = (
    *("vibration.parquet", "excitation.csv", "known_coefficients.csv", "training.json", "history.csv"),
    *("model.json", "model.safetensors", "uncertainty.safetensors"),
)


@pytest.mark.slow
@pytest.mark.parametrize("guess", ["1e4 N/m", pytest.param("1e8 N/m", marks=pytest.mark.nightly)])
def test_the_guess_only_starts_the_fit(artifacts: Artifacts, tmp_path: Path, guess: str) -> None:
    """Two orders to either side of the configured one the same minimum, in which the rotor was solved."""
    config = config_of(artifacts.copied("rk4", NEEDED[:3], tmp_path), f"model.initial_stiffness={guess}")
    fit = fit_output_error(load_measurement(config), setup_of(config))
    solved = fit.problem.update(fit.weights)
    assert float(solved.loss(fit.weights)) == pytest.approx(0.4305217, rel=1e-6)
    stiffness = solved.unknowns(fit.weights)[0][0, 0, [0, 1, 4, 5]].numpy()
    assert stiffness == pytest.approx([7.05e5, 3.26e6, 2.23e5, 3.68e5], rel=0.03)
