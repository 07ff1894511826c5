"""Studies by the output error: judged by the readings held out over their noise, resumed, without the truth."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from pipeline.config.compose import compose_config
from pipeline.config.promotion import apply_values
from pipeline.errors import ConfigError
from pipeline.identification.fit import fit
from pipeline.identification.training import setup_of
from pipeline.stages.measurement import load_measurement
from pipeline.stages.tune import pose_study
from pipeline.tuning.finalists import choose, train_finalists
from pipeline.tuning.space import find_default, translate
from pipeline.tuning.study import StudyProblem
from pipeline.tuning.worker import run_study
from studies import silent, trials_of, with_config, with_tuning

pytestmark = pytest.mark.slow  # it trains

CHEAP = [
    *("experiment=noisy_stiffness", "tracking=none", "machine.speeds.step_rpm=245", "tuning=response"),
    *("training.holdout_every=5", "tuning.n_trials=4", "tuning.sampler=random", "tuning.finalists=1"),
    *("tuning.seeds=[0,1]", "tuning.space.width.high=12", "model.width=8", "loss.networks=4"),
]


@pytest.fixture(scope="module")
def posed(tmp_path_factory: pytest.TempPathFactory) -> StudyProblem:
    """The problem; its storage is each test's own."""
    config = compose_config([*CHEAP, f"output='{tmp_path_factory.mktemp('response_study')}'"])
    return pose_study(config, load_measurement(config))


def stored_in(problem: StudyProblem, path: Path) -> StudyProblem:
    """The problem with a storage of its own."""
    return with_tuning(problem, storage=f"sqlite:///{path}")


def values_of(problem: StudyProblem) -> list[float | None]:
    """What the trials of the storage came to."""
    return [trial.value for trial in trials_of(problem)]


@pytest.fixture(scope="module")
def whole(posed: StudyProblem, tmp_path_factory: pytest.TempPathFactory) -> StudyProblem:
    """A study that ran without a stop."""
    problem = stored_in(posed, tmp_path_factory.mktemp("whole") / "optuna.db")
    run_study(problem, silent)
    return problem


def test_trials_are_judged_by_the_readings_held_out(whole: StudyProblem) -> None:
    """Trial 0 is the default: its loss is what its fit says of the held-out speeds."""
    trials = trials_of(whole)
    assert [trial.state.name for trial in trials] == ["COMPLETE"] * 4
    found = fit(whole.measurement, setup_of(whole.config))
    square = found.quality.summary["fit"]["held_out_speeds"]["mean_square_over_noise"]
    assert trials[0].user_attrs["held_out_loss"] == pytest.approx(np.sqrt(square), rel=1e-9)
    assert len({trial.params["basis"] for trial in trials}) > 1
    assert not any(trial.intermediate_values for trial in trials)  # no learning curve to be pruned by


def test_a_study_that_was_stopped_goes_on_as_if_it_had_not(whole: StudyProblem, tmp_path: Path) -> None:
    problem = stored_in(whole, tmp_path / "optuna.db")
    run_study(with_tuning(problem, n_trials=2), silent)
    assert len(values_of(problem)) == 2
    run_study(problem, silent)
    assert values_of(problem) == pytest.approx(values_of(whole), rel=1e-9)


def test_finalists_are_trained_with_every_seed(whole: StudyProblem) -> None:
    study, _ = run_study(whole, silent)
    finalists = train_finalists(study, whole)
    assert [len(one.losses) for one in finalists] == [2, 2]
    assert choose(finalists, whole.config.tuning).median <= finalists[0].median
    speeds = whole.measurement.dataset.speeds
    assert all(np.isfinite(model.values(speeds)).all() for one in finalists for model in one.models)


@pytest.mark.parametrize("basis", ["random_features", "trained_network", "b_spline", "chebyshev"])
def test_a_trial_may_have_another_kind_of_model(posed: StudyProblem, basis: str) -> None:
    """It keeps what both kinds have, and lacks what its own does not know."""
    config = posed.config
    values = translate(config.tuning.space, find_default(config) | {"basis": basis})
    if basis in ("b_spline", "chebyshev"):
        values = {
            key: value for key, value in values.items() if key not in ("model.depth", "model.width", "model.activation")
        }
    made = apply_values(config, values, "trial")
    assert made.model.parametrisation == config.model.parametrisation
    assert made.model.kind == (basis if basis in ("b_spline", "chebyshev") else "network")


@pytest.mark.parametrize(("kind", "words"), [("b_spline", "count"), ("polynomial", "kind")])
def test_another_kind_must_have_all_its_values(posed: StudyProblem, kind: str, words: str) -> None:
    with pytest.raises(ConfigError, match=words):
        apply_values(posed.config, {"model.kind": kind}, "trial 1")


def test_a_study_must_have_one_noise(posed: StudyProblem) -> None:
    estimated = with_config(posed, loss=posed.config.loss.model_copy(update={"noise": "estimated"}))
    with pytest.raises(ConfigError, match="must judge its trials by one noise"):
        pose_study(estimated.config, posed.measurement)
