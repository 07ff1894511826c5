"""The shaft between its nodes: against rotors that ROSS makes with a node at the very place, and by laws."""

from __future__ import annotations

from functools import cache

import numpy as np
import pytest
from small_rotor import steel_rotor

from pipeline.data.dataset import Excitation
from pipeline.data.simulate import solve_response
from pipeline.rotor.bearing_table import BearingTable
from pipeline.rotor.interpolation import bearing_places, move_bearing, shaft_rows
from pipeline.rotor.model import RotorModel, bearing_dof

LENGTH = 0.56
SPEEDS = np.linspace(40.0, 130.0, 4)


def rig(elements: int, bearing_nodes: list[int], disc_nodes: list[int]) -> RotorModel:
    """A thin shaft, 10 mm, on which shear counts between neighbouring nodes."""
    discs = [{"node": k, "mass": 0.8, "diametral_inertia": 3.4e-4, "polar_inertia": 5.9e-4} for k in disc_nodes]
    return steel_rotor((LENGTH, 0.01, elements), discs, bearing_nodes)


@cache
def fine_response(place: int) -> np.ndarray:
    """(S, n) of elements of 2 mm, with the second bearing at node ``place``."""
    return respond(rig(280, [20, place], [80, 200]), 80)


def respond(rotor: RotorModel, disc: int) -> np.ndarray:
    """(S, n) to 100 g mm at the disc, on bearings with cross-coupling."""
    eight = [1e6, 2e5, -3e5, 2e6, 50.0, 0.0, 0.0, 80.0]
    bearings = BearingTable(rotor.bearing_nodes, SPEEDS, np.tile(eight, (2, len(SPEEDS), 1)))
    return solve_response(rotor, bearings, (Excitation("a", "unbalance", disc, 1e-4, 0.4),), ("a",))[..., 0]


@pytest.mark.parametrize(("shift", "tolerance"), [(20.0, 1e-5), (-40.0, 1e-5), (-10.0, 3e-3), (34.0, 3e-3)])
def test_a_moved_bearing_is_one_of_a_mesh_with_a_node_there(shift: float, tolerance: float) -> None:
    """Elements of 20 mm; between nodes the shaft is stiffer under the load by what one element gives, a thousandth."""
    coarse = rig(28, [2, 26], [8, 20])
    expected = fine_response(260 + round(shift / 2)).reshape(len(SPEEDS), -1, 4)[:, ::10, :2]
    found = respond(move_bearing(coarse, 1, shift / 1e3), 8).reshape(len(SPEEDS), -1, 4)[..., :2]
    stated = respond(coarse, 8).reshape(len(SPEEDS), -1, 4)[..., :2]
    size = np.abs(expected).max()
    assert np.abs(found - expected).max() <= tolerance * size
    assert np.abs(stated - expected).max() > 10 * tolerance * size


@pytest.mark.parametrize("shift", [-38.0, -6.0, 10.0, 40.0])
def test_a_probe_between_nodes_shows_what_a_node_there_moves(shift: float) -> None:
    """A straight line along the tangent is off by up to 3 %."""
    coarse, fine = rig(28, [2, 26], [8, 20]), fine_response(260)
    place = 4 * (140 + round(shift / 2))
    shown = respond(coarse, 8) @ shaft_rows(coarse, 14, shift / 1e3).T
    assert np.abs(shown - fine[:, place : place + 2]).max() <= 1e-5 * np.abs(fine).max()


def test_the_slope_is_that_of_differences() -> None:
    """In both directions, inside elements and beyond the ends of the shaft."""
    rotor = rig(4, [1, 3], [2])
    for shift in (-0.02, 0.05, 0.2, -0.35):
        ahead, behind = (shaft_rows(rotor, 2, shift + step) for step in (1e-6, -1e-6))
        assert shaft_rows(rotor, 2, shift, slope=True) == pytest.approx((ahead - behind) / 2e-6, abs=1e-6)


def test_a_rigid_motion_stays_one() -> None:
    """x = 1 + 3 z and y = 2 - z, with their rotations, at any place, beyond the ends, too."""
    rotor = rig(4, [1, 3], [2])
    z = rotor.positions
    motion = np.stack([1 + 3 * z, 2 - z, np.ones_like(z), 3 * np.ones_like(z)], axis=1).ravel()
    for shift in (0.0, 0.0311, -0.2, 0.3):
        place = z[2] + shift
        assert shaft_rows(rotor, 2, shift) @ motion == pytest.approx([1 + 3 * place, 2 - place], rel=1e-12)


def test_places_of_bearings_at_their_nodes_are_x_and_y() -> None:
    """Moved there and back they are the same machine."""
    rotor = rig(4, [1, 3], [2])
    assert (bearing_places(rotor).dof == bearing_dof(rotor)).all()
    back = move_bearing(move_bearing(rotor, 0, 0.02), 0, -0.02)
    there = move_bearing(rotor, 1, 1e-12)  # through the elements
    assert respond(back, 2) == pytest.approx(respond(rotor, 2), rel=1e-12)
    assert respond(there, 2) == pytest.approx(respond(rotor, 2), rel=1e-8)
    assert move_bearing(rotor, 0, 0.02).fingerprint != rotor.fingerprint == back.fingerprint
