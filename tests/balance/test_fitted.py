"""The blend where conditions agree with the physical model and where not; conditions that contradict their labels."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from balancing import GRAM, PLANES, SIZE, KnownVibration, Truth, circular, know, truth
from contradictions import explain

from pipeline.balance.fitted import Blend, blend, find_contradictions
from pipeline.balance.influence import fit_influence
from pipeline.data.conditions import Conditions
from pipeline.errors import IdentifiabilityError


def blended(model: KnownVibration, machine: Truth, rng: np.random.Generator, count: int) -> tuple[Blend, Conditions]:
    """The blend of a model with conditions drawn from a machine, and these."""
    conditions = machine.draw(rng, count)
    return blend(model, conditions, know(machine).noise, np.ones(count)), conditions


@pytest.mark.slow
def test_a_model_that_holds_is_left_as_it_is(rng: np.random.Generator) -> None:
    """The evidence asks for (next to) no correction: on average less than half of what influence coefficients take
    from the noise."""
    machine = truth(rng)
    own = []
    for _ in range(6):
        found, conditions = blended(know(machine), machine, rng, 30)
        weights = conditions.unbalance
        free = fit_influence(conditions, law=False, robust=False).predict(weights)[0] - machine.mean(weights)
        own.append(np.linalg.norm(found.predict(weights)[0] - machine.mean(weights)) / np.linalg.norm(free))
    assert np.mean(own) < 0.5
    assert min(own) < 1e-12


@pytest.mark.slow
def test_many_conditions_that_contradict_the_model_take_its_place(rng: np.random.Generator) -> None:
    """Influence and baseline half wrong: the blend is the influence coefficients, with their covariance."""
    machine = truth(rng)
    wrong = replace(machine, baseline=0.5 * machine.baseline, influence=1.5 * machine.influence)
    found, conditions = blended(know(wrong), machine, rng, 200)
    free = fit_influence(conditions, law=False, robust=False)
    weights = conditions.unbalance[:5]
    assert min(found.sizes) > 1
    scale = abs(machine.mean(weights)).max()
    np.testing.assert_allclose(found.predict(weights)[0], free.predict(weights)[0], atol=5e-3 * scale)
    slope, baseline = found.influence_at(weights[0])
    np.testing.assert_allclose(slope, free.coefficients[1:].T, atol=5e-3 * abs(machine.influence).max())
    np.testing.assert_allclose(baseline, free.coefficients[0], atol=5e-3 * scale)
    variances = [np.trace(one.predict(weights)[1], axis1=1, axis2=2).real for one in (found, free)]
    assert variances[0] == pytest.approx(variances[1], rel=0.25)  # that of the data is estimated


def test_one_column_is_the_shrunk_mean(rng: np.random.Generator) -> None:
    """Closed form: of n conditions without weights, the baseline moves by n lambda / (1 + n lambda) of their mean, with
    the variance lambda / (1 + n lambda) of the noise; lambda is the one with the greatest marginal likelihood."""
    machine, n = truth(rng), 9
    off = replace(machine, baseline=machine.baseline + machine.root @ circular(rng, SIZE))
    vectors = machine.mean(np.zeros((n, 2))) + circular(rng, n, SIZE) @ machine.root.T
    model = know(off)
    found = blend(model, machine.gather(np.zeros((n, 2), dtype=complex), vectors), model.noise, np.ones(n))
    size, none = found.sizes[0], np.zeros((1, 2))
    mean = vectors.mean(0) - off.baseline
    np.testing.assert_allclose(found.predict(none)[0][0] - off.baseline, n * size / (1 + n * size) * mean, rtol=1e-9)
    covariance = machine.root @ machine.root.conj().T
    np.testing.assert_allclose(found.predict(none)[1][0], size / (1 + n * size) * covariance, rtol=1e-9)
    # The mean's distance is D (1 + n lambda) on average: to that of the grid which is nearest.
    square = n * (mean.conj() @ np.linalg.solve(covariance, mean)).real / SIZE
    assert size == pytest.approx(max(square - 1, 0) / n, rel=10 ** (8 / 24) - 1)


@pytest.mark.slow
def test_missing_weight_and_shifted_probe_are_told_apart_and_hide_nothing() -> None:
    """Two conditions of one kind and a gross one of another: none masks the others, no fourth is named."""
    rng = np.random.default_rng(0)
    machine = truth(rng)
    conditions = machine.draw(rng, 40)
    conditions.unbalance[[5, 6]] = np.array([[30, 30j], [-40, 20]]) * GRAM
    bare = conditions.unbalance[[5, 6]] * [1, 0]
    noise = conditions.vectors[[5, 6]] * 0 + rng.standard_normal((2, 1)) * 1e-9
    conditions.displacement[[5, 6]] = (machine.mean(bare) + noise).reshape(2, 2, 3)
    conditions.displacement[17, :, 1] += [3e-5, 4e-5]
    chances, model = find_contradictions(conditions, law=False)
    names = conditions.names
    named = {name: explain(conditions.of([names.index(name)]), model, chance) for name, chance in chances.items()}
    assert set(named) == {"C005", "C006", "C017"}
    assert named["C005"].missing == named["C006"].missing == (PLANES[1],)
    assert (named["C017"].shifted, named["C017"].explained, named["C017"].seen[:, 1].all()) == ((2, 90.0), True, True)
    assert abs(named["C005"].reading.value - bare[0]).max() < 3 * GRAM
    assert len(model.weights) == 37


def test_too_few_conditions_are_refused() -> None:
    rng = np.random.default_rng(1)
    with pytest.raises(IdentifiabilityError, match="judged by more than"):
        find_contradictions(truth(rng).draw(rng, 9))


@pytest.mark.slow
def test_false_alarms_are_as_rare_as_stated() -> None:
    """Sixty data sets without a contradiction, at 5 %: three alarms are expected, more than eight in 1 of 200."""
    rng = np.random.default_rng(2)
    assert sum(bool(find_contradictions(truth(rng).draw(rng, 40), 0.05, law=False)[0]) for _ in range(60)) <= 8
