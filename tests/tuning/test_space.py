"""Search spaces and samplers, and what a study says: everything but processes and storages."""

from __future__ import annotations

import json
import math
import re
from contextlib import nullcontext
from dataclasses import replace
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import pytest
import yaml
from conftest import Machine, assert_says, examples
from hypothesis import given
from hypothesis import strategies as st
from samplers import run as compare_samplers

from pipeline.config.compose import compose_config
from pipeline.config.promotion import apply_values
from pipeline.config.schema import Config
from pipeline.errors import ConfigError
from pipeline.identification.residual_loss import fit_chebyshev, initial_parameters, prepare_residual
from pipeline.identification.training import setup_of
from pipeline.stages import run_stage
from pipeline.tuning.space import applies, find_default, make_sampler, suggest, translate

pytestmark = pytest.mark.slow  # it trains, or starts processes

EXPERIMENTS = ["ball_bearing", "hydrostatic_stiffness", "hydrostatic_damping"]
NO_STUDY = "tuning.promoted=no/such/folder"


@cache
def untuned(*overrides: str) -> Config:
    """A configuration that no study of the checkout has touched."""
    return compose_config([*overrides, NO_STUDY])


@pytest.mark.parametrize("name", EXPERIMENTS)
def test_trial_0_is_the_configured_default(name: str) -> None:
    """The default's parameters stand for the very configuration that they were read from."""
    config = untuned(f"experiment={name}")
    assert apply_values(config, translate(config.tuning.space, find_default(config)), "default") == config


class Draws:
    """A trial that draws from hypothesis, and remembers the names that it was asked for."""

    def __init__(self, data: st.DataObject) -> None:
        self.data = data
        self.asked: list[str] = []

    def suggest_int(self, name: str, low: int, high: int, *, log: bool) -> int:
        self.asked.append(name)
        return self.data.draw(st.integers(low, high), name)

    def suggest_float(self, name: str, low: float, high: float, *, log: bool) -> float:
        self.asked.append(name)
        return self.data.draw(st.floats(low, high), name)

    def suggest_categorical(self, name: str, choices: Any) -> Any:
        self.asked.append(name)
        return self.data.draw(st.sampled_from(choices), name)


@pytest.mark.parametrize("name", EXPERIMENTS)
@given(data=st.data())
@examples(60)
def test_every_point_of_the_space_is_a_configuration(name: str, data: st.DataObject) -> None:
    """Whatever is drawn fits the schema, changes nothing else, and leaves out what has no meaning."""
    config = untuned(f"experiment={name}")
    space, trial = config.tuning.space, Draws(data)
    parameters = suggest(trial, space)
    assert trial.asked == list(parameters)
    assert [key for key in space if key in parameters] == [key for key in space if applies(space[key], parameters)]
    made = apply_values(config, translate(space, parameters), "trial")
    for section in ("machine", "data", "identify", "tuning", "seed"):
        assert getattr(made, section) == getattr(config, section)
    assert made.training.holdout_every == config.training.holdout_every
    steps = [getattr(made.optimizer, phase).steps > 0 for phase in type(made.optimizer).model_fields]
    named = str(parameters["optimizer"])
    assert steps == [named.startswith("adam"), named.endswith("lbfgs"), named.endswith("levenberg_marquardt")]


@pytest.mark.parametrize(
    ("overrides", "words"),
    [
        (["model.width=200"], "widen tuning.space.width"),
        (["model.activation=sine", "tuning.space.activation.choices=[tanh,silu]"], "activation are tanh, silu"),
        (["optimizer.lbfgs.steps=100"], "trial 0"),
        (["tuning=constant", "~tuning.space.output", "experiment=ball_bearing"], ""),
        (
            ["experiment=ball_bearing", "+tuning.space.width={kind: int, key: model.breadth, low: 1, high: 2}"],
            "model.breadth",
        ),
        (["tuning.space.width.high=1000"], "model.width"),
        (["tuning=study"], "tuning.space is empty"),
    ],
)
def test_a_space_must_contain_the_default_and_fit_the_schema(overrides: list[str], words: str) -> None:
    """Where it does not, a sentence says which dimension and what to do; where it does, nothing is said."""
    with pytest.raises(ConfigError, match=words) if words else nullcontext():
        assert find_default(untuned("stage=tune", *overrides))


@pytest.mark.parametrize("name", ["adam", "adam_lbfgs", "adam_levenberg_marquardt", "levenberg_marquardt"])
def test_each_optimizer_is_told_from_the_others(name: str) -> None:
    assert find_default(untuned(f"optimizer={name}", "tuning.space.adam_epochs.high=5000"))["optimizer"] == name


def _parabola(study: Any, config: Config) -> None:
    """One trial of a function with a conditional parameter."""
    trial = study.ask()
    kind = trial.suggest_categorical("kind", ["a", "b"])
    x = trial.suggest_float("x", -3, 3)
    study.tell(trial, (x - 1) ** 2 + (trial.suggest_float("y", 0, 1) if kind == "a" else 0.5))


@pytest.mark.parametrize("name", ["tpe", "random", "gp"])
def test_a_study_reopened_before_every_trial_draws_the_same(name: str) -> None:
    """The draws depend on seed, trial and parameter, not on how long the sampler has lived."""
    import optuna

    optuna.logging.set_verbosity(optuna.logging.ERROR)
    config = untuned(f"tuning.sampler={name}", "tuning.startup_trials=4").tuning
    at_once = optuna.create_study(sampler=make_sampler(config))
    storage = optuna.storages.InMemoryStorage()
    optuna.create_study(storage=storage, study_name="x")
    for _ in range(12):
        _parabola(at_once, config)
        _parabola(optuna.load_study(study_name="x", storage=storage, sampler=make_sampler(config)), config)
    reopened = optuna.load_study(study_name="x", storage=storage)
    assert [t.params for t in reopened.trials] == [t.params for t in at_once.trials]
    assert len({tuple(t.params.values()) for t in at_once.trials}) == 12, "no point is drawn twice"


def test_the_sampler_seed_matters() -> None:
    import optuna

    samplers = [make_sampler(untuned(f"tuning.sampler_seed={seed}").tuning) for seed in (0, 1)]
    first, second = (optuna.create_study(sampler=sampler).ask().suggest_float("x", 0, 1) for sampler in samplers)
    assert first != second


def test_a_series_finds_coefficients_that_are_one(hydrostatic: Machine) -> None:
    """Stiffness that is a polynomial of the logarithm of the speed is identified to rounding."""
    from pipeline.coefficients import COEFFICIENTS
    from pipeline.data.simulate import simulate
    from pipeline.rotor.bearing_table import BearingTable

    x = np.log(hydrostatic.speeds / hydrostatic.speeds[0]) / np.log(hydrostatic.speeds[-1] / hydrostatic.speeds[0])
    values = hydrostatic.bearings.values.copy()
    for b in range(2):
        values[b, :, COEFFICIENTS.index("kxx")] = 1e7 * (1 + b + x - 0.5 * x**3)
        values[b, :, COEFFICIENTS.index("kyy")] = 2e7 * (1 - 0.4 * x**2 + 0.1 * x**4)
    truth = BearingTable(hydrostatic.bearings.nodes, hydrostatic.speeds, values)
    dataset = simulate(hydrostatic.rotor, truth, hydrostatic.excitations)
    measurement = replace(hydrostatic.measurement, dataset=dataset, known=truth)
    fit = fit_chebyshev(measurement, setup_of(untuned("training.holdout_every=5")))
    assert fit.held_out_loss < 1e-11
    for name in ("kxx", "kyy"):
        np.testing.assert_allclose(fit.identified.table(truth).coefficient(name), truth.coefficient(name), rtol=1e-9)


def test_the_held_out_loss_is_the_residual_of_the_equation_of_motion(hydrostatic: Machine) -> None:
    """The same number from the equations themselves, without the reduced rows, whatever the trained loss is."""

    from pipeline.identification.held_out import held_out_speeds

    numbers = []
    for scaling in ("per_speed", "none"):
        setup = setup_of(untuned(f"loss.scaling={scaling}", "training.holdout_every=5"))
        prepared = prepare_residual(hydrostatic.measurement, setup)
        parameters = initial_parameters(prepared, setup, 3)
        numbers.append(float(prepared.per_speed_held_out_loss(parameters)[0]))
    table = prepared.identified(parameters[0]).table(hydrostatic.bearings)
    kept = held_out_speeds(len(hydrostatic.speeds), 5)
    residual = hydrostatic.equations.residual(table.impedance())[:, kept]
    force = hydrostatic.equations.free_residual[:, kept]
    share = np.abs(residual) ** 2 / (np.abs(force) ** 2).mean(axis=(2, 3), keepdims=True)
    assert numbers[0] == pytest.approx(math.sqrt(share.mean() / 2), rel=1e-9)  # real and imaginary part
    assert numbers[0] == numbers[1]


SMALL = [
    "experiment=ball_bearing",
    "tracking=none",
    "machine.speeds.step_rpm=490",
    "tuning.n_trials=6",
    "tuning.startup_trials=3",
    "tuning.space.adam_epochs.high=400",
    *("optimizer=adam_levenberg_marquardt", "loss.scaling=per_speed", "model.parametrisation=log"),
    "optimizer.adam.steps=100",
]


@pytest.fixture(scope="module")
def finished(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A small study, run through the stage; holds ``data`` and ``study``."""
    folder = tmp_path_factory.mktemp("small study")
    run_stage(small(folder))
    return folder


def small(folder: Path, *overrides: str) -> Config:
    """The small study in ``folder``."""
    places = (f"output={folder}/data", f"tuning.folder={folder}/study")
    return compose_config(["stage=tune", *SMALL, *places, f"tuning.storage='sqlite:///{folder}/optuna.db'", *overrides])


def test_a_study_writes_what_a_person_reads(finished: Path) -> None:
    study = finished / "study"
    summary = json.loads((study / "summary.json").read_text())
    best = yaml.safe_load((study / "best.yaml").read_text())
    trials = pd.read_csv(study / "trials.csv")
    finalists = pd.read_csv(study / "finalists.csv")
    assert best["trial"] == summary["promoted_trial"]
    assert list(trials["trial"]) == list(range(6))
    assert sum(summary["trials"].values()) == 6
    assert finalists.groupby("trial")["seed"].count().eq(5).all()
    assert 0 in set(finalists["trial"]), "the default is always a finalist"
    assert {"kxx_mean_error_percent", "kyy_mean_error_percent"} <= set(finalists)
    text = (study / "README.md").read_text()
    assert_says(text, summary["verdict"][1:], "**Question.**", "**Objective.**", "**Budget.**", "**Result.**")
    figures = {path.name for path in (study / "figures").glob("*.png")}
    assert {"history.png", "finalists.png", "slice.png", "parallel_coordinates.png", "learning_curves.png"} <= figures
    assert all(f"figures/{name})" in text for name in figures)


def test_a_study_at_rounding_keeps_the_default(finished: Path) -> None:
    """Ball bearings without noise leave nothing to tune, and the study says so instead of promoting luck."""
    summary = json.loads((finished / "study" / "summary.json").read_text())
    values = yaml.safe_load((finished / "study" / "best.yaml").read_text())["values"]
    assert (summary["promoted_trial"], values) == (0, {})
    assert "tuning can't help" in summary["verdict"]


@pytest.mark.usefixtures("no_pictures")
def test_a_finished_study_is_not_made_again(finished: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """The second run changes no file and says that all is there; a missing file is made again."""
    before = {path: path.stat().st_mtime_ns for path in (finished / "study").rglob("*") if path.is_file()}
    run_stage(small(finished))
    assert "the study has its 6 trials" in capsys.readouterr().out
    assert before == {path: path.stat().st_mtime_ns for path in (finished / "study").rglob("*") if path.is_file()}
    text = (finished / "study" / "best.yaml").read_text()
    (finished / "study" / "best.yaml").unlink()
    run_stage(small(finished))
    assert (finished / "study" / "best.yaml").read_text() == text


@pytest.mark.usefixtures("no_pictures")
def test_samplers_are_compared_at_equal_budget(finished: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """As many trials of each sampler and seed, in studies of their own, and a sentence on who won."""
    compare_samplers(small(finished), ["tpe", "random"], [0, 1])
    table = pd.read_csv(finished / "study" / "samplers.csv")
    assert table.groupby(["sampler", "seed"]).size().tolist() == [5, 5, 5, 5]
    assert (table.groupby(["sampler", "seed"])["best_held_out_loss"].diff().dropna() <= 0).all()
    summary = json.loads((finished / "study" / "samplers.json").read_text())
    for name in ("tpe", "random"):
        last = table[(table["sampler"] == name) & (table["trial"] == 5)]["best_held_out_loss"]
        assert summary[name]["median_best_loss"] == pytest.approx(last.median())
    said = capsys.readouterr().out
    assert re.search(r"tpe (beats|ends level with|does not beat) random in the median of 2 studies", said)


STUDIES = Path(__file__).parents[2] / "studies"


@pytest.mark.parametrize("name", EXPERIMENTS)
def test_every_experiment_has_a_study_that_a_person_can_judge(name: str) -> None:
    """As many trials and seeds as configured, a default to compare with, and values that training takes."""
    folder = STUDIES / name
    tuning = untuned(f"experiment={name}").tuning
    summary = json.loads((folder / "summary.json").read_text())
    assert sum(summary["trials"].values()) == len(pd.read_csv(folder / "trials.csv")) == tuning.n_trials
    finalists = pd.read_csv(folder / "finalists.csv")
    assert set(finalists[finalists["trial"] == 0]["seed"]) == set(tuning.seeds)
    assert len(tuning.seeds) >= 5
    best = yaml.safe_load((folder / "best.yaml").read_text())
    assert apply_values(untuned(f"experiment={name}"), best["values"], "best.yaml")
    for figure in re.findall(r"\(figures/(\w+\.png)\)", (folder / "README.md").read_text()):
        assert (folder / "figures" / figure).stat().st_size > 1000


@pytest.mark.parametrize("name", ["hydrostatic_stiffness", "hydrostatic_damping"])
def test_a_study_from_the_papers_settings_is_a_thousand_times_more_accurate(name: str) -> None:
    """From the paper's optimiser and loss, the search finds by itself what makes every coefficient better."""
    summary = json.loads((STUDIES / name / "summary.json").read_text())
    assert summary["promoted_trial"] > 0
    assert min(summary["error_gain"].values()) >= 1e3
    assert "**What limits it.**" in (STUDIES / name / "README.md").read_text()


@pytest.mark.parametrize("name", ["hydrostatic_stiffness", "hydrostatic_damping"])
def test_tpe_beat_random_search(name: str) -> None:
    found = json.loads((STUDIES / name / "samplers.json").read_text())
    assert len(found["tpe"]["best_losses"]) == len(found["random"]["best_losses"]) == 5
    assert found["tpe"]["median_best_loss"] < found["random"]["median_best_loss"]
