"""Influence coefficients against those that the data were drawn with, and the coverage of what is predicted."""

from __future__ import annotations

import numpy as np
import pytest
from balancing import GRAM, SIZE, TAILS, truth

from pipeline.balance.influence import fit_influence
from pipeline.errors import IdentifiabilityError

LAW = (0.15 + 0.03j) / (60 * GRAM)


def test_data_without_noise_give_the_coefficients_back() -> None:
    """Three conditions determine baseline and influence; more add nothing."""
    machine = truth(np.random.default_rng(0))
    unbalance = np.array([[0, 0], [48, 0], [0, 48j]]) * GRAM
    model = fit_influence(machine.gather(unbalance, machine.mean(unbalance)))
    assert model.coefficients[0] == pytest.approx(machine.baseline, rel=1e-9)
    assert np.allclose(model.coefficients[1:].T, machine.influence, rtol=1e-9)
    assert (model.noise.freedom, np.isfinite(model.noise.half_width(np.ones(1))).any()) == (0, False)


def test_the_law_of_weights_is_taken_where_the_data_have_it() -> None:
    rng = np.random.default_rng(1)
    curved = fit_influence(truth(rng, LAW).draw(rng, 60))
    assert abs(curved.law - LAW) < 3 * np.sqrt(curved.law_variance)
    assert curved.law_chance < 1e-6
    plain = fit_influence(truth(rng).draw(rng, 60))
    assert plain.law == 0
    assert plain.law_chance > 0.01


def test_the_derivative_is_that_of_the_prediction() -> None:
    """Along and across a weight, on average: the part that turns with it."""
    rng = np.random.default_rng(2)
    model = fit_influence(truth(rng, LAW).draw(rng, 40), law=True)
    at, step = np.array([30, 12j]) * GRAM, 1e-4 * GRAM
    slope, baseline = model.influence_at(at)
    assert model.predict(np.zeros((1, 2)))[0][0] == pytest.approx(baseline)
    for n in range(2):
        turned = [
            (model.predict((at + d * np.eye(2)[n])[None])[0] - model.predict(at[None])[0])[0] / d
            for d in step * np.exp(0.5j * np.pi * np.arange(4))
        ]
        assert np.mean(turned, axis=0) == pytest.approx(slope[:, n], rel=1e-3)


def test_weights_that_never_differ_are_refused() -> None:
    machine = truth(np.random.default_rng(3))
    unbalance = np.array([[1, 1], [2, 2], [0, 0]]) * GRAM
    with pytest.raises(IdentifiabilityError, match="trial weight in each plane"):
        fit_influence(machine.gather(unbalance, machine.mean(unbalance)))


@pytest.mark.slow
@pytest.mark.parametrize("tail", TAILS)
def test_intervals_hold_what_they_say(tail: float | None) -> None:
    """Of conditions that no fit has seen, 95 % of the parts lie inside, and the law's own evidence errs at its rate."""
    rng = np.random.default_rng(5)
    held, taken = [], []
    for _ in range(40):
        conditions = truth(rng).draw(rng, 70, tail)
        model = fit_influence(conditions.of(range(50)))
        taken.append(model.law != 0)
        rest = conditions.of(range(50, 70))
        mean, own = model.predict(rest.unbalance)
        width = model.noise.half_width(np.einsum("cii->ci", own + model.noise.covariance(rest.counts)).real)
        error = rest.vectors - mean
        held += [abs(error.real) <= width, abs(error.imag) <= width]
    assert 0.93 < np.mean(held) < 0.97
    assert np.mean(taken) <= 0.1
    assert np.shape(held)[-1] == SIZE
