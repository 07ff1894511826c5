"""The dynamic stiffness: the response against ROSS's own and dense solutions, and the laws that matrices obey."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest
import scipy.linalg
from conftest import Machine, MachineFactory
from small_rotor import STEEL

from benchmarks.machines import refined
from benchmarks.ross_oracle import ross_rotor
from pipeline.config.loader import list_options
from pipeline.config.rotor import RotorConfig
from pipeline.data.dataset import Excitation
from pipeline.data.simulate import solve_response
from pipeline.errors import PipelineError
from pipeline.rotor.dynamic_stiffness import apply, banded, solve
from pipeline.rotor.model import RotorModel, bearing_dof
from pipeline.rotor.ross_adapter import assemble


def dense(rotor: RotorModel, impedance: np.ndarray | None, frequencies: np.ndarray, speeds: np.ndarray) -> np.ndarray:
    """(S, n, n) eq. 1 written down term by term."""
    matrices = []
    for s, (w, speed) in enumerate(zip(frequencies, speeds, strict=True)):
        d = -(w**2) * rotor.mass + 1j * w * (rotor.damping + speed * rotor.gyroscopic) + rotor.stiffness
        if impedance is not None:
            for b, pair in enumerate(bearing_dof(rotor)):
                d[np.ix_(pair, pair)] += impedance[b, s]
        matrices.append(d)
    return np.array(matrices)


def ross_responses(machine: Machine, speeds: np.ndarray) -> np.ndarray:
    """(S, n, R) responses that ROSS computes: six DOF a node, of which 0, 1, 3, 4 are x, y, alpha, beta."""
    rotor = ross_rotor(machine.config.machine.rotor, machine.config.machine.bearings, speeds)
    lateral = [6 * node + dof for node in range(machine.rotor.n_nodes) for dof in (0, 1, 3, 4)]
    answers = []
    for run in machine.runs:
        own = [e for e in machine.excitations if e.run == run]
        if any(e.kind == "force" for e in own):
            answer = rotor.run_forced_response(force=rotating_force(own, rotor.ndof, len(speeds)), speed_range=speeds)
        else:
            nodes, sizes, phases = [e.node for e in own], [e.magnitude for e in own], [e.phase for e in own]
            answer = rotor.run_unbalance_response(nodes, sizes, phases, frequency=speeds)
        answers.append(np.asarray(answer.forced_resp)[lateral].T)
    return np.stack(answers, axis=-1)


def rotating_force(own: list[Excitation], ndof: int, count: int) -> np.ndarray:
    """ROSS's (ndof, S) complex force; method.md, section 1: [1, -j] for forward and [1, +j] for backward whirl."""
    force = np.zeros((ndof, count), dtype=complex)
    for e in own:
        phasor = e.magnitude * np.exp(1j * e.phase)
        force[6 * e.node] += phasor
        force[6 * e.node + 1] += phasor * (-1j if e.whirl == "forward" else 1j)
    return force


def assert_equals_ross(machine: Machine) -> None:
    """Every node and DOF, within 1e-9 of the largest translation or rotation of that speed and run."""
    by_kind = (len(machine.speeds), -1, 2, 2, len(machine.runs))  # speed, node, kind, direction, run
    bearings = machine.config.machine.bearings
    nodes = bearings.nodes.values() if bearings.kind == "per_node" else ()
    if any(one.kind == "journal_table" for one in nodes):  # ROSS would smooth the tables over the speeds
        answers = [ross_responses(machine, machine.speeds[[s]]) for s in range(len(machine.speeds))]
        theirs = np.concatenate(answers).reshape(by_kind)
    else:
        theirs = ross_responses(machine, machine.speeds).reshape(by_kind)
    ours = machine.response.reshape(by_kind)
    size = np.abs(theirs).max(axis=(1, 3), keepdims=True)
    assert (size > 0).all()  # ROSS turns NaN into zeros
    assert (np.abs(ours - theirs) / size).max() < 1e-9


# ROSS computes forced responses at the rotor speed; those of other frequencies are compared with their dense twin.
# Bearings that follow an oil temperature have comparisons of their own (tests/laws).
SYNCHRONOUS = [name for name in list_options("experiment") if name not in ("impulses", "oil_temperatures")]


@pytest.mark.slow
@pytest.mark.parametrize("experiment", SYNCHRONOUS)
def test_response_equals_ross(experiment: str, machine: MachineFactory) -> None:
    """Oracle: ROSS ``run_unbalance_response`` and ``run_forced_response`` on every experiment's rotor and runs."""
    step = 700 if experiment.startswith("compressor") else 100
    assert_equals_ross(machine(f"experiment={experiment}", f"machine.speeds.step_rpm={step}"))


@pytest.mark.slow
@pytest.mark.parametrize("experiment", ["ball_bearing", "hydrostatic_stiffness"])
def test_response_equals_ross_on_finer_meshes(experiment: str) -> None:
    """Oracle: ROSS, at 25 nodes: the band solve pivots far more often than at seven."""
    factor = {"ball_bearing": 12, "hydrostatic_stiffness": 4}[experiment]
    made = refined(experiment, factor, "machine.speeds.step_rpm=590")
    assert made.rotor.n_nodes == 25
    assert_equals_ross(made)


def test_beam_frequencies_converge_with_the_fourth_power_of_the_element_length() -> None:
    """Simply supported Rayleigh beam: w_n^2 = (E I / rho A) k^4 / (1 + (k r)^2) with k = n pi / L.

    Cubic elements have a frequency error of order h^4 (Strang and Fix 1973): halving h divides it by 16.
    The supports are rigid: their rows and columns are struck out.
    """
    length, diameter = 1.0, 0.01
    k = np.array([1, 2]) * math.pi / length
    radius = diameter / 4  # of gyration
    exact = np.sqrt(STEEL["youngs_modulus"] / STEEL["density"] * radius**2 * k**4 / (1 + (k * radius) ** 2))
    errors = []
    for elements in (4, 8, 16):
        config = {
            "shaft": [{"length": length, "outer_diameter": diameter, "elements": elements}],
            "material": STEEL,
            "bearing_nodes": [0, elements],
            "shear_effects": False,
        }
        rotor = assemble(RotorConfig.model_validate(config))
        free = np.setdiff1d(np.arange(rotor.n_dof), bearing_dof(rotor))
        pinned = [matrix[np.ix_(free, free)] for matrix in (rotor.stiffness, rotor.mass)]
        # Each frequency is there twice: in the planes of x and of y.
        found = np.sqrt(scipy.linalg.eigh(*pinned, eigvals_only=True, subset_by_index=[0, 3]))
        assert found[::2] == pytest.approx(found[1::2], rel=1e-7)
        errors.append(found[::2] / exact - 1)
    assert (np.array(errors) > 0).all()  # a conforming element is too stiff
    assert np.log2(np.array(errors[:-1]) / np.array(errors[1:])) == pytest.approx(np.full((2, 2), 4.0), abs=0.1)


def receptance(rotor: RotorModel, frequencies: np.ndarray, speeds: np.ndarray, impedance: np.ndarray) -> np.ndarray:
    """(S, n, n) inverse of D."""
    unit = np.broadcast_to(np.eye(rotor.n_dof, dtype=complex), (len(speeds), rotor.n_dof, rotor.n_dof))
    return solve(banded(rotor), frequencies, speeds, unit, impedance, bearing_dof(rotor))


def test_reciprocity(hydrostatic: Machine) -> None:
    """Maxwell and Betti: without spin, and with kxy = kyx, the receptance is symmetric.

    With spin the gyroscopic matrix is antisymmetric: the transposed receptance belongs to the opposite spin
    and the transposed bearings. Fluid-film bearings (kxy != kyx) are not reciprocal, so the test can fail.
    """
    rotor, few = hydrostatic.rotor, hydrostatic.bearings.at(np.arange(0, 60, 6))
    w, film = few.speeds, few.impedance()
    still = receptance(rotor, w, np.zeros_like(w), (film + film.mT) / 2)
    assert np.abs(still - still.mT).max() < 1e-10 * np.abs(still).max()
    spinning = receptance(rotor, w, w, film)
    opposite = receptance(rotor, w, -w, film.mT.copy())
    assert np.abs(spinning.mT - opposite).max() < 1e-10 * np.abs(spinning).max()
    assert np.abs(spinning - spinning.mT).max() > 1e-2 * np.abs(spinning).max()


def test_band_solve_equals_the_dense_one(hydrostatic: Machine, rng: np.random.Generator) -> None:
    """The fast path against numpy's dense one, excitation at other frequencies than the rotor's speed."""
    rotor, few = hydrostatic.rotor, hydrostatic.bearings.at(np.arange(0, 60, 7))
    frequencies = few.speeds * rng.uniform(0.2, 2.0, len(few.speeds))
    shape = (len(frequencies), rotor.n_dof, 3)
    right = rng.normal(size=shape) + 1j * rng.normal(size=shape)
    impedance = few.impedance(frequencies)
    found = solve(banded(rotor), frequencies, few.speeds, right, impedance, bearing_dof(rotor))
    wanted = np.linalg.solve(dense(rotor, impedance, frequencies, few.speeds), right)
    assert np.abs(found - wanted).max() < 1e-9 * np.abs(wanted).max()


def test_band_solve_of_some_dof_equals_the_dense_one(hydrostatic: Machine, rng: np.random.Generator) -> None:
    """The same for a subset of the DOF: what follows from measured ones, D_uu q_u = F_u - D_um q_m."""
    rotor, w = hydrostatic.rotor, hydrostatic.speeds[::9]
    kept = np.setdiff1d(np.arange(rotor.n_dof), [*bearing_dof(rotor).ravel(), 9, 17])
    right = rng.normal(size=(len(w), len(kept), 2)) + 0j
    found = solve(banded(rotor, kept), w, w, right)
    wanted = np.linalg.solve(dense(rotor, None, w, w)[:, kept[:, None], kept], right)
    assert np.abs(found - wanted).max() < 1e-9 * np.abs(wanted).max()


def test_product_equals_the_dense_one(hydrostatic: Machine, rng: np.random.Generator) -> None:
    """``apply`` multiplies only the columns that couple; the dense product is D[rows, columns] x."""
    rotor, speeds = hydrostatic.rotor, hydrostatic.speeds[::13]
    frequencies = 1.3 * speeds
    rows, columns = np.array([5, 4, 21]), np.setdiff1d(np.arange(rotor.n_dof), [7])
    x = rng.normal(size=(len(speeds), len(columns), 2)) + 1j * rng.normal(size=(len(speeds), len(columns), 2))
    wanted = dense(rotor, None, frequencies, speeds)[:, rows[:, None], columns] @ x
    assert np.abs(apply(rotor, rows, columns, frequencies, speeds, x) - wanted).max() < 1e-12 * np.abs(wanted).max()


def test_singular_system_is_refused(hydrostatic: Machine) -> None:
    """A DOF without mass and stiffness makes D singular: a sentence with the speed, never a zero or a NaN."""
    rotor = hydrostatic.rotor
    matrices = {name: getattr(rotor, name).copy() for name in ("mass", "damping", "gyroscopic", "stiffness")}
    for matrix in matrices.values():
        matrix[0], matrix[:, 0] = 0.0, 0.0
    with pytest.raises(PipelineError, match=r"singular at 10\.472 rad/s"):
        solve_response(replace(rotor, **matrices), hydrostatic.bearings, hydrostatic.excitations, hydrostatic.runs)
    with pytest.raises(PipelineError, match="singular"):
        solve(banded(rotor), np.ones(1), np.ones(1), np.full((1, rotor.n_dof, 1), np.nan))


def test_rigid_body_without_bearings_is_free(hydrostatic: Machine) -> None:
    """Newton: the shaft and discs hold themselves only. K moves no rigid body, and M weighs the rotor."""
    rotor = hydrostatic.rotor
    moved = np.zeros(rotor.n_dof)
    moved[0::4] = 1.0
    assert np.abs(rotor.stiffness @ moved).max() < 1e-9 * np.abs(rotor.stiffness).max()
    assert moved @ rotor.mass @ moved == pytest.approx(rotor.total_mass, rel=1e-12)
    for matrix, sign in ((rotor.mass, 1), (rotor.stiffness, 1), (rotor.gyroscopic, -1)):
        assert np.abs(matrix - sign * matrix.T).max() <= 1e-12 * np.abs(matrix).max()
