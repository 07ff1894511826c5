"""Every experiment with every option, and every combination of model, optimiser and robustness."""

from __future__ import annotations

from itertools import product

import pytest
import test_every_config as by_day
import test_results as results
from conftest import Made, Run
from running import DEFAULT, EXPERIMENTS, at_night, few

from pipeline.config.loader import list_options

pytestmark = pytest.mark.slow
OTHERS = [name for name in EXPERIMENTS if name != DEFAULT]


@pytest.fixture
def kept(experiment: str, made: Made) -> results.Kept:
    """Every experiment with few steps, in place of what the graph made."""
    return made(experiment), few(experiment)


test_again = at_night(by_day.test_every_stage_of_an_experiment_again_gives_the_same_bits, "experiment", OTHERS)
test_figures_show_something = at_night(
    results.test_figures_show_something, "experiment", [name for name in OTHERS if name != "realistic"]
)
test_files, test_tables, test_metrics = (
    at_night(test, "experiment", [name for name in results.USUAL if name != DEFAULT])
    for test in (
        results.test_files_of_an_experiment,
        results.test_tables_have_the_columns_that_others_rely_on,
        results.test_metrics_have_the_shape_that_others_rely_on,
    )
)
test_every_option_of_every_group = at_night(
    by_day.test_every_option_of_every_group,
    ("group", "option", "experiment"),
    [
        (group, option, name)
        for group, option, home in by_day.CHOICES
        for name in EXPERIMENTS
        # One of the noisy ones, which differ in their unknowns, is tried with every option.
        if name not in (home, "noisy_direct", "noisy_all", "noisy_stiffness_residual", "impulses")
    ],
)
test_all_stages_of_all_combinations = at_night(
    by_day.test_all_stages_of_all_combinations,
    ("model", "optimizer", "robustness"),
    [
        chosen
        for chosen in product(("constant", "network"), list_options("optimizer"), ("initial_guesses", "seeds"))
        if chosen not in by_day.BY_DAY  # refits is of another loss
    ],
)


EXACT = "least_squares,smoothed,tikhonov,total_least_squares,kalman,spline,response"
COMPARED = {
    "ball_bearing": f"comparison.methods=[{EXACT},kriging,critical_speeds]",
    "hydrostatic_damping": f"comparison.methods=[{EXACT}]",
    "hydrostatic_stiffness": f"comparison.methods=[{EXACT}]",
    "impulses": "comparison.methods=[multi_frequency,smoothed,total_least_squares,response]",
}
"""The methods that thresholds are set for."""
FEW_CASES = [
    *("comparison.workers=1", "comparison.data_sets=1", "comparison.speeds=[11]", "comparison.noise=[0,0.001]"),
    "comparison.response.optimizer.levenberg_marquardt.steps=4",
]


@pytest.mark.slow
def test_check_of_freshly_made_experiments(made: Made, run: Run, capsys: pytest.CaptureFixture[str]) -> None:
    fresh = [name for name in EXPERIMENTS if name != "rk4"]  # a study makes its metrics, from records
    for experiment in fresh:
        made(experiment)
        if experiment in COMPARED:
            run("compare", few(experiment, *FEW_CASES, COMPARED[experiment]), made(experiment))
    capsys.readouterr()
    with pytest.raises(SystemExit) as stop:  # few steps pass no accuracy bar
        run("check", few("ball_bearing", f"check.experiments=[{','.join(fresh)}]"), made("ball_bearing"))
    assert stop.value.code == 1
    said = capsys.readouterr()
    assert "missing" not in said.out + said.err
    assert all(name in said.out for name in fresh)
