"""Noise carried to the residual and its least squares: deviations against spreads, roots, and what is free."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from comparing import task
from comparison.test_runner import FEW_CASES
from conftest import Machine, MachineFactory
from data.test_dataset import without
from small_rotor import DIRECT, small_machine

from pipeline.comparison.cases import Case
from pipeline.data.dataset import VibrationDataset
from pipeline.data.sensors import NoiseModel
from pipeline.data.simulate import add_noise, simulate
from pipeline.problem.measurement import Measurement
from pipeline.problem.noise import (
    bearing_rows,
    least_squares_deviation,
    lower_root,
    residual_root,
    residual_sensitivity,
    whiten,
)
from pipeline.problem.residual import LinearResidual, bearing_equations, linear_residual, per_speed_least_squares
from pipeline.unknowns import UnknownSet
from problem.test_identifiability import ANISOTROPIC, BACKWARD, FEW, ISOTROPIC, UNBALANCES, everything, table_of


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


@pytest.fixture(scope="module")
def rotor_of(machine: MachineFactory) -> Machine:
    """The rotor with two discs; its bearings are chosen by the tests."""
    return machine("experiment=all_coefficients", *FEW)


def fits(machine: Machine, dataset: VibrationDataset, unknowns: UnknownSet, root: np.ndarray) -> LinearResidual:
    """The weighted equations of a data set."""
    return whiten(linear_residual(bearing_equations(machine.rotor, dataset), unknowns, machine.bearings), root)


@pytest.mark.slow
@pytest.mark.parametrize("sensors", ["every node", "bearings alone"])
def test_the_predicted_deviation_is_the_spread_of_noisy_fits(
    rotor_of: Machine, sensors: str, rng: np.random.Generator
) -> None:
    """200 weighted least-squares fits to data with noise: the same deviation within 10 %, for all sixteen."""
    dataset = simulate(rotor_of.rotor, rotor_of.bearings, (*rotor_of.excitations, BACKWARD))
    if sensors == "bearings alone":
        kept = [p for p, (node, _) in enumerate(dataset.channels) if node in (1, 5)]
        channels = tuple(dataset.channels[p] for p in kept)
        dataset = replace(dataset, channels=channels, displacement=dataset.displacement[:, kept])
    unknowns = everything((1, 5))
    deviation = NoiseModel(0.0, 1e-4).deviation(dataset.displacement)
    root = residual_root(rotor_of.rotor, dataset, rotor_of.bearings, deviation)
    predicted = least_squares_deviation(fits(rotor_of, dataset, unknowns, root))
    found = np.array(
        [
            per_speed_least_squares(fits(rotor_of, add_noise(dataset, deviation, rng), unknowns, root))
            for _ in range(200)
        ]
    )
    # The spread of 200 fits is itself known to 5 %; its median over the speeds to much less.
    np.testing.assert_allclose(np.median(found.std(axis=0, ddof=1) / predicted, axis=1), 1.0, atol=0.1)
    bias = (found.mean(axis=0) - rotor_of.bearings.values) / (predicted / np.sqrt(len(found)))
    assert np.abs(bias).max() < 5  # deviations of the mean, over 60 speeds and sixteen coefficients


def test_a_root_whitens_where_its_product_is_no_covariance(rng: np.random.Generator) -> None:
    """Its factor is Cholesky's, and rows of nearly one direction, 1e-9 apart, stay apart."""
    root = rng.standard_normal((5, 4, 6)) + 1j * rng.standard_normal((5, 4, 6))
    np.testing.assert_allclose(lower_root(root), np.linalg.cholesky(root @ root.conj().swapaxes(1, 2)), rtol=1e-9)
    root[:, 3] = root[:, 2] + 1e-9 * root[:, 3]
    white = np.linalg.solve(lower_root(root), root)
    np.testing.assert_allclose(white @ white.conj().swapaxes(1, 2), np.broadcast_to(np.eye(4), (5, 4, 4)), atol=1e-6)
    with pytest.raises(np.linalg.LinAlgError):
        np.linalg.cholesky(root @ root.conj().swapaxes(1, 2))


def test_what_is_free_has_an_infinite_deviation(rotor_of: Machine) -> None:
    table = table_of(rotor_of, ANISOTROPIC, ISOTROPIC)
    dataset = simulate(rotor_of.rotor, table, UNBALANCES)
    root = residual_root(rotor_of.rotor, dataset, table, NoiseModel(0.0, 1e-3).deviation(dataset.displacement))
    equations = fits(replace(rotor_of, bearings=table), dataset, everything(table.nodes), root)
    assert np.isinf(least_squares_deviation(equations)[0]).all()


def test_the_derivative_of_the_equations_by_the_readings() -> None:
    """What total least squares takes for the noise of A and y, against differences."""
    own = task(Case(0.01, "bearings", 12), *FEW_CASES)
    derivative = bearing_rows(own.rotor, own.dataset, own.unknowns)  # (S, R, 2 B, U, P)
    offset = residual_sensitivity(own.rotor, own.dataset, own.table(np.zeros((2, 12, 2))))
    step = np.zeros_like(own.dataset.displacement)
    step[:, 2, 1] = 1e-6 * (1 + 2j)
    before, after = (
        linear_residual(bearing_equations(own.rotor, dataset), own.unknowns, own.known)
        for dataset in (own.dataset, replace(own.dataset, displacement=own.dataset.displacement + step))
    )

    def complex_rows(values: np.ndarray) -> np.ndarray:
        """(B, S, 2, R, ..) of (B, S, 4 R, ..)."""
        half = values.reshape(2, 12, 2, 2, 3, *values.shape[3:])
        return half[:, :, 0] + 1j * half[:, :, 1]

    for b in range(2):
        for direction in range(2):
            rows = slice(2 * b + direction, 2 * b + direction + 1)
            wanted = derivative[:, 1, rows, :, 2][:, 0] * step[:, 2, 1, None]
            found = complex_rows(after.matrix - before.matrix)[b, :, direction, 1]
            np.testing.assert_allclose(found, wanted, rtol=1e-6, atol=1e-15)
            own_offset = complex_rows(after.offset - before.offset)[b, :, direction, 1]
            size = np.abs(offset[:, 1, 2 * b + direction, 2] * step[:, 2, 1])
            np.testing.assert_allclose(np.abs(own_offset), size, rtol=1e-4, atol=1e-9)
