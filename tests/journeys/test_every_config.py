"""Every experiment and option runs, stage by stage, on few speeds and with few steps; and what a run leaves behind."""

from __future__ import annotations

import shutil
from collections.abc import Sequence
from functools import cache
from pathlib import Path

import numpy as np
import pandas as pd
import pytest
import yaml
from conftest import Artifacts, Made, Run
from running import DEFAULT, EXPERIMENTS, FIGURES, LINE, composed, contents, few, identified_columns, strict_json

from benchmarks.ross_oracle import ross_rotor
from pipeline.coefficients import COEFFICIENTS
from pipeline.config.compose import compose_config
from pipeline.config.loader import CONF, list_options
from pipeline.errors import ConfigError, DataError, IdentifiabilityError
from pipeline.stages import STAGES
from pipeline.units import RAD_S_PER_RPM

GROUPS = sorted(p.name for p in CONF.iterdir() if p.is_dir() and p.name not in {"experiment", "thresholds"})


@pytest.mark.slow
@pytest.mark.parametrize("experiment", [DEFAULT])
def test_every_stage_of_an_experiment_again_gives_the_same_bits(
    experiment: str, made: Made, run: Run, tmp_path: Path
) -> None:
    """All stages run, and a second time, over their own files, they write the same bytes, figures too."""
    first = contents(made(experiment, pictures=True))
    folder = Path(shutil.copytree(made(experiment, pictures=True), tmp_path / "again"))
    for stage in LINE:
        run(stage, few(experiment), folder)
    again = contents(folder)
    assert [name for name in first | again if again.get(name) != first.get(name)] == []


@cache
def _defaults() -> dict[str, str]:
    """The option of each group that the default experiment has."""

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


CHOICES = [(group, option, home(group, option)) for group in GROUPS for option in list_options(group)]
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
COMPOSING = ("must use nodes", "must give machine.rotor.file", "must have a bearing for")
"""Laws by which any option may be refused before anything runs."""
ELSEWHERE = (
    *("must use nodes", "must come with loss=response", "must go with loss.kind=response", "must have machine.laws"),
    *("made of functions of the speed alone", "must be a node without a bearing"),
)
"""Laws by which an experiment may refuse an option that fits another."""
NETWORK = [
    *(f"model.activation={name}" for name in ("tanh", "silu", "sine")),
    *(f"model.input_scaling={name}" for name in ("rpm", "log_rpm")),
    *("model.depth=3", "model.depth=1"),
]


def _runs_or_says_why_not(
    run: Run, experiment: str, folder: Path, *overrides: str, elsewhere: Sequence[str] = ()
) -> None:
    """Training and robustness leave finite answers; what can't be combined is a ConfigError that says so."""
    refused = [*COMPOSING, *elsewhere]
    try:
        config = few(experiment, *overrides)
        if config == few(experiment):
            return  # what every stage has run with
        refused = [*elsewhere]
        run("train", config, folder)
    except ConfigError as refusal:
        if not any(words in str(refusal) for words in refused):
            raise
        return
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
    assert np.isfinite(identified[[*COEFFICIENTS]].to_numpy()).all()
    assert strict_json(folder / "training.json")["outcome"] in {"converged", "budget_spent", "diverged"}


@pytest.mark.slow
@pytest.mark.parametrize(
    ("group", "option", "experiment"),
    # Networks of bearings start from the bearings without.
    [pytest.param(*one, marks=[pytest.mark.nightly] * (one[1] == "bearings")) for one in CHOICES],
)
def test_every_option_of_every_group(group: str, option: str, experiment: str, run: Run, tmp_path: Path) -> None:
    """Any option with any experiment composes and trains, or is refused by name."""
    elsewhere = () if experiment == home(group, option) else ELSEWHERE
    chosen = [f"{group}={option}"]
    # With tests of their own; records and recordings are not those of these tests.
    measured = option.startswith("measured") or option.endswith(("_table", "_waveform", "_uff58")) or option == "rk4"
    if group in ("tracking", "comparison") or measured:
        compose_config([f"experiment={experiment}", *chosen])
        return
    if option in ("law", "hybrid"):
        experiment = "oil_temperatures"  # the one whose machine has bearing laws
    if option.startswith("bearings"):
        experiment = "noisy_all"  # whole impedances, by the output error
    if group == "optimizer":
        chosen += [f"optimizer.{phase}.steps=3" for phase in ("adam", "lbfgs") if phase in option]
    _runs_or_says_why_not(run, experiment, tmp_path / "x", *chosen, elsewhere=elsewhere)


@pytest.mark.slow
@pytest.mark.parametrize("change", MORE)
def test_other_values(change: str, run: Run, tmp_path: Path) -> None:
    _runs_or_says_why_not(run, "ball_bearing" if "holdout" in change else DEFAULT, tmp_path / "x", change)


@pytest.mark.slow
@pytest.mark.parametrize("change", NETWORK)
def test_every_network(change: str, run: Run, tmp_path: Path) -> None:
    _runs_or_says_why_not(run, DEFAULT, tmp_path / "x", "model.width=5", change)


BY_DAY = [
    ("constant", "adam", "initial_guesses"),
    ("network", "adam_lbfgs", "initial_guesses"),
    ("network", "adam_levenberg_marquardt", "seeds"),
    ("constant", "levenberg_marquardt", "seeds"),
]
"""Each optimiser once, and each model with each robustness."""


@pytest.mark.slow
@pytest.mark.usefixtures("no_pictures")
@pytest.mark.parametrize(("model", "optimizer", "robustness"), BY_DAY)
def test_all_stages_of_all_combinations(model: str, optimizer: str, robustness: str, run: Run, tmp_path: Path) -> None:
    experiment = "ball_bearing" if robustness == "seeds" else "hydrostatic_damping"  # the other's robustness
    chosen = [f"model={model}", f"optimizer={optimizer}", f"robustness={robustness}", "optimizer.lbfgs.steps=2"]
    for stage in LINE:
        run(stage, few(experiment, *chosen), tmp_path / "x")
    assert {f"figures/{name}.png" for name in FIGURES} <= contents(tmp_path / "x").keys()


@pytest.mark.slow
@pytest.mark.parametrize("experiment", EXPERIMENTS)
def test_configure_writes_what_the_other_stages_read(
    experiment: str, run: Run, artifacts: Artifacts, tmp_path: Path
) -> None:
    """config.yaml holds the configuration in SI, without what says how rather than what; the graph made the others."""

    assert composed(f"experiment={experiment}").output == f"artifacts/{experiment}"
    folder = artifacts.root / "configurations" / experiment
    if experiment == DEFAULT:
        run("configure", few(experiment), folder := tmp_path / "x")
        assert contents(folder).keys() == {"config.yaml"}
    mapping = yaml.load((folder / "config.yaml").read_text(), yaml.CSafeLoader)
    assert mapping["name"] == experiment
    assert not {"stage", "tracking", "check", "threads", "output"} & mapping.keys()
    assert mapping["machine"]["rotor"]["shaft"][0]["length"] < 10  # m


@pytest.mark.slow
def test_a_single_speed(run: Run, tmp_path: Path) -> None:
    for stage in LINE:
        run(stage, few(DEFAULT, "machine.speeds.start_rpm=1500", "machine.speeds.stop_rpm=1500"), tmp_path / "x")
    for name in ("metrics.json", "robustness.json", "prediction.json", "training.json"):
        strict_json(tmp_path / "x" / name)


@pytest.mark.slow
def test_a_speed_range_below_every_mode(run: Run, tmp_path: Path) -> None:
    """Where no mode lies within twice the top speed, the stability margin has no decrement, and says so in JSON."""
    slow = [f"machine.speeds.{key}" for key in ("start_rpm=10", "stop_rpm=30", "step_rpm=10")]
    for stage in ("generate", "predict"):
        run(stage, few("ball_bearing", *slow, "machine.prediction.speed_rpm=20"), tmp_path / "x")
    assert strict_json(tmp_path / "x" / "prediction.json")["modelled"]["stability"]["stable"] is True


OUTCOMES = {
    "optimizer.adam.learning_rate=1e300": "diverged",
    "model.initial_stiffness=1e300": "diverged",
    "optimizer.adam.patience=1": None,
}


@pytest.mark.parametrize("change", OUTCOMES)
def test_a_training_that_fails_has_a_named_outcome(
    change: str, run: Run, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """A training that can't succeed ends with its outcome and what to try next, and complete files."""
    run("train", few("ball_bearing", "optimizer=adam", "optimizer.adam.steps=6", change), tmp_path / "x")
    outcome = strict_json(tmp_path / "x" / "training.json")["outcome"]
    assert outcome in ({OUTCOMES[change]} if OUTCOMES[change] else {"converged", "budget_spent"})
    said = capsys.readouterr()
    if outcome == "diverged":
        assert "try a smaller optimizer.adam.learning_rate" in said.out
        assert "diverged" in said.err


def test_a_rotor_that_ross_has_saved(run: Run, tmp_path: Path) -> None:
    """A rotor file gives the same data as the configuration it was made from."""
    config = few("ball_bearing")
    speeds = np.array(config.machine.speeds.rpm()) * RAD_S_PER_RPM
    file = tmp_path / "my rotor.toml"
    ross_rotor(config.machine.rotor, config.machine.bearings, speeds).save(file)
    from_file = [f"machine.rotor.file='{file}'", "machine.bearings.kind=rotor_file", "machine.rotor.bearing_nodes=[]"]
    run("generate", few("ball_bearing", *from_file), tmp_path / "file")
    run("generate", config, tmp_path / "config")
    for name in ("modelled_coefficients.csv", "excitation.csv"):
        one, other = (pd.read_csv(tmp_path / folder / name) for folder in ("file", "config"))
        pd.testing.assert_frame_equal(one, other, rtol=1e-9)
    one, other = (pd.read_parquet(tmp_path / folder / "vibration.parquet") for folder in ("file", "config"))
    pd.testing.assert_frame_equal(one, other, rtol=1e-6)


def test_every_option_is_tried_by_day() -> None:
    assert sorted(optimizer for _, optimizer, _ in BY_DAY) == list_options("optimizer")


def test_all_stages_are_tried_here() -> None:
    """A new stage is added to these tests, or tried in a test file of its own (such as test_summary.py)."""
    elsewhere = {
        *("configure", "check", "tune", "diagnose", "senses", "design", "ingest", "compare", "summary"),
        *(
            "new",
            "identify",
            "verdict",
            "report",
            "export",
            "runup",
            "balance",
            "choose",
            "promote",
        ),
    }
    assert set(LINE) | elsewhere == set(STAGES)
