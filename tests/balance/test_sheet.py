"""The balance sheet: what it removes and foretells, how often bands hold, and what ISO 21940-11 lets remain."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from balancing import GRAM, SIZE, KnownVibration, circular, know, truth
from conftest import examples
from hypothesis import given
from hypothesis import strategies as st

from benchmarks.machines import Machine
from pipeline.balance.correction import Holes
from pipeline.balance.sheet import State, find_centre, predict_one, propose_weights, share_tolerance
from pipeline.errors import ConfigError


def _holes(masses: tuple[float, ...] | None = None, most: int = 2) -> list[Holes]:
    return [Holes(0.2 + 2 * np.pi * np.arange(16) / 16, 0.03, masses, most)] * 2


def _unbalanced(rng: np.random.Generator) -> tuple[KnownVibration, np.ndarray]:
    """A rig whose baseline is made by an unbalance alone, and that unbalance."""
    own = 40 * GRAM * circular(rng, 2)
    machine = truth(rng)
    return know(replace(machine, baseline=machine.influence @ own)), own


def _as_it_is(rig: KnownVibration) -> State:
    nothing = np.zeros(2, dtype=complex)
    return State(shown=predict_one(rig, nothing), remove=predict_one(rig, nothing), weights=nothing)


def test_any_mass_takes_the_whole_unbalance_away() -> None:
    rig, own = _unbalanced(np.random.default_rng(0))
    for minimise in ("unbalance", "vibration"):
        sheet = propose_weights(rig, _as_it_is(rig), _holes(), minimise)
        np.testing.assert_allclose(sheet.unbalance, own, rtol=1e-9)
        np.testing.assert_allclose(sheet.correction, -own, rtol=1e-9)
        np.testing.assert_allclose(np.abs(sheet.remaining), 0, atol=1e-9 * GRAM)
        np.testing.assert_allclose(sheet.after, 0, atol=1e-15)
        np.testing.assert_allclose(predict_one(rig, sheet.correction), sheet.after, atol=1e-15)


def test_a_condition_is_brought_back_to_the_machine_as_it_is_or_to_nothing() -> None:
    rng = np.random.default_rng(1)
    rig, own = _unbalanced(rng)
    known = 30 * GRAM * circular(rng, 2)
    shown = predict_one(rig, known)
    baseline = predict_one(rig, np.zeros(2, dtype=complex))
    shown[2] = np.nan  # a probe that was not read
    back = propose_weights(rig, State(shown=shown, remove=shown - baseline, weights=known), _holes())
    np.testing.assert_allclose(back.correction, -known, rtol=1e-9)
    both = propose_weights(rig, State(shown=shown, remove=shown, weights=known), _holes())
    np.testing.assert_allclose(both.correction, -known - own, rtol=1e-9)
    assert np.isnan(both.after[2])


@pytest.mark.slow
@given(st.integers(0, 1000), st.integers(1, 15))
@examples(10)
def test_a_turned_baseline_turns_the_weights(seed: int, holes: int) -> None:
    rig, _ = _unbalanced(np.random.default_rng(seed))
    turn = np.exp(2j * np.pi * holes / 16)
    other = know(replace(rig.truth, baseline=rig.truth.baseline * turn))
    for minimise in ("unbalance", "vibration"):
        one, two = (propose_weights(r, _as_it_is(r), _holes((2e-4, 5e-4, 1e-3)), minimise) for r in (rig, other))
        np.testing.assert_allclose(two.correction, one.correction * turn, atol=1e-9 * GRAM)
        np.testing.assert_allclose(np.abs(two.after), np.abs(one.after), atol=1e-12)


def test_one_plane_alone_does_what_it_can() -> None:
    """Least squares in its own column of the influence, and its own share of the unbalance."""
    rig, own = _unbalanced(np.random.default_rng(8))
    state, holes = _as_it_is(rig), [None, _holes()[1]]
    sheet = propose_weights(rig, state, holes, "vibration")
    column = rig.truth.influence[:, 1]
    best = -np.vdot(column, state.shown) / np.vdot(column, column)
    np.testing.assert_allclose(sheet.correction, [0, best], rtol=1e-9)
    assert sheet.weights[0] == ()
    np.testing.assert_allclose(propose_weights(rig, state, holes).correction, [0, -own[1]], rtol=1e-9)


def test_least_vibration_at_one_speed_is_no_worse_there() -> None:
    rig, _ = _unbalanced(np.random.default_rng(2))
    rig = know(replace(rig.truth, baseline=rig.truth.baseline + 3e-6 * circular(np.random.default_rng(3), SIZE)))
    state, holes, first = _as_it_is(rig), _holes((5e-4, 1e-3)), slice(0, SIZE // 2)
    everywhere, here = (propose_weights(rig, state, holes, "vibration", speeds) for speeds in ((), (0,)))
    assert np.linalg.norm(here.after[first]) < np.linalg.norm(everywhere.after[first])
    assert np.linalg.norm(everywhere.after) < np.linalg.norm(here.after)
    unbalance = propose_weights(rig, state, holes, "unbalance")
    assert np.linalg.norm(unbalance.remaining) < np.linalg.norm(everywhere.remaining)


def test_the_law_of_heavy_weights_is_followed() -> None:
    """With influence that grows with the weight, the vibration that is foretold is that of the law."""
    rng = np.random.default_rng(4)
    machine = truth(rng, 0.15 / (60 * GRAM))
    rig = know(replace(machine, baseline=machine.influence @ (50 * GRAM * circular(rng, 2))))
    sheet = propose_weights(rig, _as_it_is(rig), _holes(), "vibration")
    np.testing.assert_allclose(sheet.after, predict_one(rig, sheet.correction), atol=1e-15)
    assert np.linalg.norm(sheet.after) < 0.02 * np.linalg.norm(sheet.before)


@pytest.mark.slow
def test_the_bands_hold_what_they_say() -> None:
    """Circles about what remains, and the bound of its size, over drawn records of a machine with known weights."""
    rng = np.random.default_rng(5)
    rig, own = _unbalanced(rng)
    inside, below, within = [], [], []
    for _ in range(300):
        shown = predict_one(rig, np.zeros(2, dtype=complex)) + circular(rng, SIZE) @ rig.truth.root.T
        state = State(shown=shown, remove=shown, weights=np.zeros(2, dtype=complex))
        sheet = propose_weights(rig, state, _holes((1e-3, 2e-3), 1))
        truly = own + sheet.correction
        inside += (np.abs(sheet.remaining - truly) <= sheet.circle).tolist()
        below += (np.abs(truly) <= sheet.at_most()).tolist()
        later = predict_one(rig, sheet.correction) + circular(rng, SIZE) @ rig.truth.root.T
        within += (np.abs((later - predict_one(rig, sheet.correction)).real) <= sheet.half_width).tolist()
    for held in (inside, below, within):
        assert 0.92 < np.mean(held) < 0.98


def test_planes_that_act_alike_are_refused() -> None:
    rig, _ = _unbalanced(np.random.default_rng(7))
    alike = know(replace(rig.truth, influence=rig.truth.influence[:, [0, 0]]))
    with pytest.raises(ConfigError, match="act alike"):
        propose_weights(alike, _as_it_is(alike), _holes())
    single = _as_it_is(rig)
    single.shown[1:] = np.nan
    with pytest.raises(ConfigError, match="tell the planes apart"):
        propose_weights(rig, single, _holes())


def test_what_remains_is_shared_by_the_lever(hydrostatic: Machine) -> None:
    rotor = hydrostatic.rotor
    first, second = rotor.bearing_nodes
    shared = share_tolerance(rotor, (first, second), 1.0)
    np.testing.assert_allclose(shared.remaining(np.array([2.0, 3j])), [2.0, 3j], atol=1e-12)
    middle = share_tolerance(rotor, (first + 1,), 1.0)
    begin, end = rotor.positions[[first, second]]
    share = (rotor.positions[first + 1] - begin) / (end - begin)
    np.testing.assert_allclose(middle.remaining(np.array([1.0])), [1 - share, share])
    np.testing.assert_allclose(middle.circle(np.array([[4.0]]), np.array([3.0])), [3 * (1 - share), 3 * share])
    assert shared.permissible.sum() == pytest.approx(1.0)


def test_the_centre_of_mass_is_that_of_its_parts(hydrostatic: Machine) -> None:
    """Cylinders of the shaft with their centres, and discs at their nodes, from the configuration alone."""
    given, rotor = hydrostatic.config.machine.rotor, hydrostatic.rotor
    parts, begin = [], 0.0
    for piece in given.shaft:
        area = np.pi / 4 * (piece.outer_diameter**2 - piece.inner_diameter**2)
        parts.append((given.material.density * area * piece.length, begin + piece.length / 2))
        begin += piece.length
    for disc in given.discs:
        area = np.pi / 4 * (disc.outer_diameter**2 - disc.inner_diameter**2)
        parts.append((given.material.density * area * disc.width, rotor.positions[disc.node]))
    masses, places = np.array(parts).T
    assert find_centre(rotor) == pytest.approx(masses @ places / masses.sum(), rel=1e-6)
    assert find_centre(rotor) != pytest.approx(rotor.positions[-1] / 2, rel=1e-3)


def test_a_rotor_on_one_bearing_is_refused(hydrostatic: Machine) -> None:
    with pytest.raises(ConfigError, match="two bearings"):
        share_tolerance(replace(hydrostatic.rotor, bearing_nodes=(1,)), (2,), 1.0)
