"""stage=ingest: data of every format become the files that training reads; what does not say enough is refused."""

from __future__ import annotations

import json
import shutil
from contextlib import nullcontext
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import pytest
from conftest import MachineFactory, Run, assert_says, refused
from damaged import measured
from measured_files import CONVENTIONS, long, probes_config, table_config, vectors_of
from reading import BARE, DISC, ONE, RPM, RUNS, _mapping, read, waves, wide_runs, with_ingest

from pipeline.__main__ import main
from pipeline.config.quantities import GuessConfig
from pipeline.data.dataset import VibrationDataset
from pipeline.data.vibration_files import read_dataset
from pipeline.errors import ConfigError, DataError
from pipeline.ingest.plausibility import note_size, note_whirl, require_clearance
from pipeline.reporting import ingested
from pipeline.rotor.bearings import CylindricalBearingConfig
from pipeline.stages import run_stage

BAD_CONFIG: dict[str, tuple[dict[str, Any], str]] = {
    **{
        f"no {missing}": (
            table_config([ONE], conventions={key: value for key, value in CONVENTIONS.items() if key != missing}),
            f"machine.recordings.conventions.{missing}: must be given",
        )
        for missing in CONVENTIONS
    },
    "an unknown unit": (
        table_config([ONE], conventions=CONVENTIONS | {"length": "umm"}),
        "um, mil or mm), but got 'umm'",
    ),
    "a unit of something else": (
        table_config([ONE], conventions=CONVENTIONS | {"length": "kg"}),
        "must be a unit of m",
    ),
    "a sense of phase": (table_config([ONE], conventions=CONVENTIONS | {"phase": "lagg"}), "did you mean 'lag'?"),
    "degrees without a unit": (
        table_config([ONE], probes={"A": {"node": 0, "angle": 45}}),
        "must carry its unit (such as 45 deg)",
    ),
    "a weight without a unit": (
        table_config([ONE | {"unbalances": [DISC | {"magnitude": 200}]}]),
        "must carry its unit (such as 100 g mm), since a number alone is in kg m, but got 200",
    ),
    "a run without excitation": (
        table_config([ONE, BARE]),
        "run 'two' must have unbalances or forces, but it has none",
    ),
    "an excited baseline": (
        table_config([ONE], baseline="one"),
        "must have nothing that excites the baseline run 'one'",
    ),
    "no such baseline": (
        table_config([ONE], baseline="onne"),
        "must have the baseline among its runs, but it is 'onne'; did you mean 'one'?",
    ),
    "two runs of one name": (table_config([ONE, ONE]), "must give every run a name of its own"),
    "no meaning of angles": (table_config([ONE], shaft_angle=None), "must say in shaft_angle how phases of unbalances"),
    "no angle of the tacho": (table_config([ONE], shaft_angle="with_rotation"), "must give tacho.angle"),
    "no file": (table_config([RUNS[0]]), "run 'one' must have a file, but it has none"),
    "no columns": (table_config([ONE], probes=probes_config()), "probe 'A' must have columns in the wide layout"),
    "one column twice": (
        table_config([ONE], probes=probes_config(columns=lambda name: {"amplitude": "a", "phase": "a"})),
        "probe 'A' must have another column of phases than 'a', but has none",
    ),
    "no phase of an unbalance": (
        table_config([{"name": "one", "file": "a", "unbalances": [{"node": 1, "magnitude": "1 g mm"}]}]),
        "machine.recordings.runs.0.unbalances.0.phase: must be given",
    ),
    "unbalances at a frequency of their own": (
        table_config([ONE | {"frequency_hz": 30}]),
        "run 'one' must have no unbalances where its forces have a frequency",
    ),
    "slow roll both ways": (
        table_config([ONE], slow_roll={"below_rpm": 300, "vectors": {"A": {"amplitude": "1 um", "phase": "1 rad"}}}),
        "must give either below_rpm or vectors, but got both",
    ),
    "slow roll of some probes": (
        table_config(
            [ONE],
            slow_roll={
                "vectors": {"A": {"amplitude": "1 um", "phase": "1 rad"}},
                "amplitude": "rms",
                "phase": "lag",
            },
        ),
        "must have one vector a probe (A, B, C, D)",
    ),
    "slow roll without conventions": (
        table_config([ONE], slow_roll={"vectors": {"A": {"amplitude": "1 um", "phase": "1 rad"}}}),
        "must give amplitude (zero_to_peak, peak_to_peak or rms) and phase",
    ),
    "comma twice": (
        table_config([ONE], csv={"delimiter": ",", "decimal": ","}),
        "must have a delimiter that is not the decimal mark",
    ),
    "no encoding": (table_config([ONE], csv={"encoding": "cp12"}), "must have an encoding such as utf-8 or cp1252"),
    "no unit of signals": (waves(signal_unit=None), "signal_unit"),
    "no kind of records": (waves(records=None), "must give records (constant_speed or run_up)"),
    "a run-up without speeds": (waves(speeds=None), "must give speeds"),
    "no scale": (waves(probes=probes_config(channel=lambda name: name)), "probe 'A' must have a scale"),
    "a scale without unit": (
        waves(probes=probes_config(channel=lambda name: name, scale=lambda name: 8)),
        "must carry its unit (such as 7.87 V/mm, 200 mV/mil",
    ),
    "a scale for lengths": (waves(signal_unit="um"), "must have no scale where signals are in um"),
    "teeth without a mark": (
        waves(tacho={"channel": "tacho", "edge": "rising", "pulses_per_revolution": 20}),
        "must give mark_channel where there are 20 pulses a revolution",
    ),
    "no edge": (waves(tacho={"channel": "tacho"}), "machine.recordings.tacho.edge: must be given"),
    "two clocks": (waves(sample_rate_attribute="fs"), "must give at most one of time, sample_rate and"),
    "no unit of time": (waves(sample_rate=None, time="t"), "must give time_unit"),
    "several files of a run-up": (
        waves(runs=[RUNS[0] | {"files": ["a.h5", "b.h5"]}]),
        "must have one file for a run-up, but it has 2",
    ),
    "file and files": (waves(runs=[ONE | {"files": ["a.h5"]}]), "must have file or files, but it has both"),
    "an unknown key": (table_config([ONE], convention={}), "did you mean 'conventions'?"),
    "an unknown key of a run": (
        table_config([ONE | {"speed": 3}]),
        "runs.0.speed: must be a key that the schema knows",
    ),
    "an unknown format": ({"format": "tabel"}, "did you mean 'table'?"),
}


@pytest.mark.parametrize("case", BAD_CONFIG)
def test_a_configuration_that_says_too_little(case: str) -> None:
    section, words = BAD_CONFIG[case]
    with refused(words, "machine.recordings", kind=ConfigError):
        with_ingest(section)


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


@pytest.mark.slow
def test_figures_show_something(tmp_path: Path) -> None:
    """Pictures of some size with curves in several colours; one speed, and a baseline that stands still, among them."""
    from matplotlib import image

    from pipeline.reporting.measured_figures import draw_bode, draw_measured_orbits

    dataset = read(table_config(wide_runs(tmp_path)))
    displacement = dataset.displacement * np.array([0.0, 1.0])
    still = VibrationDataset(dataset.speeds, dataset.runs, dataset.channels, displacement, dataset.excitations)
    one = VibrationDataset(dataset.speeds[:1], dataset.runs, dataset.channels, displacement[:1], dataset.excitations)
    node = dataset.channels[0][0]
    probes = {"left": (node, 45.0), "right": (node, 135.0), "odd": (node, 0.0)}
    for path in (
        draw_bode(tmp_path / "a.png", still, "one", probes),
        draw_measured_orbits(tmp_path / "b.png", dataset, None),
        draw_measured_orbits(tmp_path / "c.png", one, "one"),
    ):
        pixels = image.imread(path)
        assert min(pixels.shape[:2]) > 500
        assert (np.ptp(pixels[..., :3], axis=-1) > 0.2).sum() > 500
