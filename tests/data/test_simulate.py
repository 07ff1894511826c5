"""The simulated response: closed forms, the laws that it obeys, and integration in time."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest
from conftest import Machine, bearings_of, examples
from hypothesis import given
from hypothesis import strategies as st
from parameters.test_as_built import small
from small_rotor import STEEL
from twin.test_modes import JEFFCOTT, SHAFT_STIFFNESS, jeffcott

from pipeline.coefficients import COEFFICIENTS
from pipeline.config.rotor import RotorConfig
from pipeline.data.dataset import Excitation
from pipeline.data.simulate import integrate, solve_response
from pipeline.errors import PipelineError
from pipeline.problem.configured import configure_excitations, model_machine
from pipeline.rotor.bearing_table import BearingTable
from pipeline.rotor.model import translation_dof
from pipeline.rotor.ross_adapter import assemble
from pipeline.units import RAD_S_PER_RPM


def test_the_error_of_integration_falls_with_the_square_of_the_step() -> None:
    """Half the step, a quarter of the error."""
    config = small("machine=overhung")
    rotor, truth, exact = model_machine(config)
    few, acting = truth.at(np.array([3, 5])), configure_excitations(config)
    coarse, fine = (integrate(rotor, few, acting, steps).displacement for steps in (180, 360))
    there = exact.displacement[[3, 5]]
    assert np.abs(coarse - there).max() / np.abs(fine - there).max() == pytest.approx(4, rel=0.05)


def test_an_unstable_machine_does_not_settle() -> None:
    """Cross stiffness beyond all damping."""
    config = small("machine=overhung")
    rotor, truth, _ = model_machine(config)
    values = truth.values * np.array([1, 30, 30, 1, 1, 1, 1, 1])
    with pytest.raises(PipelineError, match="must settle to be read, but at 600 rpm"):
        integrate(rotor, replace(truth, values=values), configure_excitations(config))


@pytest.mark.parametrize(("stiffness", "damping"), [(1e12, 0.0), (2e5, 40.0), (2e4, 300.0)])
def test_jeffcott_rotor(stiffness: float, damping: float) -> None:
    """Jeffcott (1919): Q = U w^2 / (k - w^2 m), k of the shaft, 48 E I / L^3, in series with the bearings.

    A shaft of 1e-6 kg/m^3 is massless to 1e-8 here, below, at (with damping) and above the critical speed.
    """
    critical = math.sqrt(SHAFT_STIFFNESS / JEFFCOTT["mass"])
    speeds = critical * np.array([0.1, 0.5, 0.9, 0.99, 1.01, 1.3, 3.0])
    table = bearings_of((0, 4), speeds, kxx=stiffness, kyy=stiffness, cxx=damping, cyy=damping)
    unbalance = Excitation("a", "unbalance", 2, 2e-4, 0.7)
    response = solve_response(jeffcott(1e-6), table, (unbalance,), ("a",))[:, translation_dof(2, 0), 0]
    series = 1 / (1 / SHAFT_STIFFNESS + 1 / (2 * (stiffness + 1j * speeds * damping)))
    expected = 2e-4 * np.exp(0.7j) * speeds**2 / (series - speeds**2 * JEFFCOTT["mass"])
    assert np.abs(response / expected - 1).max() < 1e-8


PHASES = st.floats(-math.pi, math.pi)


@examples(25)
@given(turn=PHASES, phase=PHASES, scale=st.floats(1e-3, 1e3))
def test_turning_the_unbalance_turns_the_response(
    hydrostatic: Machine, turn: float, phase: float, scale: float
) -> None:
    """An unbalance turned by phi and multiplied by s gives s e^{j phi} Q: a turn is a shift in time."""
    few = hydrostatic.bearings.at(np.arange(0, 60, 12))
    before = Excitation("a", "unbalance", 4, 1e-4, phase)
    after = replace(before, run="b", phase=phase + turn, magnitude=1e-4 * scale)
    q = solve_response(hydrostatic.rotor, few, (before, after), ("a", "b"))
    wanted = scale * np.exp(1j * turn) * q[..., 0]
    assert np.abs(q[..., 1] - wanted).max() <= 1e-10 * np.abs(wanted).max()


def test_isotropic_bearings_give_circular_orbits(hydrostatic: Machine) -> None:
    """On an axisymmetric system (also with kxy = -kyx) unbalance excites forward whirl only: Q_y = -j Q_x."""
    table = bearings_of(
        hydrostatic.rotor.bearing_nodes,
        hydrostatic.speeds,
        **{"kxx": 2e7, "kyy": 2e7, "kxy": 3e6, "kyx": -3e6, "cxx": 2e4, "cyy": 2e4, "cxy": 1e3, "cyx": -1e3},
    )
    for whirl, turn in (("forward", -1j), ("backward", 1j)):
        acting = tuple(replace(e, whirl=whirl) for e in hydrostatic.excitations)
        q = solve_response(hydrostatic.rotor, table, acting, hydrostatic.runs)
        assert np.abs(q[:, 1::4] - turn * q[:, 0::4]).max() <= 1e-10 * np.abs(q[:, 0::4]).max()


def test_turning_the_frame_turns_the_response(hydrostatic: Machine) -> None:
    """Frame indifference: in axes turned by 90 degrees (x' = y, y' = -x) H becomes R H R^T, Q becomes R Q.

    Entry by entry kxx' = kyy, kyy' = kxx, kxy' = -kyx, kyx' = -kxy; the unbalance starts at -90 degrees.
    """
    table = hydrostatic.bearings
    source = {"xx": ("yy", 1), "yy": ("xx", 1), "xy": ("yx", -1), "yx": ("xy", -1)}
    moved = [(name[0], *source[name[1:]]) for name in COEFFICIENTS]
    columns = [sign * table.coefficient(kind + entry) for kind, entry, sign in moved]
    turned = BearingTable(table.nodes, table.speeds, np.stack(columns, axis=-1))
    excitations = tuple(replace(e, phase=e.phase - math.pi / 2) for e in hydrostatic.excitations)
    q = solve_response(hydrostatic.rotor, turned, excitations, hydrostatic.runs)
    pairs = q.reshape(len(q), -1, 2, q.shape[-1])  # (x, y) and (alpha, beta) of each node: both are vectors
    wanted = hydrostatic.response.reshape(pairs.shape)
    wanted = np.stack([wanted[:, :, 1], -wanted[:, :, 0]], axis=2)
    assert (np.abs(pairs - wanted) / np.abs(wanted).max(axis=(1, 2), keepdims=True)).max() < 1e-9


def test_rigid_rotor_far_above_its_critical_speeds() -> None:
    """A free rotor turns about its centre of mass: with U at its middle, Q there tends to -U / m."""
    shaft = {"length": 0.2, "outer_diameter": 0.1, "elements": 2}
    rotor = assemble(RotorConfig.model_validate({"shaft": [shaft], "material": STEEL, "bearing_nodes": [0, 2]}))
    table = bearings_of((0, 2), np.array([6000.0]) * RAD_S_PER_RPM, kxx=100.0, kyy=100.0)
    q = solve_response(rotor, table, (Excitation("a", "unbalance", 1, 1e-4, 0.0),), ("a",))
    assert q[0, 4, 0] == pytest.approx(-1e-4 / rotor.total_mass, rel=2e-3)
