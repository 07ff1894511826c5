"""What a run leaves: figures, tables and metrics of every experiment, and what a stage does without its inputs."""

from __future__ import annotations

import math
import re
import shutil
from pathlib import Path
from unittest.mock import Mock

import numpy as np
import pandas as pd
import pytest
from conftest import Artifacts, Made, Run, known_names
from running import DEFAULT, EXPERIMENTS, FIGURES, composed, contents, few, identified_columns, left_alone, strict_json

from pipeline.coefficients import COEFFICIENTS
from pipeline.config.operating import column_of
from pipeline.config.schema import Config
from pipeline.data.dataset import Excitation
from pipeline.errors import ConfigError
from pipeline.stages import robustness
from pipeline.stages.measurement import load_measurement, load_modelled
from pipeline.twin.prediction import predict


@pytest.mark.usefixtures("no_pictures")
def test_a_stage_makes_what_it_needs_and_says_so(run: Run, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """Predict in an empty folder generates and trains first, in this order, each announced once."""
    run("predict", few("ball_bearing"), tmp_path / "new folder")
    announced = re.findall(r"'([^']+)' is missing: running stage=(\w+) first", capsys.readouterr().out)
    assert [stage for _, stage in announced] == ["generate", "train"]
    assert {Path(path).parent for path, _ in announced} == {tmp_path / "new folder"}
    assert (tmp_path / "new folder" / "prediction.json").exists()


USUAL = [name for name in EXPERIMENTS if name not in ("realistic", "rk4")]
"""With probes along x and y, and robustness of one data set; the others have tests of their own."""

EVERY_EXPERIMENT = pytest.mark.parametrize(
    "experiment", [DEFAULT, *(pytest.param(n, marks=pytest.mark.slow) for n in USUAL if n != DEFAULT)]
)
Kept = tuple[Path, Config]


@pytest.fixture
def kept(experiment: str, made: Made, artifacts: Artifacts) -> Kept:
    """A folder and its configuration: the default with few steps, the others as the graph made them."""
    return (
        (made(experiment), few(experiment))
        if experiment == DEFAULT
        else (artifacts(experiment, "vibration.parquet"), composed(f"experiment={experiment}"))
    )


NEEDED = {
    "vibration.parquet": "generate",
    "excitation.csv": "generate",
    "known_coefficients.csv": "generate",
    "model.safetensors": "train",
    "model.json": "train",
    "training.json": "train",
    "history.csv": "train",
}


@pytest.mark.slow
@pytest.mark.usefixtures("no_pictures")
@pytest.mark.parametrize("name", NEEDED)
def test_a_missing_file_is_made_again(
    name: str, made: Made, run: Run, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """Whichever input of evaluate is gone, its stage runs first and says so; the result is the same."""
    folder = Path(shutil.copytree(made("ball_bearing"), tmp_path / "x"))
    with left_alone(folder):
        (folder / name).unlink()
        run("evaluate", few("ball_bearing"), folder)
    assert f"'{folder / name}' is missing: running stage={NEEDED[name]} first" in capsys.readouterr().out


@pytest.mark.slow
def test_nothing_is_made_that_is_there(
    made: Made, run: Run, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """With its inputs in place, a stage neither generates nor trains, and writes only its own files."""
    folder = Path(shutil.copytree(made("ball_bearing"), tmp_path / "x"))
    times = {path: path.stat().st_mtime_ns for path in folder.rglob("*")}
    run("evaluate", few("ball_bearing"), folder)
    assert "is missing" not in capsys.readouterr().out
    changed = {path.name for path, time in times.items() if path.is_file() and path.stat().st_mtime_ns != time}
    assert changed >= {"metrics.json", "stiffness.png", "damping.png", "training.png"}
    assert not changed & {*NEEDED, *("modelled_coefficients.csv", "prediction.json", "robustness.json")}


@pytest.mark.slow
def test_the_twin_of_every_start_is_held_against_the_modelled_machine(
    made: Made, run: Run, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """robustness.json: the worst mean error of the vibration never seen, computed here start by start."""
    folder = Path(shutil.copytree(made(DEFAULT), tmp_path / "x"))
    tabulate = Mock(wraps=robustness.tabulate_starts)
    monkeypatch.setattr(robustness, "tabulate_starts", tabulate)
    config = run("robustness", few(DEFAULT), folder)
    _, _, _, answers, *_ = tabulate.call_args.args
    measurement = load_measurement(config)
    modelled = load_modelled(config, measurement)
    assert modelled is not None
    unseen = tuple(
        Excitation("new", "unbalance", u.node, u.magnitude, u.phase) for u in config.machine.prediction.unbalances
    )
    true, *found = (
        predict(measurement.rotor, table, unseen, config.machine.prediction.node).displacement
        for table in (modelled, *answers)
    )
    errors = [100 * np.mean(np.abs(one - true) / np.abs(true), axis=0).max() for one in found]
    assert errors[0] != errors[1]
    told = strict_json(folder / "robustness.json")["displacement"]
    assert told["worst_mean_error_percent"] == pytest.approx(max(errors), rel=1e-9)


@pytest.mark.slow
def test_a_run_of_the_data_is_no_vibration_never_seen(made: Made, run: Run, tmp_path: Path) -> None:
    """Where the prediction's unbalance is that of a run, robustness does not hold the twin against it."""
    folder = Path(shutil.copytree(made("ball_bearing"), tmp_path / "x"))
    assert "displacement" in strict_json(folder / "robustness.json")
    run("robustness", few("ball_bearing", "machine.prediction.unbalances=[{node: 1, magnitude: 100 g mm}]"), folder)
    assert "displacement" not in strict_json(folder / "robustness.json")


def test_initial_guesses_need_an_unknown_stiffness(run: Run, tmp_path: Path) -> None:
    """Robustness over initial stiffnesses has nothing to vary where only damping is unknown."""
    with pytest.raises(ConfigError, match="must have an unknown stiffness"):
        run("robustness", few("ball_bearing", "identify.unknowns=[cxx]"), tmp_path / "x")


@pytest.mark.slow
@pytest.mark.parametrize("figure", FIGURES)
@pytest.mark.parametrize("experiment", [DEFAULT])
def test_figures_show_something(experiment: str, figure: str, made: Made) -> None:
    """Each figure is a picture of some size with curves in it: neither blank nor a few pixels."""
    from matplotlib import image

    pixels = image.imread(made(experiment, pictures=True) / "figures" / f"{figure}.png")
    inked = (pixels[..., :3] < 0.95).any(axis=-1)
    assert 0.005 < inked.mean() < 0.5
    assert (np.ptp(pixels[..., :3], axis=-1) > 0.2).sum() > 200
    for axis, least in ((0, 300), (1, 500)):
        places, size = np.flatnonzero(inked.any(axis=1 - axis)), inked.shape[axis]
        assert size > least
        assert np.ptp(places) > 0.8 * size  # it fills its frame, and touches no edge
        assert 0 < places[0] < places[-1] < size - 1


@EVERY_EXPERIMENT
def test_files_of_an_experiment(experiment: str, kept: Kept) -> None:
    folder, _ = kept
    files = contents(folder).keys()
    assert not [name for name in files if Path(name).name.startswith((".", "tmp"))]
    assert files >= {
        *("vibration.parquet", "excitation.csv", "modelled_coefficients.csv", "known_coefficients.csv"),
        *("identified_coefficients.csv", "model.safetensors", "model.json", "training.json", "history.csv"),
        *("metrics.json", "summary.json", "least_squares_coefficients.csv"),
        *("prediction.json", "prediction.csv"),
    }
    robust = {"robustness.json", "robustness.csv", "figures/robustness.png"} & files
    assert len(robust) in ([3] if experiment == DEFAULT else [0, 3])  # the graph has some stages for some
    figures = {path.stem for path in (folder / "figures").iterdir()} - {"comparison", "diagnosis", "verdicts"}
    assert figures | {"robustness"} == set(FIGURES)


@EVERY_EXPERIMENT
def test_tables_have_the_columns_that_others_rely_on(kept: Kept) -> None:
    """The doors of the design: names and order of columns, one row a speed and bearing, rpm as written."""
    folder, config = kept
    speeds, nodes = config.machine.speeds.rpm(), list(config.machine.rotor.bearing_nodes)
    vibration = pd.read_parquet(folder / "vibration.parquet")
    own = ["frequency_hz"] if any(run.frequency_hz or run.frequency_ratio for run in config.machine.runs) else []
    operating = config.machine.operating
    at, states = [column_of(name).column for name in operating], math.prod(len(of) for of in operating.values())
    assert list(vibration) == ["run", "speed_rpm", *at, "node", "direction", "amplitude_m", "phase_deg", *own]
    assert (sorted(set(vibration["speed_rpm"])), set(vibration["direction"])) == (speeds, {"x", "y"})
    assert list(dict.fromkeys(vibration["run"])) == [r.name for r in config.machine.runs]
    n_nodes = {
        "all": 1 + sum(segment.elements for segment in config.machine.rotor.shaft),
        "bearings": len(nodes),
    }[str(config.machine.probes.at)]
    assert len(vibration) == len(config.machine.runs) * len(speeds) * states * n_nodes * 2
    columns = ["run", "kind", "node", "magnitude", "phase_deg", "whirl"]
    assert list(pd.read_csv(folder / "excitation.csv")) == columns
    for name, columns in {
        "modelled_coefficients": ["bearing_node", "speed_rpm", *at, *COEFFICIENTS],
        "identified_coefficients": identified_columns(config),
        "least_squares_coefficients": ["bearing_node", "speed_rpm", *at, *COEFFICIENTS],
        "known_coefficients": ["bearing_node", "speed_rpm", *at, *known_names(config)],
    }.items():
        table = pd.read_csv(folder / f"{name}.csv")
        assert list(table) == columns
        assert table["bearing_node"].tolist() == [node for node in nodes for _ in range(states * len(speeds))]
        assert table["speed_rpm"].tolist() == speeds * states * len(nodes)
    history = pd.read_csv(folder / "history.csv")
    assert list(history) == ["step", "phase", "loss", *["held_out_loss"] * (config.training.holdout_every > 0)]
    assert history["step"].tolist() == list(range(len(history)))
    prediction = pd.read_csv(folder / "prediction.csv")
    assert prediction["speed_rpm"].tolist() == speeds
    for of in ("x_modelled", "y_modelled", "x_identified", "y_identified"):
        assert {f"{of}_amplitude_m", f"{of}_phase_deg"} <= set(prediction)


@EVERY_EXPERIMENT
def test_known_columns_of_the_identified_table_are_the_known_ones(kept: Kept) -> None:
    """identified_coefficients.csv has all eight; those that were not identified are copied, to the last digit."""
    folder, _ = kept
    identified, known = (pd.read_csv(folder / f"{n}_coefficients.csv") for n in ("identified", "known"))
    pd.testing.assert_frame_equal(identified[list(known)], known, check_exact=True)


@EVERY_EXPERIMENT
def test_metrics_have_the_shape_that_others_rely_on(kept: Kept) -> None:
    """metrics.json: bearing, coefficient, error; only what was identified; finite numbers."""
    folder, config = kept
    metrics = strict_json(folder / "metrics.json")
    left_over = {"fit"} if config.loss.kind == "response" else {"residual", "condition_number"}
    assert set(metrics) >= {"coefficients", "least_squares", *left_over}
    for part in ("coefficients", "least_squares"):
        assert list(metrics[part]) == [str(node) for node in config.machine.rotor.bearing_nodes]
        for of in metrics[part].values():
            assert list(of) == list(config.identify.unknowns)
            for error in of.values():
                assert set(error) == {f"{k}_error_percent" for k in ("mean", "median", "p95", "max", "l2")}
                top = error["max_error_percent"] * (1 + 1e-12)  # a mean of equal numbers is rounded
                assert 0 <= error["median_error_percent"] <= top
                assert 0 <= error["mean_error_percent"] <= top
    if (folder / "robustness.json").exists():
        robustness = strict_json(folder / "robustness.json")
        if config.robustness.over == "refit":
            assert robustness["data_sets"] == config.robustness.count
        else:
            assert sum(robustness["outcomes"].values()) == robustness["starts"]
        assert list(robustness["coefficients"]) == [str(node) for node in config.machine.rotor.bearing_nodes]
    prediction = strict_json(folder / "prediction.json")
    assert set(prediction) - {"influence_coefficients", "operating", "outside_measured", "reservation"} == {
        "modelled",
        "identified",
        "displacement",
    }
    assert set(prediction["displacement"]) == {"x", "y"}
    assert {type(prediction[system]["stability"]["stable"]) for system in ("modelled", "identified")} == {bool}
    assert strict_json(folder / "training.json").keys() >= {"outcome", "data_fingerprint", "seed", "loss"}


@EVERY_EXPERIMENT
def test_metrics_are_the_errors_of_the_tables(kept: Kept) -> None:
    """The mean error of metrics.json is that of identified against modelled table, computed here by hand."""
    folder, _ = kept
    identified, modelled = (
        pd.read_csv(folder / f"{n}_coefficients.csv").set_index(["bearing_node", "speed_rpm"])
        for n in ("identified", "modelled")
    )
    for node, of in strict_json(folder / "metrics.json")["coefficients"].items():
        for name, error in of.items():
            found, true = identified.loc[int(node), name], modelled.loc[int(node), name]
            relative = 100 * (found - true).abs() / true.abs()
            told = (error["mean_error_percent"], error["max_error_percent"])
            assert told == pytest.approx((relative.mean(), relative.max()), rel=1e-6, abs=1e-12)
