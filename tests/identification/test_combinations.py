"""What is known best and least of constant coefficients: against deviations of each, and a run that was added."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from running import composed
from small_rotor import DIRECT, FITTED, small_machine

from pipeline.config.compose import compose_config
from pipeline.identification.combinations import _directions, _share, combine
from pipeline.identification.output_error_start import prepare_output_error
from pipeline.identification.training import setup_of
from pipeline.parameters.model import ModelParameter
from pipeline.problem.measurement import Measurement
from pipeline.problem.noise_levels import NoiseLevels
from pipeline.problem.slopes import deviate, invert
from pipeline.reporting.diagnosis import describe_combinations, summarize_combinations

TWO = np.array([100.0, 120.0])
SETUP = setup_of(composed(*FITTED))


def with_tolerances(measurement: Measurement) -> Measurement:
    """The places of both bearings, and of the density a tolerance that no data reach."""
    places = [ModelParameter("bearing_position", 0.05, f"node {node}", b) for b, node in enumerate((0, 5))]
    return replace(measurement, parameters=(*places, ModelParameter("density", 1e-9, "")))


def test_the_directions_hold_the_deviations_of_each_coefficient() -> None:
    """Of two speeds: squares add up to those of the coefficients; the best is none larger, the least none smaller."""
    measurement = with_tolerances(small_machine(DIRECT, speeds=TWO)[0])
    found, start = combine(measurement, SETUP), prepare_output_error(measurement, SETUP)
    sizes = np.abs(start.problem.unknowns(start.weights)[0][0, 0].numpy())
    each = start.problem.unknown_deviation(start.weights)[0, 0] / sizes
    covariance = invert(start.problem.normal(start.weights)[1][0, 0])
    spread, _ = _directions(_share(start.problem, start.weights), covariance)
    assert (spread**2).sum() == pytest.approx((each**2).sum(), rel=1e-6)
    assert found.strongest.deviation <= each.min() <= each.max() <= found.weakest.deviation
    assert sum(share**2 for share in found.weakest.shares.values()) == pytest.approx(1.0)
    assert found.parameters["density"][0] == pytest.approx(1.0, abs=1e-6)
    assert found.parameters["bearing_position"][0] < 0.8
    assert "They tell next to nothing of density." in describe_combinations(found)
    assert summarize_combinations(found)["weakest"]["deviation_percent"] == 100 * found.weakest.deviation
    assert f"known least is {found.weakest.words}" in describe_combinations(found)


def test_the_next_run_leaves_what_it_promises() -> None:
    """The same run at the speed that was named besides, without noise in the readings: the same information."""
    measurement, _ = small_machine(DIRECT, (0.3, 0.3), TWO, noise=0.0)
    found = combine(replace(measurement, dataset=measurement.dataset.of_runs(np.array([0]))), SETUP)
    assert found.next_run.deviation < 0.8 * found.weakest.deviation
    more, _ = small_machine(DIRECT, (0.3, 0.3), np.sort([*TWO, found.next_run.speed]), noise=0.0)
    start = prepare_output_error(replace(more, dataset=more.dataset.of_runs(np.array([0]))), SETUP)
    along = np.array(list(found.weakest.shares.values())) @ _share(start.problem, start.weights)
    left = deviate(along, invert(start.problem.normal(start.weights)[1][0, 0]))
    assert left == pytest.approx(found.next_run.deviation, rel=1e-3)
    assert f"at {found.next_run.speed * 30 / np.pi:.4g} rpm besides" in describe_combinations(found)


def test_a_run_is_tried_whatever_the_noise_of_the_others() -> None:
    """Noise in levels belongs to the runs that there are; the run that is tried has the stated noise."""
    one, _ = small_machine(DIRECT, (0.3, 0.3), TWO, noise=0.0)
    plain = combine(one, SETUP)
    data = one.dataset
    own = np.sqrt((one.deviation**2).mean(axis=2))  # (S, P)
    levels = NoiseLevels(np.zeros((len(TWO), *[own.shape[1]] * 2)), np.diag(own.ravel() ** 2).astype(complex), np.inf)
    found = combine(
        replace(one, drift=replace(levels, **dict.fromkeys(("counts", "weights"), np.ones(len(data.runs))))), SETUP
    )
    assert (found.next_run.run, found.next_run.speed) == (plain.next_run.run, plain.next_run.speed)


def test_functions_of_the_speed_have_no_such_directions() -> None:
    """A network has other combinations at each speed."""
    assert combine(small_machine(DIRECT)[0], setup_of(compose_config([*FITTED, "model=b_spline"]))) is None
