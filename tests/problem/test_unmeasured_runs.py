"""A run that was not measured at a point says nothing there: as if it had been left out."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from small_rotor import DIRECT, small_machine

from pipeline.data.dataset import Excitation, subtract_baseline
from pipeline.data.sensors import NoiseModel, project
from pipeline.data.simulate import simulate
from pipeline.identification.fit import default_setup, fit
from pipeline.identification.identified import answer_of
from pipeline.problem.measurement import Measurement
from pipeline.problem.noise import least_squares_deviation, residual_root, whiten
from pipeline.problem.residual import per_speed_least_squares


def without(measurement: Measurement, points: np.ndarray, run: int) -> Measurement:
    """The readings of a ``run`` gone at the ``points``."""
    present = np.ones(measurement.dataset.displacement.shape[::2], dtype=bool)
    present[points, run] = False
    displacement = measurement.dataset.displacement * present[:, None]
    return replace(measurement, dataset=replace(measurement.dataset, displacement=displacement, present=present))


def test_least_squares_and_their_deviations_are_those_of_the_runs_that_were_measured() -> None:
    whole, bearings = small_machine(DIRECT)
    gone, rest = np.array([1, 4]), np.array([0, 2, 3, 5])

    def solve(of: Measurement, points: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        root = residual_root(of.rotor, of.dataset, bearings.at(points), of.deviation)
        return per_speed_least_squares(of.residual), least_squares_deviation(whiten(of.residual, root))

    found, spread = solve(without(whole, gone, 1), np.arange(len(bearings.speeds)))
    for points, runs in ((gone, np.array([0])), (rest, np.array([0, 1]))):
        values, deviation = solve(whole.select(points, runs), points)
        np.testing.assert_allclose(found[:, points], values, rtol=1e-9)
        np.testing.assert_allclose(spread[:, points], deviation, rtol=1e-6)


def test_nothing_is_subtracted_from_what_was_not_measured() -> None:
    whole = small_machine(DIRECT)[0]
    three = replace(whole.dataset, runs=("a", "b", "c"), displacement=whole.dataset.displacement[..., [0, 1, 1]])
    less = subtract_baseline(without(replace(whole, dataset=three), np.array([1, 4]), 1).dataset, "a")
    assert not less.complete
    assert less.present.tolist() == [[s not in (1, 4), True] for s in range(6)]
    assert not less.displacement[[1, 4], :, 0].any()
    assert not less.subtracted[[1, 4], :, 0].any()
    assert less.displacement[..., 1].all()


def test_records_at_speeds_of_their_own_give_bearings_and_residual_unbalance_back() -> None:
    """Each run at every third speed: no two have a speed in common."""
    made, bearings = small_machine(DIRECT, speeds=np.linspace(60.0, 260.0, 24), noise=0.0)
    acting = (("a", 5e-4, 0.3), ("b", 5e-4, 2.0), ("c", 0.0, 0.0))
    weights = [Excitation(run, "unbalance", 2, size, angle) for run, size, angle in acting]
    residual = tuple(Excitation(weight.run, "unbalance", 2, 2e-4, -1.0) for weight in weights)
    present = np.arange(24)[:, None] % 3 == np.arange(3)
    data = replace(made.dataset, runs=("a", "b", "c"), excitations=(*weights, *residual), present=present)
    read = project(simulate(made.rotor, bearings, data.excitations), data.channels).displacement * present[:, None]
    data = replace(data, displacement=read, excitations=tuple(weights))
    less = replace(made, dataset=data, unknowns=replace(made.unknowns, planes=(2,)), noise=NoiseModel(1e-13, 1e-8))
    answer = fit(less, default_setup(less.guess, constant=True))
    np.testing.assert_allclose(
        answer.table(bearings).values[..., [0, 3, 4, 7]], bearings.values[..., [0, 3, 4, 7]], rtol=1e-7
    )
    assert answer_of(less, answer.model, answer.uncertainty).unbalance == pytest.approx([2e-4 * np.exp(-1j)], rel=1e-7)
