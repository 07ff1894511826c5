"""A bow of the shaft: against a closed form, and against ROSS."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from conftest import MachineFactory
from small_rotor import DISC, steel_rotor

from benchmarks.ross_oracle import ross_rotor
from pipeline.parameters.geometry import bow_force
from pipeline.parameters.model import ModelParameter, set_values
from pipeline.rotor.dynamic_stiffness import banded, solve
from pipeline.rotor.interpolation import bearing_places


def test_a_bowed_shaft_rolls_in_its_shape() -> None:
    """At slow roll a beam on rigid supports shows its bow: 3 z / L - 4 (z / L)^3 of a load at midspan, turning."""
    rotor, speeds = steel_rotor((1.0, 0.05, 8), [DISC | {"node": 4}], (0, 8), shear=False), np.array([0.1])
    parts = [ModelParameter("bow", 1e-5, "", 4, part) for part in ("real", "imaginary")]
    force = bow_force(set_values(parts, [2.0, 1.0]), rotor)[None, :, None]
    places = bearing_places(rotor)
    rigid = np.broadcast_to(1e13 * np.eye(2), (2, 1, 2, 2))
    motion = solve(banded(rotor), speeds, speeds, force, places.spread(rigid), places.dof)[0, :, 0].reshape(9, 4)
    share = np.minimum(rotor.positions, 1.0 - rotor.positions)
    assert motion[:, 0] == pytest.approx((2e-5 + 1e-5j) * (3 * share - 4 * share**3), rel=1e-5, abs=1e-10)
    assert motion[:, 1] == pytest.approx(-1j * motion[:, 0], rel=1e-6, abs=1e-10)


@pytest.mark.slow
def test_a_bow_moves_ross_own_rotor_as_this_one(machine: MachineFactory) -> None:
    """ROSS ``run_forced_response`` of ROSS's own stiffness times the bow, held at its bearings by ROSS's matrices."""
    made = machine("experiment=ball_bearing", "machine.speeds.step_rpm=700")
    rotor, speeds = made.rotor, made.speeds
    theirs = ross_rotor(made.config.machine.rotor, made.config.machine.bearings, speeds)
    stiffness = sum_shaft_stiffness(theirs)
    disc = rotor.disc_nodes[0]
    bow = np.zeros(theirs.ndof, dtype=complex)
    for direction, turn in ((0, 1.0), (1, -1j)):
        lateral = [6 * node + dof for node in range(rotor.n_nodes) for dof in (0, 1, 3, 4)]
        held = [6 * node + dof for node in rotor.bearing_nodes for dof in (0, 1)]
        free = [dof for dof in lateral if dof not in held]
        shape = np.zeros(theirs.ndof)
        pushed = np.array(free) == 6 * disc + direction
        shape[free] = np.linalg.solve(stiffness[np.ix_(free, free)], pushed.astype(float))
        bow += turn * 2e-5 * np.exp(0.5j) * shape / shape[6 * disc + direction]
    force = np.repeat((stiffness @ bow)[:, None], len(speeds), axis=1)
    answer = np.asarray(theirs.run_forced_response(force=force, speed_range=speeds).forced_resp)[lateral].T

    parts = [ModelParameter("bow", 2e-5, "", disc, part) for part in ("real", "imaginary")]
    own = bow_force(set_values(parts, [np.cos(0.5), np.sin(0.5)]), rotor)[None, :, None]
    places = bearing_places(rotor)
    right = np.repeat(own, len(speeds), axis=0)
    found = solve(banded(rotor), speeds, speeds, right, places.spread(made.bearings.impedance(speeds)), places.dof)
    assert np.abs(found[..., 0] - answer)[:, 0::4].max() <= 1e-7 * np.abs(answer[:, 0::4]).max()


def sum_shaft_stiffness(rotor: Any) -> np.ndarray:
    """(ndof, ndof) N/m of ROSS's shaft elements alone."""
    total = np.zeros((rotor.ndof, rotor.ndof))
    for element in rotor.shaft_elements:
        total[np.ix_(*[list(element.dof_global_index.values())] * 2)] += element.K()
    return total
