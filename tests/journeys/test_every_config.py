"""Every experiment and option runs, stage by stage, on few speeds and with few steps; and what a run leaves behind."""

from __future__ import annotations

import json
import re
import shutil
from collections.abc import Callable
from functools import cache
from itertools import product
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import pytest
from conftest import known_names

from pipeline.config.compose import compose_config
from pipeline.config.loader import CONF, list_options
from pipeline.config.schema import Config
from pipeline.data.dataset import Excitation
from pipeline.errors import ConfigError, DataError, IdentifiabilityError
from pipeline.rotor.ross_adapter import ross_rotor
from pipeline.stages import STAGES, check, evaluate, robustness, run_stage
from pipeline.stages.measurement import load_identified, load_measurement, load_modelled
from pipeline.twin.prediction import predict
from pipeline.units import RAD_S_PER_RPM

REFUSED = "compressor_journal_and_isotropic"  # not identifiable: no stage after diagnose
MEASURED = "measured_demo"  # read, not generated: test_measured_demo.py
EXPERIMENTS = [name for name in list_options("experiment") if name not in (REFUSED, MEASURED)]
LINE = ["generate", "train", "evaluate", "robustness", "predict"]
FEW = [
    "tracking=none",
    *(f"machine.speeds.{key}" for key in ("start_rpm=500", "stop_rpm=5500", "step_rpm=500")),
    "optimizer.adam.steps=4",
    "optimizer.levenberg_marquardt.steps=4",
    "robustness.count=3",
    "robustness.seeds=[0,1]",
]
QUICK_FIRST = [
    "hydrostatic_stiffness",
    *(pytest.param(name, marks=pytest.mark.slow) for name in EXPERIMENTS if name != "hydrostatic_stiffness"),
]
ONE_BY_DAY = [
    "hydrostatic_stiffness",
    *(pytest.param(name, marks=pytest.mark.nightly) for name in EXPERIMENTS if name != "hydrostatic_stiffness"),
]
# One of the noisy ones, which differ in their unknowns, is tried with every option.
WITH_OPTIONS = [
    name for name in EXPERIMENTS if name not in ("noisy_direct", "noisy_all", "noisy_stiffness_residual", "impulses")
]
GROUPS = sorted(p.name for p in CONF.iterdir() if p.is_dir() and p.name not in {"experiment", "thresholds"})
COEFFICIENTS = ["kxx", "kxy", "kyx", "kyy", "cxx", "cxy", "cyx", "cyy"]
FIGURES = [
    *("stiffness", "damping", "training", "robustness"),
    *("prediction_time", "prediction_orbit", "prediction_response"),
]


@cache
def composed(experiment: str, *overrides: str) -> Config:
    """An experiment with few speeds and steps; composing takes longer than most stages here."""
    return compose_config([f"experiment={experiment}", *FEW, *overrides])


def run(stage: str, experiment: str, folder: Path, *overrides: str) -> None:
    """One stage of an experiment in ``folder``."""
    config = composed(experiment, *overrides)
    run_stage(config.model_copy(update={"stage": stage, "output": str(folder)}))


def contents(folder: Path) -> dict[str, bytes]:
    """Every file below ``folder``."""
    return {str(p.relative_to(folder)): p.read_bytes() for p in sorted(folder.rglob("*")) if p.is_file()}


EXACT = "least_squares,tikhonov,total_least_squares,kalman,spline,response"
COMPARED = {
    "ball_bearing": f"comparison.methods=[{EXACT},kriging,critical_speeds]",
    "hydrostatic_damping": f"comparison.methods=[{EXACT}]",
    "hydrostatic_stiffness": f"comparison.methods=[{EXACT}]",
    "impulses": "comparison.methods=[multi_frequency,total_least_squares,response]",
}
"""The methods that thresholds are set for."""
FEW_CASES = [
    *("comparison.workers=1", "comparison.data_sets=1", "comparison.speeds=[11]", "comparison.noise=[0,0.001]"),
    "comparison.response.optimizer.levenberg_marquardt.steps=4",
]


def read(path: Path) -> Any:
    """JSON as the standard has it: NaN is none."""

    def refuse(word: str) -> None:
        raise AssertionError(f"{path} holds {word}")

    return json.loads(path.read_text(encoding="utf-8"), parse_constant=refuse)


class Made:
    """The experiments run so far, each once."""

    def __init__(self, root: Path) -> None:
        self.root = root
        self.folders: dict[str, Path] = {}

    def __call__(self, experiment: str) -> Path:
        """The folder of an experiment of which every stage has run."""
        if experiment not in self.folders:
            self.folders[experiment] = self.root / experiment
            for stage in LINE:
                run(stage, experiment, self.folders[experiment])
        return self.folders[experiment]


@pytest.fixture(scope="module")
def made(tmp_path_factory: pytest.TempPathFactory) -> Made:
    """``made(experiment)``: its folder, all stages run; not to be written to."""
    return Made(tmp_path_factory.mktemp("made"))


# --- every configuration runs ------------------------------------------------------------------------


@pytest.mark.slow
@pytest.mark.parametrize("experiment", ONE_BY_DAY)
def test_every_stage_of_an_experiment_again_gives_the_same_bits(experiment: str, made: Made, tmp_path: Path) -> None:
    """All stages run, and a second time, over their own files, they write the same bytes, figures too."""
    first = contents(made(experiment))
    folder = Path(shutil.copytree(made(experiment), tmp_path / "again"))
    for stage in LINE:
        run(stage, experiment, folder)
    again = contents(folder)
    assert again.keys() == first.keys()
    assert [name for name in first if again[name] != first[name]] == []


DEFAULT = "hydrostatic_stiffness"


def _defaults() -> dict[str, str]:
    """The option of each group that the default experiment has."""
    import yaml

    listed = yaml.safe_load((CONF / "config.yaml").read_text(encoding="utf-8"))["defaults"]
    return {group: option for one in listed if isinstance(one, dict) for group, option in one.items()}


def home(group: str, option: str) -> str:
    """The experiment that an option is tried with by day: one that it fits, and where it changes something."""
    if "compressor" in option:
        return "compressor_two_journals"
    if group == "machine" and "two_discs" in option:
        return "noisy_stiffness"
    if _defaults()[group] != option:
        return DEFAULT
    return "noisy_stiffness" if group in ("loss", "training") else "ball_bearing"


CHOICES = [
    pytest.param(group, option, name, marks=[] if name == home(group, option) else pytest.mark.nightly)
    for group in GROUPS
    for option in list_options(group)
    for name in WITH_OPTIONS
]
MORE = [
    "loss.scaling=none",
    "identify.shared=true",
    "training.holdout_every=0",
    "training.holdout_every=2",
    "model.parametrisation=scaled",
    "model.initial_stiffness=1",
    "model.initial_stiffness=1e8",
    "seed=7",
    "threads=2",
    "identify.unknowns=[kxx]",
    "identify.unknowns=[cyy,kxx]",
]
NETWORK = [
    *(f"model.activation={name}" for name in ("tanh", "silu", "sine")),
    *(f"model.input_scaling={name}" for name in ("rpm", "log_rpm")),
    *("model.depth=3", "model.depth=1"),
]


def identified_columns(config: Config) -> list[str]:
    """Those of identified_coefficients.csv: the response loss states a standard deviation of each."""
    deviations = [f"{name}_std" for name in COEFFICIENTS] if config.loss.kind == "response" else []
    return ["bearing_node", "speed_rpm", *COEFFICIENTS, *deviations]


def _runs_or_says_why_not(experiment: str, folder: Path, *overrides: str) -> None:
    """Training and robustness leave finite answers; what can't be combined is a ConfigError that says so."""
    try:
        config = composed(experiment, *overrides)
    except ConfigError as refusal:
        if any(
            words in str(refusal)
            for words in ("must use nodes", "must give machine.rotor.file", "must have a bearing for")
        ):
            return
        raise
    if config == composed(experiment):
        return  # what every stage has run with
    try:
        run("train", experiment, folder, *overrides)
    except IdentifiabilityError:  # all eight coefficients from one unbalance, or beside an isotropic bearing
        assert len(config.identify.unknowns) == 8
        assert "isotropic" in str(overrides) or "one_disc" in str(overrides)
        return
    except DataError as refusal:
        if "x and y measured at every bearing" in str(refusal) and "proximity_probes" in str(overrides):
            return  # the bearings of this rotor lie elsewhere
        raise
    identified = pd.read_csv(folder / "identified_coefficients.csv")
    assert list(identified) == identified_columns(config)
    assert np.isfinite(identified[COEFFICIENTS].to_numpy()).all()
    assert read(folder / "training.json")["outcome"] in {"converged", "budget_spent", "diverged"}


@pytest.mark.slow
@pytest.mark.parametrize(("group", "option", "experiment"), CHOICES)
def test_every_option_of_every_group(group: str, option: str, experiment: str, tmp_path: Path) -> None:
    """Any option with any experiment composes and trains, or is refused for nodes or a file."""
    chosen = [f"{group}={option}"]
    # With tests of their own; records and recordings are not those of these tests.
    measured = option.startswith("measured") or option.endswith(("_table", "_waveform", "_uff58"))
    if group in ("tracking", "comparison") or measured:
        compose_config([f"experiment={experiment}", *chosen])
        return
    if group == "optimizer":
        chosen += [f"optimizer.{phase}.steps=3" for phase in ("adam", "lbfgs") if phase in option]
    _runs_or_says_why_not(experiment, tmp_path / "x", *chosen)


@pytest.mark.slow
@pytest.mark.parametrize("change", MORE)
def test_other_values(change: str, tmp_path: Path) -> None:
    """What the configuration offers beside its options trains as well."""
    experiment = "ball_bearing" if "holdout" in change else "hydrostatic_stiffness"
    _runs_or_says_why_not(experiment, tmp_path / "x", change)


@pytest.mark.slow
@pytest.mark.parametrize("change", NETWORK)
def test_every_network(change: str, tmp_path: Path) -> None:
    """Widths, depths, activations and input scalings train."""
    _runs_or_says_why_not("hydrostatic_stiffness", tmp_path / "x", "model.width=5", change)


BY_DAY = {
    ("constant", "adam", "initial_guesses"),
    ("network", "adam_lbfgs", "initial_guesses"),
    ("network", "adam_levenberg_marquardt", "seeds"),
    ("constant", "levenberg_marquardt", "seeds"),
}
"""Each optimiser once, and each model with each robustness."""
COMBINATIONS = [
    pytest.param(*chosen, marks=[] if chosen in BY_DAY else pytest.mark.nightly)
    for chosen in product(
        ("constant", "network"),
        list_options("optimizer"),
        ("initial_guesses", "seeds"),  # noise_seeds is of another loss
    )
]


@pytest.mark.slow
@pytest.mark.parametrize(("model", "optimizer", "robustness"), COMBINATIONS)
def test_all_stages_of_all_combinations(model: str, optimizer: str, robustness: str, tmp_path: Path) -> None:
    """Model, optimiser and robustness in every combination go through all stages."""
    experiment = "ball_bearing" if robustness == "seeds" else "hydrostatic_damping"  # the other's robustness
    chosen = [f"model={model}", f"optimizer={optimizer}", f"robustness={robustness}", "optimizer.lbfgs.steps=2"]
    for stage in LINE:
        run(stage, experiment, tmp_path / "x", *chosen)
    assert {f"figures/{name}.png" for name in FIGURES} <= contents(tmp_path / "x").keys()


@pytest.mark.slow
@pytest.mark.parametrize("experiment", EXPERIMENTS)
def test_configure_writes_what_the_other_stages_read(experiment: str, tmp_path: Path) -> None:
    """config.yaml holds the configuration in SI, without what says how rather than what."""
    import yaml

    run("configure", experiment, tmp_path / "x")
    assert contents(tmp_path / "x").keys() == {"config.yaml"}
    mapping = yaml.safe_load((tmp_path / "x" / "config.yaml").read_text())
    assert mapping["name"] == experiment
    assert not {"stage", "tracking", "check", "threads", "device", "output"} & mapping.keys()
    assert mapping["machine"]["rotor"]["shaft"][0]["length"] < 10  # m


@pytest.mark.slow
def test_a_single_speed(tmp_path: Path) -> None:
    """One measured speed is a measurement: every stage answers, in JSON."""
    one = ["machine.speeds.start_rpm=1500", "machine.speeds.stop_rpm=1500"]
    for stage in LINE:
        run(stage, "hydrostatic_stiffness", tmp_path / "x", *one)
    for name in ("metrics.json", "robustness.json", "prediction.json", "training.json"):
        read(tmp_path / "x" / name)


@pytest.mark.slow
def test_a_speed_range_below_every_mode(tmp_path: Path) -> None:
    """Where no mode lies within twice the top speed, the stability margin has no decrement, and says so in JSON."""
    slow = [f"machine.speeds.{key}" for key in ("start_rpm=10", "stop_rpm=30", "step_rpm=10")]
    for stage in ("generate", "predict"):
        run(stage, "ball_bearing", tmp_path / "x", *slow, "machine.prediction.speed_rpm=20")
    assert read(tmp_path / "x" / "prediction.json")["modelled"]["stability"]["stable"] is True


OUTCOMES = {
    "optimizer.adam.learning_rate=1e300": "diverged",
    "model.initial_stiffness=1e300": "diverged",
    "optimizer.adam.patience=1": None,
}


@pytest.mark.parametrize("change", OUTCOMES)
def test_a_training_that_fails_has_a_named_outcome(
    change: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """A training that can't succeed ends with its outcome and what to try next, and complete files."""
    run("train", "ball_bearing", tmp_path / "x", "optimizer=adam", "optimizer.adam.steps=6", change)
    outcome = read(tmp_path / "x" / "training.json")["outcome"]
    assert outcome in ({OUTCOMES[change]} if OUTCOMES[change] else {"converged", "budget_spent"})
    said = capsys.readouterr()
    if outcome == "diverged":
        assert "try a smaller optimizer.adam.learning_rate" in said.out
        assert "diverged" in said.err


def test_a_rotor_that_ross_has_saved(tmp_path: Path) -> None:
    """A rotor file gives the same data as the configuration it was made from, and the bearings are found."""
    config = composed("ball_bearing")
    speeds = np.array(config.machine.speeds.rpm()) * RAD_S_PER_RPM
    file = tmp_path / "my rotor.toml"
    ross_rotor(config.machine.rotor, config.machine.bearings, speeds).save(file)
    from_file = [f"machine.rotor.file='{file}'", "machine.bearings.kind=rotor_file", "machine.rotor.bearing_nodes=[]"]
    run("train", "ball_bearing", tmp_path / "file", *from_file)
    assert len(pd.read_csv(tmp_path / "file" / "identified_coefficients.csv")) == 2 * len(speeds)
    run("generate", "ball_bearing", tmp_path / "config")
    for name in ("modelled_coefficients.csv", "excitation.csv"):
        one, other = (pd.read_csv(tmp_path / folder / name) for folder in ("file", "config"))
        pd.testing.assert_frame_equal(one, other, rtol=1e-9)
    one, other = (pd.read_parquet(tmp_path / folder / "vibration.parquet") for folder in ("file", "config"))
    pd.testing.assert_frame_equal(one, other, rtol=1e-6)


# --- missing inputs, other data --------------------------------------------------------------------


def test_a_stage_makes_what_it_needs_and_says_so(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """Predict in an empty folder generates and trains first, in this order, each announced once."""
    run("predict", "ball_bearing", tmp_path / "new folder")
    announced = re.findall(r"'([^']+)' is missing: running stage=(\w+) first", capsys.readouterr().out)
    assert [stage for _, stage in announced] == ["generate", "train"]
    assert {Path(path).parent for path, _ in announced} == {tmp_path / "new folder"}
    assert (tmp_path / "new folder" / "prediction.json").exists()


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
@pytest.mark.parametrize("name", NEEDED)
def test_a_missing_file_is_made_again(
    name: str, made: Made, tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    """Whichever input of evaluate is gone, its stage runs first and says so; the result is the same."""
    folder = Path(shutil.copytree(made("ball_bearing"), tmp_path / "x"))
    monkeypatch.setattr(evaluate, "draw_coefficients", lambda path, *_: path)  # they take most of the time
    before = contents(folder)
    (folder / name).unlink()
    run("evaluate", "ball_bearing", folder)
    assert f"'{folder / name}' is missing: running stage={NEEDED[name]} first" in capsys.readouterr().out
    assert contents(folder) == before


@pytest.mark.slow
def test_nothing_is_made_that_is_there(made: Made, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """With its inputs in place, a stage neither generates nor trains, and writes only its own files."""
    folder = Path(shutil.copytree(made("ball_bearing"), tmp_path / "x"))
    times = {path: path.stat().st_mtime_ns for path in folder.rglob("*")}
    run("evaluate", "ball_bearing", folder)
    assert "is missing" not in capsys.readouterr().out
    changed = {path.name for path, time in times.items() if path.is_file() and path.stat().st_mtime_ns != time}
    assert changed >= {"metrics.json", "stiffness.png", "damping.png", "training.png"}
    assert not changed & {*NEEDED, *("modelled_coefficients.csv", "prediction.json", "robustness.json")}


@pytest.mark.parametrize("stage", ["evaluate", "predict"])
def test_a_model_trained_on_other_data_is_refused(stage: str, made: Made, tmp_path: Path) -> None:
    """After another generate, the old model does not belong to the data any more."""
    other = "machine.runs.0.unbalances.0.magnitude=2e-4"
    folder = Path(shutil.copytree(made("ball_bearing"), tmp_path / "x"))
    run("generate", "ball_bearing", folder, other)
    before = contents(folder)
    with pytest.raises(DataError, match=r"must belong to the data at hand, .*: run stage=train"):
        run(stage, "ball_bearing", folder, other)
    assert contents(folder) == before
    run("train", "ball_bearing", folder, other)
    config = composed("ball_bearing", other).model_copy(update={"output": str(folder)})
    load_identified(config, load_measurement(config))


def test_a_prediction_of_what_training_saw_is_refused(made: Made, tmp_path: Path) -> None:
    """The twin is judged on an unbalance that no training run has."""
    seen = "machine.prediction.unbalances=[{node: 1, magnitude: 100 g mm}]"
    with pytest.raises(ConfigError, match="that training never saw, but run 'disc' is the same"):
        run("predict", "ball_bearing", Path(shutil.copytree(made("ball_bearing"), tmp_path / "x")), seen)


def test_a_prediction_between_the_speeds_is_refused(made: Made, tmp_path: Path) -> None:
    """Known coefficients are given at the data's speeds: the nearest of them is named."""
    with pytest.raises(ConfigError, match=r"one of the data's speeds .* got 1510: the nearest is 1500"):
        run(
            "predict",
            "ball_bearing",
            Path(shutil.copytree(made("ball_bearing"), tmp_path / "x")),
            "machine.prediction.speed_rpm=1510",
        )


@pytest.mark.slow
def test_the_twin_of_every_start_is_held_against_the_modelled_machine(
    made: Made, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """robustness.json: the worst mean error of the vibration never seen, computed here start by start."""
    folder = Path(shutil.copytree(made("hydrostatic_stiffness"), tmp_path / "x"))
    answers: list[Any] = []
    real = robustness._tabulate

    def spy(config: Any, found: Any, tables: Any, *others: Any) -> Any:
        answers.extend(tables)
        return real(config, found, tables, *others)

    monkeypatch.setattr(robustness, "_tabulate", spy)
    run("robustness", "hydrostatic_stiffness", folder)
    config = composed("hydrostatic_stiffness").model_copy(update={"output": str(folder)})
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
    told = read(folder / "robustness.json")["displacement"]["worst_mean_error_percent"]
    assert told == pytest.approx(max(errors), rel=1e-9)


@pytest.mark.slow
def test_a_run_of_the_data_is_no_vibration_never_seen(made: Made, tmp_path: Path) -> None:
    """Where the prediction's unbalance is that of a run, robustness does not hold the twin against it."""
    folder = Path(shutil.copytree(made("ball_bearing"), tmp_path / "x"))
    assert "displacement" in read(folder / "robustness.json")
    run("robustness", "ball_bearing", folder, "machine.prediction.unbalances=[{node: 1, magnitude: 100 g mm}]")
    assert "displacement" not in read(folder / "robustness.json")


def test_initial_guesses_need_an_unknown_stiffness(tmp_path: Path) -> None:
    """Robustness over initial stiffnesses has nothing to vary where only damping is unknown."""
    with pytest.raises(ConfigError, match="must have an unknown stiffness"):
        run("robustness", "ball_bearing", tmp_path / "x", "identify.unknowns=[cxx]")


# --- what a run leaves ---------------------------------------------------------------------------------


@pytest.mark.slow
@pytest.mark.parametrize("figure", FIGURES)
@pytest.mark.parametrize("experiment", ONE_BY_DAY)
def test_figures_show_something(experiment: str, figure: str, made: Made) -> None:
    """Each figure is a picture of some size with curves in it: neither blank nor a few pixels."""
    from matplotlib import image

    pixels = image.imread(made(experiment) / "figures" / f"{figure}.png")
    height, width = pixels.shape[:2]
    assert height > 300
    assert width > 500
    inked = (pixels[..., :3] < 0.95).any(axis=-1)
    assert 0.005 < inked.mean() < 0.5
    coloured = np.ptp(pixels[..., :3], axis=-1) > 0.2
    assert coloured.sum() > 200
    rows, columns = np.flatnonzero(inked.any(axis=1)), np.flatnonzero(inked.any(axis=0))
    assert np.ptp(rows) > 0.8 * height  # it fills its frame, and touches no edge
    assert np.ptp(columns) > 0.8 * width
    assert rows[0] > 0
    assert rows[-1] < height - 1
    assert columns[0] > 0
    assert columns[-1] < width - 1


@pytest.mark.parametrize("experiment", QUICK_FIRST)
def test_files_of_an_experiment(experiment: str, made: Made) -> None:
    """The files of the design, and no temporary one."""
    assert not [name for name in contents(made(experiment)) if Path(name).name.startswith((".", "tmp"))]
    assert contents(made(experiment)).keys() >= {
        *("vibration.parquet", "excitation.csv", "modelled_coefficients.csv", "known_coefficients.csv"),
        *("identified_coefficients.csv", "model.safetensors", "model.json", "training.json", "history.csv"),
        *("metrics.json", "summary.json", "least_squares_coefficients.csv"),
        *("robustness.json", "robustness.csv", "prediction.json", "prediction.csv"),
    }
    assert {path.stem for path in (made(experiment) / "figures").iterdir()} == set(FIGURES)


@pytest.mark.parametrize("experiment", QUICK_FIRST)
def test_tables_have_the_columns_that_others_rely_on(experiment: str, made: Made) -> None:
    """The doors of the design: names and order of columns, one row a speed and bearing, rpm as written."""
    folder, config = made(experiment), composed(experiment)
    speeds, nodes = config.machine.speeds.rpm(), list(config.machine.rotor.bearing_nodes)
    vibration = pd.read_parquet(folder / "vibration.parquet")
    own = ["frequency_hz"] if any(run.frequency_hz or run.frequency_ratio for run in config.machine.runs) else []
    assert list(vibration) == ["run", "speed_rpm", "node", "direction", "amplitude_m", "phase_deg", *own]
    assert sorted(set(vibration["speed_rpm"])) == speeds
    assert set(vibration["direction"]) == {"x", "y"}
    assert list(dict.fromkeys(vibration["run"])) == [r.name for r in config.machine.runs]
    everywhere = 1 + sum(segment.elements for segment in config.machine.rotor.shaft)
    n_nodes = {"all": everywhere, "bearings": len(nodes)}[str(config.machine.probes.at)]
    assert len(vibration) == len(config.machine.runs) * len(speeds) * n_nodes * 2
    excitation = pd.read_csv(folder / "excitation.csv")
    assert list(excitation) == ["run", "kind", "node", "magnitude", "phase_deg", "whirl"]
    known = ["bearing_node", "speed_rpm", *known_names(config)]
    for name, columns in {
        "modelled_coefficients": ["bearing_node", "speed_rpm", *COEFFICIENTS],
        "identified_coefficients": identified_columns(config),
        "least_squares_coefficients": ["bearing_node", "speed_rpm", *COEFFICIENTS],
        "known_coefficients": known,
    }.items():
        table = pd.read_csv(folder / f"{name}.csv")
        assert list(table) == columns
        assert table["bearing_node"].tolist() == [node for node in nodes for _ in speeds]
        assert table["speed_rpm"].tolist() == speeds * len(nodes)
    history = pd.read_csv(folder / "history.csv")
    held_out = ["held_out_loss"] if config.training.holdout_every else []
    assert list(history) == ["step", "phase", "loss", *held_out]
    assert history["step"].tolist() == list(range(len(history)))
    prediction = pd.read_csv(folder / "prediction.csv")
    assert prediction["speed_rpm"].tolist() == speeds
    for system in ("modelled", "identified"):
        for direction in "xy":
            assert {f"{direction}_{system}_amplitude_m", f"{direction}_{system}_phase_deg"} <= set(prediction)


@pytest.mark.parametrize("experiment", QUICK_FIRST)
def test_known_columns_of_the_identified_table_are_the_known_ones(experiment: str, made: Made) -> None:
    """identified_coefficients.csv has all eight; those that were not identified are copied, to the last digit."""
    folder = made(experiment)
    identified, known = (pd.read_csv(folder / f"{n}_coefficients.csv") for n in ("identified", "known"))
    pd.testing.assert_frame_equal(identified[list(known)], known, check_exact=True)


@pytest.mark.parametrize("experiment", QUICK_FIRST)
def test_metrics_have_the_shape_that_others_rely_on(experiment: str, made: Made) -> None:
    """metrics.json: bearing, coefficient, error; only what was identified; finite numbers."""
    config = composed(experiment)
    metrics = read(made(experiment) / "metrics.json")
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
    robustness = read(made(experiment) / "robustness.json")
    if config.robustness.over == "noise":
        assert robustness["data_sets"] == config.robustness.count
    else:
        assert sum(robustness["outcomes"].values()) == robustness["starts"]
    assert list(robustness["coefficients"]) == [str(node) for node in config.machine.rotor.bearing_nodes]
    prediction = read(made(experiment) / "prediction.json")
    assert set(prediction) == {"modelled", "identified", "displacement"}
    assert set(prediction["displacement"]) == {"x", "y"}
    for system in ("modelled", "identified"):
        assert isinstance(prediction[system]["stability"]["stable"], bool)
    assert read(made(experiment) / "training.json").keys() >= {"outcome", "data_fingerprint", "seed", "loss"}


@pytest.mark.parametrize("experiment", QUICK_FIRST)
def test_metrics_are_the_errors_of_the_tables(experiment: str, made: Made) -> None:
    """The mean error of metrics.json is that of identified against modelled table, computed here by hand."""
    folder = made(experiment)
    identified, modelled = (
        pd.read_csv(folder / f"{n}_coefficients.csv").set_index(["bearing_node", "speed_rpm"])
        for n in ("identified", "modelled")
    )
    for node, of in read(folder / "metrics.json")["coefficients"].items():
        for name, error in of.items():
            found, true = identified.loc[int(node), name], modelled.loc[int(node), name]
            relative = 100 * (found - true).abs() / true.abs()
            mean, top = error["mean_error_percent"], error["max_error_percent"]
            assert mean == pytest.approx(relative.mean(), rel=1e-6, abs=1e-12)
            assert top == pytest.approx(relative.max(), rel=1e-6, abs=1e-12)


# --- check -----------------------------------------------------------------------------------------------

Checking = Callable[..., int]


@pytest.fixture
def checking(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Checking:
    """``checking(rules, metrics, overrides)``: the exit code of stage=check on one experiment, and what it wrote."""
    thresholds = tmp_path / "thresholds"
    thresholds.mkdir()
    monkeypatch.setattr(check, "THRESHOLDS", thresholds)

    def act(rules: str | bytes, metrics: str | None, *overrides: str, name: str = "rig") -> int:
        raw = rules if isinstance(rules, bytes) else rules.encode()
        (thresholds / f"{name}.yaml").write_bytes(raw)
        folder = tmp_path / "artifacts" / name
        folder.mkdir(parents=True, exist_ok=True)
        if metrics is not None:
            (folder / "metrics.json").write_text(metrics)
        try:
            run("check", "ball_bearing", tmp_path / "artifacts" / "ball_bearing", *overrides)
        except SystemExit as stop:
            if not isinstance(stop.code, int):
                raise
            return stop.code
        return 0

    return act


RULE = "- {metric: coefficients.*.kxx.mean_error_percent, max: 1.0, why: because the bar says so}\n"
GOOD = '{"coefficients": {"0": {"kxx": {"mean_error_percent": 0.5}}, "2": {"kxx": {"mean_error_percent": 1.0}}}}'


def test_check_passes_what_holds(checking: Checking, capsys: pytest.CaptureFixture[str]) -> None:
    """At its threshold a metric still holds; exit code 0, and a table of all."""
    assert checking(RULE, GOOD) == 0
    said = capsys.readouterr().out
    assert "coefficients.0.kxx.mean_error_percent" in said
    assert "coefficients.2.kxx.mean_error_percent" in said
    assert "all 2 metrics hold" in said


BROKEN = {
    "too large": GOOD.replace("0.5", "1.0000001"),
    "NaN": GOOD.replace("0.5", "NaN"),
    "infinite": GOOD.replace("0.5", "Infinity"),
    "a text": GOOD.replace("0.5", '"0.5"').replace("1.0", '"1.0"'),
    "true": GOOD.replace("0.5", "true").replace("1.0", "false"),
    "no such metric": '{"coefficients": {"0": {"kyy": {"mean_error_percent": 0.5}}}}',
    "no coefficients": '{"coefficients": {}}',
    "no object": "[1, 2]",
    "no JSON": "{",
    "no file": None,
}


@pytest.mark.parametrize("case", BROKEN)
def test_check_fails_what_is_passed_or_missing(
    case: str, checking: Checking, capsys: pytest.CaptureFixture[str]
) -> None:
    """A passed threshold, and a metric that is missing or no number, are exit code 1 with the reason."""
    assert checking(RULE, BROKEN[case]) == 1
    said = capsys.readouterr()
    assert "FAILED" in said.out
    assert "must be at most 1" in said.err
    assert "because the bar says so" in said.err


RULES = {
    "empty": "",
    "no list": "metric: x\nmax: 1\n",
    "no reason": "- {metric: x, max: 1}\n",
    "a short reason": "- {metric: x, max: 1, why: so}\n",
    "unknown key": RULE.replace("max", "least"),
    "no number": RULE.replace("1.0", "much"),
    "infinite": RULE.replace("1.0", ".inf"),
    "no YAML": "- {metric: [",
    "no UTF-8": b"\xff\xfe- x",
    "an object": "!!python/object/apply:os.system ['echo ran']",
    "no rule": "[]",
}


@pytest.mark.parametrize("case", RULES)
def test_thresholds_that_are_no_thresholds(case: str, checking: Checking) -> None:
    """A damaged threshold file is a mistake (exit code 2), never a passed check."""
    with pytest.raises(ConfigError, match=r"rig\.yaml"):
        checking(RULES[case], GOOD)


def test_check_of_an_unknown_experiment(checking: Checking) -> None:
    """The nearest name is offered."""
    with pytest.raises(ConfigError, match="did you mean 'rig'"):
        checking(RULE, GOOD, "check.experiments=[rigg]")


def test_check_of_some_experiments(checking: Checking) -> None:
    """Only the experiments that are named are held against their thresholds."""
    assert checking(RULE, None, name="other") == 1
    assert checking(RULE, GOOD) == 1
    assert checking(RULE, GOOD, "check.experiments=[rig]") == 0
    assert checking(RULE, GOOD, "check.experiments=[rig,other]") == 1


@pytest.mark.slow
@pytest.mark.nightly  # by day, test_experiments.py holds every threshold against what the graph made
def test_check_of_freshly_made_experiments(made: Made, capsys: pytest.CaptureFixture[str]) -> None:
    """The committed thresholds find their metrics in the files that the stages write."""
    for experiment in EXPERIMENTS:
        made(experiment)
        if experiment in COMPARED:
            run("compare", experiment, made(experiment), *FEW_CASES, COMPARED[experiment])
    capsys.readouterr()
    with pytest.raises(SystemExit) as stop:  # few steps pass no accuracy bar
        run("check", "ball_bearing", made("ball_bearing"), f"check.experiments=[{','.join(EXPERIMENTS)}]")
    assert stop.value.code == 1
    said = capsys.readouterr()
    assert "missing" not in said.out + said.err
    assert all(name in said.out for name in EXPERIMENTS)


def test_every_option_is_tried_by_day() -> None:
    """With one experiment, and each optimiser through all stages."""
    tried = [tuple(choice.values[:2]) for choice in CHOICES if not choice.marks]
    assert sorted(tried) == [(group, option) for group in GROUPS for option in list_options(group)]
    assert sorted(optimizer for _, optimizer, _ in BY_DAY) == list_options("optimizer")


def test_all_stages_are_tried_here() -> None:
    """A new stage is added to these tests, or tried in a test file of its own (such as test_summary.py)."""
    elsewhere = {
        *("configure", "check", "tune", "samplers", "diagnose", "design", "ingest", "compare", "summary"),
        "new",
    }
    assert set(LINE) | elsewhere == set(STAGES)
