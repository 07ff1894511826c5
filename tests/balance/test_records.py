"""Records of the user's own: their unbalance with what was read, their vibration foretold, and the mistakes in them."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from balancing import GRAM, PLANES, SIZE, circular, know, truth
from conftest import examples
from hypothesis import given
from hypothesis import strategies as st

from pipeline.balance.records import average_records, find_reference, judge_together, predict_records, shift_to_day
from pipeline.balance.unbalance import Estimates, estimate_all
from pipeline.errors import DataError
from pipeline.ingest.records import Records

MACHINE = truth(np.random.default_rng(0))
RIG = know(MACHINE)


def _records(unbalance: np.ndarray, noise: np.ndarray | float = 0.0, repeats: int = 2) -> Records:
    """``repeats`` records of each condition at each speed; the noise is that of a condition."""
    vectors = (MACHINE.mean(unbalance) + noise).reshape(len(unbalance), 2, -1)
    rows = [(c, s, r) for c in range(len(unbalance)) for s in range(2) for r in range(repeats)]
    return Records(
        source="'given.csv'",
        conditions=tuple(f"C{c:03d}" for c, _, _ in rows),
        numbers=tuple(str(r + 1) for _, _, r in rows),
        speeds=np.array([RIG.speeds[s] * (1 + 0.003 * r) for _, s, r in rows]),
        probes=("a", "b", "c"),
        channels=RIG.channels,
        displacement=np.array([vectors[c, s] for c, s, _ in rows]),
        planes=PLANES,
        unbalance=unbalance[[c for c, _, _ in rows]],
    )


def _keep(records: Records, rows: np.ndarray) -> Records:
    """Some of the rows."""
    rest = {name: getattr(records, name)[rows] for name in ("speeds", "displacement", "unbalance")}
    names = {name: tuple(np.array(getattr(records, name))[rows].tolist()) for name in ("conditions", "numbers")}
    return replace(records, **rest, **names)


def _estimate(records: Records) -> Estimates:
    readings = average_records(records, RIG)
    return estimate_all(readings, [RIG] * len(readings.names))


def _weights(rng: np.random.Generator, n: int) -> np.ndarray:
    return 30 * GRAM * circular(rng, n, 2)


def test_records_without_noise_give_their_weights_whatever_is_missing() -> None:
    """One speed, one record, one probe less, and no known weights: what is there suffices."""
    unbalance = _weights(np.random.default_rng(1), 3)
    full = _records(unbalance)
    first = _keep(full, full.speeds < 1.05 * RIG.speeds[0])
    lost = replace(full, displacement=np.where([True, False, True], full.displacement, np.nan))
    unknown = replace(full, unbalance=np.full_like(full.unbalance, np.nan))
    for records in (full, first, _keep(full, np.array(full.numbers) == "2"), lost, unknown):
        found = _estimate(records)
        np.testing.assert_allclose(found.unbalance, unbalance, rtol=1e-8)
        assert (np.isnan(found.label_chance).all(), found.contradicted.any()) == (records is unknown, False)
    assert _estimate(lost).radius.min() > _estimate(full).radius.max() * 0.9


@given(st.floats(0, 2 * np.pi))
@examples(10)
def test_turned_weights_turn_the_answer(angle: float) -> None:
    unbalance = _weights(np.random.default_rng(2), 2)
    turn = np.exp(1j * angle)
    one, two = (_estimate(_records(u)).unbalance for u in (unbalance, unbalance * turn))
    np.testing.assert_allclose(two, one * turn, rtol=1e-8)


@pytest.mark.slow
def test_bands_and_chances_hold_what_they_say() -> None:
    rng = np.random.default_rng(3)
    unbalance = _weights(rng, 500)
    found = _estimate(_records(unbalance, circular(rng, 500, SIZE) @ MACHINE.root.T, 1))
    assert 0.93 < np.mean(np.abs(found.unbalance - unbalance) <= found.radius) < 0.97
    assert 0.06 < np.mean(found.chance < 0.1) < 0.14
    assert 0.06 < np.mean(found.label_chance < 0.1) < 0.14
    assert found.inconsistent.sum() < 15


def test_a_moved_probe_and_a_wrong_label_are_told_apart() -> None:
    records = _records(_weights(np.random.default_rng(4), 3))
    moved = records.displacement.copy()
    moved[:4, 1] += 5e-6  # of the first condition
    label = records.unbalance.copy()
    label[4:8] *= -1  # of the second
    found = _estimate(replace(records, displacement=moved, unbalance=label))
    assert (found.inconsistent.tolist(), found.contradicted[1:].tolist()) == ([True, False, False], [True, False])


def test_the_vibration_of_known_weights_and_its_bands() -> None:
    rng = np.random.default_rng(5)
    unbalance = _weights(rng, 400)
    records = _records(unbalance, circular(rng, 400, SIZE) @ MACHINE.root.T, 1)
    predicted = predict_records(records, RIG)
    np.testing.assert_allclose(predicted.mean, MACHINE.mean(unbalance).reshape(800, 3), rtol=1e-12)
    assert predicted.measured.all()
    assert 0.93 < predicted.within.mean() < 0.97
    assert 0.93 < np.mean(np.abs(predicted.off.real) <= predicted.half_width) < 0.97
    assert np.mean(np.abs(predicted.off) ** 2 / (2 * predicted.deviation**2)) == pytest.approx(1, abs=0.1)
    blind = predict_records(replace(records, displacement=np.full_like(records.displacement, np.nan)), RIG)
    np.testing.assert_array_equal(blind.mean, predicted.mean)
    assert (blind.measured.any(), blind.within.any()) == (False, False)


@pytest.mark.slow
def test_another_day_is_seen_and_its_reference_takes_it_away() -> None:
    """A shift that all conditions share, of three deviations of each: few circles hold it, until one condition with
    known weights shows it. Then the same bands hold what they say, for vibration and weights."""
    rng, days = np.random.default_rng(8), 200
    without, within, found = [], [], []
    for _ in range(days):
        unbalance = _weights(rng, 5)
        records = _records(
            unbalance, 3 * circular(rng, 1, SIZE) @ MACHINE.root.T + circular(rng, 5, SIZE) @ MACHINE.root.T, 1
        )
        day = shift_to_day(find_reference(average_records(records, RIG), "C000"), RIG)
        without.append(judge_together(average_records(records, RIG), RIG, 0.01))
        within.append(predict_records(records, day).within[2:])
        estimates = estimate_all(average_records(records, day), [day] * 5)
        found.append((np.abs(estimates.unbalance - unbalance) <= estimates.radius)[1:])
    assert np.mean(np.array(without) < 0.01) > 0.9
    assert 0.93 < np.mean(within) < 0.98
    assert 0.93 < np.mean(found) < 0.98


def test_records_of_the_same_day_are_seldom_called_those_of_another() -> None:
    rng = np.random.default_rng(9)
    tables = [_records(_weights(rng, 4), circular(rng, 4, SIZE) @ MACHINE.root.T, 1) for _ in range(400)]
    chances = np.array([judge_together(average_records(records, RIG), RIG, 0.01) for records in tables])
    assert 0.06 < np.mean(chances < 0.1) < 0.14
    unknown = replace(tables[0], unbalance=np.full_like(tables[0].unbalance, np.nan))
    turned = replace(tables[0], unbalance=tables[0].unbalance * np.where(np.arange(8) < 2, -1, 1)[:, None])
    for untold in (unknown, turned, _records(_weights(rng, 1), 1e-4)):  # no weights, one wrong label, one condition
        assert np.isnan(judge_together(average_records(untold, RIG), RIG, 0.01))


def test_a_reference_must_be_there_and_whole() -> None:
    records = _records(_weights(np.random.default_rng(10), 2))
    with pytest.raises(DataError, match=r"must be a condition of the records, but got 'C00': did you mean 'C00"):
        find_reference(average_records(records, RIG), "C00")
    lost = replace(records, displacement=np.where([True, False, True], records.displacement, np.nan))
    for lacking in (lost, replace(records, unbalance=np.full_like(records.unbalance, np.nan))):
        with pytest.raises(DataError, match="must have its weights, and a vector of each probe"):
            find_reference(average_records(lacking, RIG), "C001")


def test_the_experiments_own_conditions_are_readings() -> None:
    conditions = MACHINE.draw(np.random.default_rng(6), 4)
    found = estimate_all(conditions, [RIG] * 4)
    assert found.readings.counts.min() == 3
    assert np.abs(found.unbalance - conditions.unbalance).max() < 30 * GRAM


def test_mistakes_are_named() -> None:
    records = _records(_weights(np.random.default_rng(7), 2))
    nothing = np.full_like(records.displacement, np.nan)
    with pytest.raises(DataError, match="vibration of at least one probe"):
        average_records(replace(records, displacement=nothing), RIG)
    one = nothing.copy()
    one[:4] = records.displacement[:4]
    with pytest.raises(DataError, match="'C001' must have at least one measured vector"):
        _estimate(replace(records, displacement=one))
    with pytest.raises(DataError, match=r"within 1 % of those .* but got 1050\.4\d* rpm"):
        average_records(replace(records, speeds=np.where(np.arange(8) == 7, 110.0, records.speeds)), RIG)
    several = records.unbalance.copy()
    several[0] *= 2
    with pytest.raises(DataError, match="'C000' has several"):
        average_records(replace(records, unbalance=several), RIG)
    several[3] = np.nan
    with pytest.raises(DataError, match=r"weights of every plane .* row 4 has not \(1 rows"):
        predict_records(replace(records, unbalance=several), RIG)
