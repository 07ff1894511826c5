"""Deviations beyond noise: where functions of the speed can't follow the coefficients, and tolerances not fitted."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from running import composed
from small_rotor import DIRECT, FITTED, fitted_beside_truth, small_machine

from pipeline.identification.fit import fit
from pipeline.identification.model_error import count_local, evaluate_local
from pipeline.identification.output_error_fit import OutputErrorFit
from pipeline.identification.training import setup_of
from pipeline.parameters.model import USUAL, usual_tolerances
from pipeline.problem.measurement import Measurement

NOISE = ["stated_noise.additive=0.05 um", "stated_noise.multiplicative=0.005"]
ALONE = "identify.unknowns=[kxx,kyy,cxx,cyy]"


def fitted(name: str, *overrides: str) -> tuple[OutputErrorFit, np.ndarray]:
    """The fit of a machine of studies/coverage, its cross terms known, and the true unknowns (S, A)."""
    config = composed("stage=train", f"machine.file=studies/coverage/{name}.yaml", *NOISE, ALONE, *overrides)
    return fitted_beside_truth(config, 3)


def held(fit: OutputErrorFit, truth: np.ndarray, matrix: np.ndarray, n_local: int) -> float:
    """Share of coefficients and speeds inside their 95 % intervals."""
    problem = fit.problem
    values, slope = (part[0].numpy() for part in problem.unknowns(fit.weights)[:2])
    local = evaluate_local(problem.basis.model, problem.measurement.dataset.points, n_local)
    count = problem.features.shape[-1] + n_local
    inside = []
    for a, (m, _) in enumerate(problem.active):
        functions = np.concatenate([problem.features[m].numpy(), local], axis=1)
        own = slice(a * count, (a + 1) * count)
        spread = np.sqrt(np.einsum("sk,kl,sl->s", functions, matrix[own, own], functions))
        inside.append(np.abs(values[:, a] - truth[:, a]) <= 1.96 * spread * np.abs(slope[:, a, a]))
    return float(np.mean(inside))


@pytest.mark.slow
def test_intervals_hold_coefficients_with_kinks() -> None:
    """The inverse of the information is too narrow by far; the mean square error is not."""
    fit, truth = fitted("overhung_kinked")
    narrow, wide = held(fit, truth, fit.covariance(), 0), held(fit, truth, fit.error().matrix, fit.error().n_local)
    print(f"inside: {narrow:.3f} by the information, {wide:.3f} by the mean square error")
    assert narrow < 0.8
    assert 0.88 < wide <= 1.0


@pytest.mark.slow
def test_where_the_functions_suffice_the_deviations_hardly_change() -> None:
    """Tables over the Sommerfeld number are nearly power laws."""
    fit, _ = fitted("rigid")
    assert fit.problem.places.n_rest == 0
    n_features, n_local = fit.problem.features.shape[-1], fit.error().n_local
    own = np.arange(len(fit.error().matrix)) % (n_features + n_local) < n_features
    before, after = np.diag(fit.covariance()), np.diag(fit.error().matrix[np.ix_(own, own)])
    kept = fit.problem.fitted().numpy()
    ratio = np.sqrt(after[kept] / before[kept])
    assert ratio.min() >= 1.0
    assert np.median(ratio) < 1.02
    assert np.allclose(after[~kept], before[~kept])


def test_constants_and_few_speeds_have_no_local_functions() -> None:
    """A constant is one by assumption; few readings can't tell a local function from noise."""
    from pipeline.identification.model import CoefficientModel

    model = CoefficientModel(
        unknowns=("kxx",),
        inputs=("speed",),
        parametrisation="log",
        scale=((1e6,),),
        hidden=(4,),
        ranges=((10.0, 500.0),),
    )
    assert {count: count_local(model, count) for count in (91, 30, 7)} == {91: 30, 30: 15, 7: 0}
    assert count_local(replace(model, hidden=None), 91) == 0
    functions = evaluate_local(model, {"speed": np.array([10.0, 200.0, 500.0])}, 10)
    np.testing.assert_allclose(functions.sum(axis=1), 1.0)  # they add up to a constant
    assert evaluate_local(model, {"speed": np.array([10.0])}, 0).shape == (1, 0)


SETUP = setup_of(composed(*FITTED))


SPEEDS = np.linspace(60.0, 300.0, 9)


def tolerant(stated: tuple[str, ...] = ()) -> Measurement:
    """A machine whose shaft, weights and probes are known as well as they usually are."""
    measurement, _ = small_machine(DIRECT, (0.3, 0.3), SPEEDS)
    given = usual_tolerances(stated, measurement.rotor, measurement.dataset, measurement.known, measurement.unknowns)
    return replace(measurement, tolerances=given)


def deviation_of(measurement: Measurement) -> np.ndarray:
    return np.asarray(fit(measurement, SETUP).deviation(SPEEDS))[:, 0, [0, 3, 4, 7]]


@pytest.mark.slow
def test_a_coefficient_is_known_as_well_as_if_they_were_fitted() -> None:
    """The same information is inverted; what the readings tell of a tolerance is told in both ways."""
    measurement = tolerant()
    alone = deviation_of(replace(measurement, tolerances=()))
    unfitted = deviation_of(measurement)
    together = deviation_of(replace(measurement, parameters=measurement.tolerances, tolerances=()))
    assert (unfitted > 1.5 * alone).all()
    np.testing.assert_allclose(unfitted, together, rtol=0.3)


def test_the_answer_stays_as_it_is() -> None:
    measurement = tolerant()
    exact, wide = (fit(one, SETUP).model.values(SPEEDS) for one in (replace(measurement, tolerances=()), measurement))
    np.testing.assert_array_equal(exact, wide)


def test_each_kind_is_a_part_of_the_whole() -> None:
    """One kind alone is that of a machine where no other is uncertain."""
    measurement = tolerant()
    whole = fit(measurement, SETUP)
    assert whole.uncertainty.unfitted.names == list(USUAL)
    assert len(whole.uncertainty.unfitted.select("probe_gain").kinds) == len(measurement.dataset.channels)
    assert (
        np.linalg.eigvalsh(whole.uncertainty.without_tolerances).min()
        > -1e-9 * np.abs(whole.uncertainty.without_tolerances).max()
    )


def test_what_is_stated_is_not_counted_twice() -> None:
    assert {one.kind for one in tolerant(("density", "probe_gain")).tolerances} == USUAL.keys() - {
        "density",
        "probe_gain",
    }
    assert tolerant(tuple(USUAL)).tolerances == ()


@pytest.mark.parametrize("share", [0.5, 2.0])
def test_wider_tolerances_move_in_proportion_where_the_readings_tell_nothing(share: float) -> None:
    """Density hardly shows: its part of the deviation grows as it does."""
    measurement = tolerant(tuple(name for name in USUAL if name != "density"))
    tiny = replace(measurement.tolerances[0], deviation=1e-5)
    parts = []
    for one in (tiny, replace(tiny, deviation=1e-5 * share)):
        found = fit(replace(measurement, tolerances=(one,)), SETUP)
        covariance = found.uncertainty.unfitted.covariance()
        parts.append(found.uncertainty.deviation(SPEEDS, covariance=covariance)[:, 0, [0, 3]])
    np.testing.assert_allclose(parts[1], share * parts[0], rtol=1e-3)
