"""Conditions that contradict their labels are named with what explains them; others are not, at the stated rate."""

from __future__ import annotations

import numpy as np
import pytest
from balancing import GRAM, PLANES, truth
from contradictions import explain

from pipeline.balance.fitted import find_contradictions
from pipeline.errors import IdentifiabilityError


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
