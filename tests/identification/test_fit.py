"""Fits of bearing laws: the numbers that made the data are found from far guesses, and a wrong law is seen."""

from __future__ import annotations

from dataclasses import replace
from functools import cache
from pathlib import Path

import numpy as np
import pytest
import torch
from oil_rig import LUND, NOISE, RUNS, SHAKEN, SHORT, TRUE, bearings_at, laws_of, measure, setup
from training import assert_close, dense_jacobian

from pipeline.errors import ConfigError, DataError
from pipeline.identification.fit import fit
from pipeline.identification.identified import Fit
from pipeline.identification.output_error_start import prepare_output_error
from pipeline.identification.problem import OutputError
from pipeline.identification.storage import load_model, save_model
from pipeline.problem.measurement import Measurement

pytestmark = pytest.mark.slow
RPM = np.linspace(600.0, 4000.0, 8)
WARM = (45.0, 55.0, 65.0)
FAR = (1.0, 1.0, 3.0, 0.4)
"""Guesses over the truth: viscosity, slope, clearances."""


@cache
def fitted(kind: str, wrong: bool = False) -> Fit:
    return fit(measure(bearings_at(RPM, WARM), laws_of(SHORT if wrong else LUND, FAR)), setup(kind))


def percent(found: Fit, celsius: float) -> np.ndarray:
    """(B, S, 8) errors of the coefficients at a temperature."""
    truth = bearings_at(RPM, (celsius,))
    return np.asarray(100 * np.abs(found.table(truth).values / truth.values - 1))


def numbers(found: Fit) -> dict[str, tuple[float, float]]:
    """Values and deviations by name."""
    told = found.quality.summary["physical_numbers"]
    return {name: (one["value"], one["deviation"]) for name, one in told.items()}


def probability(found: Fit) -> float:
    return float(found.quality.summary["fit"]["mismatch"]["probability"])


def test_the_numbers_are_those_that_made_the_data() -> None:
    for name, (value, deviation) in numbers(fitted("law")).items():
        assert abs(value - TRUE[name]) < 4 * deviation, name
        assert deviation < 0.01 * value, name
    assert all(one["determined"] for one in fitted("law").quality.summary["physical_numbers"].values())
    assert probability(fitted("law")) > 0.01


def test_the_fit_is_as_good_as_any() -> None:
    """A Gauss-Newton step from the truth at the exact weights is the estimate of least variance."""
    truth = bearings_at(RPM, WARM)
    measurement = measure(truth, laws_of(LUND, (1.0, 1.0, 1.0, 1.0)))
    problem = prepare_output_error(measurement, setup("law")).problem
    exact = np.sqrt(2.0) / NOISE.deviation(measurement.response.predict(truth))
    problem = replace(problem, readings=replace(problem.readings, precision=(torch.as_tensor(exact)[None],)))
    gradient, matrix = problem.normal(torch.zeros(1, 1, problem.places.size, dtype=torch.float64))
    best = -torch.linalg.solve(matrix[0, 0], gradient[0, 0])[problem.places.numbers]
    for (name, (value, deviation)), share in zip(numbers(fitted("law")).items(), best.tolist(), strict=True):
        assert abs(np.log(value / TRUE[name]) - share) < 0.1 * deviation / value, name


@pytest.mark.parametrize("celsius", [40.0, 70.0])
def test_coefficients_hold_at_temperatures_never_measured(celsius: float) -> None:
    assert np.median(percent(fitted("law"), celsius)) < 1.0
    assert np.median(percent(fitted("hybrid"), celsius)) < 1.2 * np.median(percent(fitted("law"), celsius)) + 0.1


def test_a_network_follows_the_temperature_without_a_law() -> None:
    """Within three percent, the median over all sixteen, five kelvin beyond the data."""
    rpm = np.linspace(600.0, 4000.0, 40)
    found = fit(measure(bearings_at(rpm, WARM), None, runs=RUNS + SHAKEN), setup("network"))
    for celsius, bar in ((55.0, 1.5), (40.0, 3.0), (70.0, 3.0)):
        truth = bearings_at(rpm, (celsius,))
        assert np.median(100 * np.abs(found.table(truth).values / truth.values - 1)) < bar, celsius


def test_guesses_far_apart_end_at_the_same_numbers() -> None:
    other = fit(measure(bearings_at(RPM, WARM), laws_of(LUND, (0.2, 0.7, 0.3, 3.0))), setup("law"))
    for name, (value, deviation) in numbers(fitted("law")).items():
        assert abs(value - numbers(other)[name][0]) < 0.05 * deviation, name


def test_a_wrong_law_is_rejected_and_a_correction_explains_the_readings() -> None:
    assert probability(fitted("law", wrong=True)) < 1e-6
    assert probability(fitted("hybrid", wrong=True)) > 1e-3
    corrections = fitted("hybrid", wrong=True).quality.summary["correction"]
    least = fitted("hybrid").quality.summary["correction"]
    assert max(of["percent"] for one in corrections.values() for of in one.values()) > 10
    assert max(of["percent"] for one in least.values() for of in one.values()) < 5


def test_a_correction_is_none_far_from_the_data_and_uncertain() -> None:
    found = fitted("hybrid", wrong=True).model
    points = {"speed": np.array([250.0, 250.0]), "oil_temperature": np.array([328.15, 500.0])}
    outputs = found.model.raw(found.parameters, found.model.scaled_inputs(points)).detach().abs()
    assert outputs[:, 0].max() > 0.1
    assert outputs[:, 1].max() < 1e-6


def test_derivatives_are_those_of_the_rows() -> None:
    problem, weights = _problem(measure(bearings_at(RPM[:3], WARM[:2]), laws_of(LUND, FAR)))
    slope, step = dense_jacobian(problem, weights), 1e-6
    gradient, matrix = problem.normal(weights)
    assert_close(slope.T @ problem.rows(weights)[0, 0], gradient[0, 0], rtol=1e-8, atol=1e-6)
    assert_close(slope.T @ slope, matrix[0, 0], rtol=1e-8, atol=1e-4)
    for z in range(problem.places.n_coefficients - 2, problem.places.size):
        moved = torch.zeros_like(weights)
        moved[0, 0, z] = step
        along = (problem.rows(weights + moved) - problem.rows(weights - moved))[0, 0] / (2 * step)
        assert_close(slope[:, z], along, rtol=1e-5, atol=1e-4)


def _problem(measurement: Measurement) -> tuple[OutputError, torch.Tensor]:
    start = prepare_output_error(measurement, setup("hybrid"))
    drawn = torch.randn(start.weights.shape, generator=torch.Generator().manual_seed(1), dtype=torch.float64)
    return start.problem, start.weights + 0.01 * drawn


def test_a_run_that_was_not_measured_at_a_point_says_nothing_there() -> None:
    measurement = measure(bearings_at(RPM[:4], WARM), laws_of(LUND, FAR))
    present = np.random.default_rng(3).random((12, 3)) > 0.3
    spoiled = np.where(present[:, None], measurement.dataset.displacement, 0.0)
    less = replace(measurement, dataset=replace(measurement.dataset, displacement=spoiled, present=present))
    whole, part = (prepare_output_error(one, setup("law")).problem for one in (measurement, less))
    weights = torch.zeros(1, 1, whole.places.size, dtype=torch.float64)
    every, rest = whole.deviations(weights)[0][0], part.deviations(weights)[0][0]
    assert part.readings.size == 2 * 4 * present.sum()
    shown = torch.as_tensor(present)[:, None].expand(every.shape)
    assert (rest[~shown] == 0).all()
    assert (rest[shown].abs() > 0).all()
    for name, (value, deviation) in numbers(fit(less, setup("law"))).items():
        assert abs(value - TRUE[name]) < 4 * deviation, name


def test_a_stored_fit_is_the_same(tmp_path: Path) -> None:
    found = fitted("hybrid", wrong=True).model
    save_model(tmp_path, found)
    again, points = load_model(tmp_path), {"oil_temperature": np.array([310.0, 345.0])}
    np.testing.assert_array_equal(
        again.values(np.array([90.0, 300.0]), points), found.values(np.array([90.0, 300.0]), points)
    )


def test_a_model_asks_for_its_conditions() -> None:
    with pytest.raises(DataError, match="oil_temperature"):
        fitted("law").model.values(np.array([100.0]))


@pytest.mark.parametrize(
    ("loss", "laws", "words"),
    [
        ({"hidden": "trained"}, (LUND, FAR), "loss=response"),
        ({"kind": "preconditioned"}, (LUND, FAR), r"loss\.kind=preconditioned: choose loss=response"),
        ({}, (), r"must have machine\.laws"),
    ],
)
def test_laws_go_with_the_output_error_alone(
    loss: dict[str, str], laws: tuple[dict[str, object], ...], words: str
) -> None:
    """And a residual knows none."""
    chosen = setup("law")
    with pytest.raises(ConfigError, match=words):
        fit(
            measure(bearings_at(RPM[:3], WARM), laws_of(*laws) if laws else None),
            replace(chosen, loss=chosen.loss.model_copy(update=loss)),
        )
