"""Axes and signs, as docs/method.md defines them: gravity, load, rotation, angles, nodes."""

from __future__ import annotations

import numpy as np
import pytest
import scipy.linalg
from conftest import bearings_of

from pipeline.config.compose import compose_config
from pipeline.config.schema import Config
from pipeline.data.dataset import Excitation
from pipeline.data.simulate import solve_response
from pipeline.rotor.model import DOF_PER_NODE, RotorModel, translation_dof
from pipeline.rotor.ross_adapter import assemble, bearing_table, ross
from pipeline.twin.prediction import sample_motion
from pipeline.units import RAD_S_PER_RPM


def composed(machine: str, *more: str) -> Config:
    """A machine of the repository."""
    return compose_config([f"machine={machine}", *more])


@pytest.fixture(scope="module")
def rotor() -> RotorModel:
    """The rotor with two discs."""
    return assemble(composed("two_discs").machine.rotor)


def test_nodes_are_counted_from_0_along_z(rotor: RotorModel) -> None:
    np.testing.assert_allclose(rotor.positions, 0.15 * np.arange(7), rtol=1e-12)


def test_a_film_carries_its_load_along_minus_y() -> None:
    """More load moves the journal along the short bearing's static curve (Ocvirk): down, and to x as the shaft turns
    from x towards y. The stiffness is what that takes.
    """
    speed, load, clearance, step = 300.0, 500.0, 1e-4, 1e-3
    size = {"bearing_length": 0.03, "journal_diameter": 0.1, "radial_clearance": clearance, "oil_viscosity": 0.1}

    def place(weight: float) -> np.ndarray:
        (e,) = ross().CylindricalBearing(n=0, speed=np.array([speed]), weight=weight, **size).eccentricity
        attitude = np.arctan(np.pi * np.sqrt(1 - e**2) / (4 * e))
        return np.array([clearance * e * np.sin(attitude), -clearance * e * np.cos(attitude)])

    assert place(load)[0] > 0 > place(load)[1]
    moved = (place(load + step) - place(load - step)) / (2 * step)
    stiffness = ross().CylindricalBearing(n=0, speed=np.array([speed]), weight=load, **size).K(speed)[:2, :2]
    np.testing.assert_allclose(stiffness @ moved, [0.0, -1.0], atol=1e-5)


def test_y_is_the_stiff_axis_of_bearings_that_ross_models() -> None:
    """A ball bearing, and a film under so much load that the journal is far down; kyx < 0 < kxy drives forward."""
    ball = composed("one_disc").machine
    of_balls = bearing_table(ball.rotor, ball.bearings, np.array([100.0]))
    assert (of_balls.coefficient("kyy") > 2 * of_balls.coefficient("kxx")).all()
    film = composed("two_discs").machine
    low, high = (bearing_table(film.rotor, film.bearings, np.array([rpm * RAD_S_PER_RPM])) for rpm in (100, 6000))
    assert (low.coefficient("kyy") > 2 * low.coefficient("kxx")).all()
    assert (high.coefficient("kxy") > 0).all()
    assert (high.coefficient("kyx") < 0).all()


def test_x_is_the_load_axis_of_a_published_table() -> None:
    machine = composed("compressor_two_journals").machine
    table = bearing_table(machine.rotor, machine.bearings, np.array([500 * RAD_S_PER_RPM]))
    assert (table.coefficient("kxx")[0] > 2 * table.coefficient("kyy")[0]).all()
    assert (table.coefficient("kxy") > 0).all()


def test_a_weight_turns_from_x_towards_y(rotor: RotorModel) -> None:
    """Far below the critical speeds the shaft bends to where the weight is: at its phase at t = 0, then on."""
    bearings = bearings_of(rotor.bearing_nodes, np.array([10.0]), kxx=1e8, kyy=1e8)
    weight = Excitation("run", "unbalance", 3, 1e-3, np.radians(30.0))
    at = [translation_dof(3, direction) for direction in range(2)]
    _, path = sample_motion(solve_response(rotor, bearings, (weight,), ("run",))[0, at, 0], 10.0)
    angles = np.degrees(np.unwrap(np.arctan2(path[:, 1], path[:, 0])))
    assert (angles[0], angles[-1]) == (pytest.approx(30.0, abs=0.01), pytest.approx(30.0 + 720.0, abs=0.01))


def test_the_axes_are_right_handed(rotor: RotorModel) -> None:
    """A rigid shaft that turns about x by alpha goes to -y, about y by beta to +x; no stiffness minds."""
    for along, about, sign in ((0, 3, 1.0), (1, 2, -1.0)):
        rigid = np.zeros(rotor.n_dof)
        rigid[along::DOF_PER_NODE], rigid[about::DOF_PER_NODE] = sign * rotor.positions, 1.0
        assert np.abs(rotor.stiffness @ rigid).max() < 1e-6 * np.abs(rotor.stiffness).max()


def test_gyroscopic_moments_stiffen_what_whirls_as_the_shaft_turns(rotor: RotorModel) -> None:
    """Of the two whirling modes of a rigid-body tilt the faster one goes from x to y: G has the sign of the weights."""
    held = rotor.stiffness.copy()
    for node in rotor.bearing_nodes:
        for direction in range(2):
            held[(translation_dof(node, direction),) * 2] += 1e6
    n, spin = rotor.n_dof, 2000.0
    inverse = np.linalg.inv(rotor.mass)
    system = np.block([[np.zeros((n, n)), np.eye(n)], [-inverse @ held, -inverse @ (spin * rotor.gyroscopic)]])
    values, vectors = scipy.linalg.eig(system)
    order = [i for i in np.argsort(values.imag) if values[i].imag > 1]
    whirl = []
    for i in order[:4]:  # two rigid-body modes, of either whirl
        x, y = (vectors[translation_dof(1, direction), i] for direction in range(2))
        whirl.append("forward" if abs(x - 1j * y) < abs(x + 1j * y) else "backward")
    assert (whirl[-1], sorted(whirl)) == ("forward", ["backward", "backward", "forward", "forward"])
