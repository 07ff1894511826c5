"""The small system at the bearings holds at the truth, and equals the full matrices in value and gradient.

Legend as in pipeline.problem: S speeds, R runs, B bearings, U unknowns.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
import pytest
import torch
from conftest import Machine, examples, unknown_at_all
from hypothesis import given
from hypothesis import strategies as st
from training import assert_close

from pipeline.coefficients import COEFFICIENTS, column, is_stiffness, row
from pipeline.config.models import ConstantModelConfig, ModelConfig, NetworkModelConfig
from pipeline.data.dataset import VibrationDataset, assemble_forces
from pipeline.data.sensors import list_directions, project
from pipeline.errors import DataError, IdentifiabilityError
from pipeline.identification.model import CoefficientModel, coefficient_model
from pipeline.identification.residual_loss import ResidualProblem, data_scale, residual_problem, speed_scaling
from pipeline.problem.identifiability import judge_identifiability, require_identifiable
from pipeline.problem.residual import (
    BearingEquations,
    LinearResidual,
    bearing_equations,
    linear_residual,
    per_speed_least_squares,
)
from pipeline.rotor.bearing_table import BearingTable
from pipeline.rotor.model import bearing_dof


def residual_in(
    equations: BearingEquations, names: Sequence[str], known: BearingTable, shared: bool = False
) -> LinearResidual:
    """The same unknowns at every bearing."""
    return linear_residual(equations, unknown_at_all(equations.bearing_nodes, names, shared), known)


def require(equations: BearingEquations, residual: LinearResidual) -> None:
    """Raise where some bearing's unknowns are determined at no speed."""
    require_identifiable(judge_identifiability(equations, residual, constant=False))


def conditions(equations: BearingEquations, residual: LinearResidual) -> np.ndarray:
    """(M, S) condition numbers of the unknowns."""
    return np.array([report.condition for report in judge_identifiability(equations, residual, constant=False)])


pytestmark = pytest.mark.usefixtures("one_thread")

CONSTANT = ConstantModelConfig(
    kind="constant",
    parametrisation="scaled",
    initialisation="guess",
    initial_stiffness=1e6,
    initial_damping=1e3,
)
NETWORK = NetworkModelConfig(
    kind="network",
    parametrisation="log",
    initialisation="guess",
    initial_stiffness=1e6,
    initial_damping=1e4,
    width=5,
    depth=2,
    activation="tanh",
    input_scaling="log_rpm",
    trend=False,
)


def read_at(machine: Machine, probes: str) -> VibrationDataset:
    """What probes at all nodes or at the bearings alone read."""
    nodes = range(machine.rotor.n_nodes) if probes == "all nodes" else machine.rotor.bearing_nodes
    return project(machine.dataset, list_directions(nodes))


def of_runs(equations: BearingEquations, runs: Sequence[int]) -> BearingEquations:
    """The equations of these runs alone."""
    return replace(
        equations,
        frequencies=equations.frequencies[:, runs],
        free_residual=equations.free_residual[..., runs],
        displacement=equations.displacement[..., runs],
    )


def some_table(machine: Machine, rng: np.random.Generator) -> BearingTable:
    """Coefficients up to twice as large as the modelled ones, of either sign."""
    true = machine.bearings
    return replace(true, values=true.values * rng.uniform(-2, 2, true.values.shape))


@pytest.mark.parametrize("name", ["hydrostatic", "ball"])
@pytest.mark.parametrize("probes", ["all nodes", "bearings"])
def test_residual_is_zero_at_the_truth(name: str, probes: str, request: pytest.FixtureRequest) -> None:
    """Eq. 6: with the modelled coefficients r = 0, to 1e-9 of the bearing force, for either set of probes."""
    machine = request.getfixturevalue(name)
    equations = bearing_equations(machine.rotor, read_at(machine, probes))
    force = np.linalg.norm(machine.bearings.impedance() @ equations.displacement, axis=2)
    residual = np.linalg.norm(equations.residual(machine.bearings.impedance()), axis=2)
    assert force.min() > 0
    assert (residual / force).max() < 1e-9


def test_bearing_force_balances_the_rotor(hydrostatic: Machine) -> None:
    """Newton: the bearings together carry what the moving masses and the unbalance push in x and in y."""
    equations, w = hydrostatic.equations, hydrostatic.speeds
    carried = (hydrostatic.bearings.impedance() @ equations.displacement).sum(axis=0)  # (S, 2, R)
    unit = np.zeros((hydrostatic.rotor.n_dof, 2))
    unit[0::4, 0] = unit[1::4, 1] = 1.0
    inertia = np.einsum("s,nd,sdr->snr", w**2, unit.T @ hydrostatic.rotor.mass, hydrostatic.response)
    pushed = unit.T @ assemble_forces(hydrostatic.rotor, hydrostatic.excitations, hydrostatic.runs, w)
    np.testing.assert_allclose(carried, inertia + pushed, rtol=0, atol=1e-9 * np.abs(pushed).max())


def test_missing_probe_at_a_bearing_is_refused(hydrostatic: Machine) -> None:
    """Eq. 6 needs q_b: x and y of every bearing."""
    short = tuple(channel for channel in hydrostatic.dataset.channels if channel != (5, 90.0))
    with pytest.raises(DataError, match="y of node 5"):
        bearing_equations(hydrostatic.rotor, project(hydrostatic.dataset, short))


def test_subset_of_speeds(hydrostatic: Machine) -> None:
    """The equations of some speeds are those of all speeds there: speeds do not mix (eq. 1)."""
    keep = np.arange(60) % 7 == 3
    part, whole = hydrostatic.measurement.select(keep).equations, hydrostatic.equations
    np.testing.assert_allclose(part.free_residual, whole.free_residual[:, keep], rtol=1e-9, atol=1e-12)
    np.testing.assert_array_equal(part.displacement, whole.displacement[:, keep])
    np.testing.assert_array_equal(part.speeds, hydrostatic.speeds[keep])


def full_norm(machine: Machine, coefficients: torch.Tensor) -> torch.Tensor:
    """||D Q - F|| over all rows of eq. 1, D written down densely with the bearings (B, S, 8) in it."""
    rotor, w = machine.rotor, torch.as_tensor(machine.speeds)
    mass, damping, gyroscopic, stiffness = (
        torch.as_tensor(matrix, dtype=torch.complex128)
        for matrix in (rotor.mass, rotor.damping, rotor.gyroscopic, rotor.stiffness)
    )
    ws = w[:, None, None]
    d = -(ws**2) * mass + 1j * ws * (damping + ws * gyroscopic) + stiffness
    for b, pair in enumerate(bearing_dof(rotor)):
        for u, name in enumerate(COEFFICIENTS):
            place = torch.zeros(rotor.n_dof, rotor.n_dof, dtype=torch.complex128)
            place[pair[row(name)], pair[column(name)]] = 1.0
            factor = 1.0 if is_stiffness(name) else 1j * ws
            d = d + coefficients[b, :, u, None, None] * factor * place
    q = torch.as_tensor(machine.response)
    force = torch.as_tensor(assemble_forces(rotor, machine.excitations, machine.runs, machine.speeds))
    return (d @ q - force).abs().square().sum().sqrt()


def small_norm(equations: BearingEquations, coefficients: torch.Tensor) -> torch.Tensor:
    """||g + H q||, eq. 6 in the bearings' rows."""
    blocks = coefficients[..., :4] + 1j * torch.as_tensor(equations.speeds)[:, None] * coefficients[..., 4:]
    impedance = blocks.reshape(*blocks.shape[:2], 2, 2)
    residual = torch.as_tensor(equations.free_residual) + impedance @ torch.as_tensor(equations.displacement)
    return residual.abs().square().sum().sqrt()


def test_small_system_equals_the_full_matrices(hydrostatic: Machine, rng: np.random.Generator) -> None:
    """Eq. 6: rows without a bearing hold by themselves; those with one have the norm and gradient of all."""
    values = some_table(hydrostatic, rng).values
    leaves = [torch.tensor(values, requires_grad=True) for _ in range(2)]
    full, small = full_norm(hydrostatic, leaves[0]), small_norm(hydrostatic.equations, leaves[1])
    assert small.item() == pytest.approx(full.item(), rel=1e-9)
    full.backward()
    small.backward()
    # Coefficients differ in size: each gradient is weighed by its own coefficient.
    gradients = [leaf.grad.numpy() * np.abs(values) for leaf in leaves]
    np.testing.assert_allclose(gradients[1], gradients[0], rtol=0, atol=1e-9 * np.abs(gradients[0]).max())


def test_numpy_residual_is_the_one_that_is_differentiated(hydrostatic: Machine, rng: np.random.Generator) -> None:
    """``BearingEquations.residual`` and the torch expression above have the same norm."""
    table = some_table(hydrostatic, rng)
    norm = np.linalg.norm(hydrostatic.equations.residual(table.impedance()))
    assert small_norm(hydrostatic.equations, torch.as_tensor(table.values)).item() == pytest.approx(norm)


def test_rows_are_linear_in_the_unknowns(hydrostatic: Machine, rng: np.random.Generator) -> None:
    """``A p + y`` of the unknowns is the residual, real parts first, for any split in known and unknown."""
    table = some_table(hydrostatic, rng)
    residual = hydrostatic.equations.residual(table.impedance())
    wanted = np.concatenate([f(residual).reshape(2, 60, -1) for f in (np.real, np.imag)], axis=2)
    for unknowns in (("kxx",), ("kxx", "kyy", "cxx", "cyy"), ("cyx", "kxy"), COEFFICIENTS):
        system = residual_in(hydrostatic.equations, unknowns, table)
        p = np.stack([table.coefficient(name) for name in unknowns], axis=-1)
        rows = (system.matrix @ p[..., None])[..., 0] + system.offset
        np.testing.assert_allclose(rows, wanted, rtol=0, atol=1e-11 * np.abs(wanted).max())


def test_equation_7_by_autograd(hydrostatic: Machine, rng: np.random.Generator) -> None:
    """Paper, eq. 7: d||r|| / dD_bb = r_b q_b^H / ||r||, with the conjugate that complex amplitudes need.

    torch's gradient of a real function by a complex H is dL/dRe(H) + j dL/dIm(H).
    """
    equations = hydrostatic.equations
    q, g = torch.as_tensor(equations.displacement), torch.as_tensor(equations.free_residual)
    impedance = torch.tensor(some_table(hydrostatic, rng).impedance(), requires_grad=True)
    residual = g + impedance @ q
    norm = residual.abs().square().sum().sqrt()
    norm.backward()
    wanted = (residual @ q.mH / norm).detach()
    assert_close(impedance.grad, wanted, rtol=1e-10, atol=1e-10 * wanted.abs().max().item())


@pytest.mark.parametrize("scaling", ["none", "per_speed"])
def test_equation_7_is_the_gradient_of_the_loss(scaling: str, hydrostatic: Machine, rng: np.random.Generator) -> None:
    """Eq. 7 by the chain rule: d/dkij = Re(r_i conj(q_j)), d/dcij = w Im(r_i conj(q_j)), summed over speeds
    and runs and divided by ||r||, is the gradient that training follows (all eight, constant over speed).

    Each speed's residual is multiplied by its scaling before the norm; the loss is the norm over sqrt(4 R S).
    """
    equations = hydrostatic.equations
    factors = speed_scaling(scaling, equations)
    problem, model = problem_of(hydrostatic, CONSTANT, COEFFICIENTS, 2, factors)
    values = hydrostatic.bearings.values.mean(axis=1) * rng.uniform(-2, 2, (2, 8))
    scale = np.array(model.scale)
    parameters = torch.tensor(values / scale, requires_grad=True)
    problem.loss(parameters[None]).sum().backward()
    table = replace(hydrostatic.bearings, values=np.repeat(values[:, None], 60, axis=1))
    weight = factors[:, :, None, None]
    r, q = weight * equations.residual(table.impedance()), weight * equations.displacement
    norm = np.sqrt((np.abs(r) ** 2).sum(axis=(1, 2, 3)))
    for u, name in enumerate(COEFFICIENTS):
        product = r[:, :, row(name)] * q[:, :, column(name)].conj()  # (B, S, R)
        part = product.real if is_stiffness(name) else hydrostatic.speeds[:, None] * product.imag
        wanted = part.sum(axis=(1, 2)) / norm / np.sqrt(4 * 3 * 60)
        np.testing.assert_allclose(parameters.grad.numpy()[:, u] / scale[:, u], wanted, rtol=1e-8, err_msg=name)


def problem_of(
    machine: Machine,
    config: ModelConfig,
    unknowns: tuple[str, ...],
    members: int,
    factors: np.ndarray,
    known: BearingTable | None = None,
    keep: np.ndarray | None = None,
) -> tuple[ResidualProblem, CoefficientModel]:
    """What training minimises, at the speeds ``keep``; the known coefficients are the modelled ones."""
    residual = residual_in(machine.equations, unknowns, machine.bearings if known is None else known, members == 1)
    model = coefficient_model(config, unknowns, {"speed": machine.speeds}, data_scale(residual))
    keep = np.ones(len(machine.speeds), dtype=bool) if keep is None else keep
    return residual_problem(model, {"speed": machine.speeds[keep]}, residual.at(keep), factors[:, keep]), model


@pytest.mark.parametrize("members", [1, 2], ids=["tied", "separate"])
@pytest.mark.parametrize("config", [CONSTANT, NETWORK], ids=["constant", "network"])
@pytest.mark.parametrize("scaling", ["none", "per_speed"])
def test_reduced_loss_equals_the_unreduced_one(
    members: int, config: ModelConfig, scaling: str, hydrostatic: Machine, generator: torch.Generator
) -> None:
    """QR keeps norms: the loss on U rows a speed is the root mean square of all 4 R rows, training speeds."""
    unknowns = ("kxx", "kyy", "cxx", "cyy")
    equations = hydrostatic.equations
    factors = speed_scaling(scaling, equations)
    keep = np.arange(60) % 10 != 5
    problem, model = problem_of(hydrostatic, config, unknowns, members, factors, keep=keep)
    parameters = torch.randn(3, members, model.n_parameters, generator=generator, dtype=torch.float64)
    found = problem.loss(parameters)
    assert found.shape == (3, members)
    raw = model.raw(parameters, model.scaled_inputs({"speed": hydrostatic.speeds}))
    values = model.physical(raw, model.scale_tensor())[0].numpy()  # (3, members, S, U)
    for g in range(3):
        table = hydrostatic.bearings.values.copy()
        table[..., [COEFFICIENTS.index(name) for name in unknowns]] = np.broadcast_to(values[g], (2, 60, 4))
        rows = factors[:, :, None, None] * equations.residual(replace(hydrostatic.bearings, values=table).impedance())
        square = (np.abs(rows[:, keep]) ** 2).reshape(members, -1)
        np.testing.assert_allclose(found[g].numpy(), np.sqrt(square.mean(axis=1) / 2), rtol=1e-10)


def test_member_is_the_problem_of_one_bearing(hydrostatic: Machine, generator: torch.Generator) -> None:
    """Bearings trained separately do not influence each other: the loss of one is that of its own problem."""
    problem, model = problem_of(hydrostatic, NETWORK, ("kxx", "kyy"), 2, np.ones((2, 60)))
    parameters = torch.randn(2, 2, model.n_parameters, generator=generator, dtype=torch.float64)
    together = problem.loss(parameters)
    for m in range(2):
        assert_close(problem.members()[m].loss(parameters[:, m : m + 1])[:, 0], together[:, m], rtol=1e-13, atol=0)


@pytest.mark.parametrize("name", ["hydrostatic", "ball"])
def test_per_speed_scaling_makes_every_speed_count(name: str, request: pytest.FixtureRequest) -> None:
    """method.md, section 2: scaled, what an absent bearing leaves has size one at every bearing and speed."""
    equations = request.getfixturevalue(name).equations
    factors = speed_scaling("per_speed", equations)
    size = np.sqrt((np.abs(factors[:, :, None, None] * equations.free_residual) ** 2).mean(axis=(2, 3)))
    np.testing.assert_allclose(size, 1.0, rtol=1e-12)
    assert (speed_scaling("none", equations) == 1.0).all()


SUBSETS = [("kxx", "kyy"), ("kxx", "kyy", "cxx", "cyy"), ("kxx", "kxy", "kyx", "kyy")]


@pytest.mark.parametrize("unknowns", SUBSETS, ids="-".join)
@pytest.mark.parametrize("probes", ["all nodes", "bearings"])
def test_least_squares_is_exact_on_clean_data(unknowns: tuple[str, ...], probes: str, hydrostatic: Machine) -> None:
    """Tiwari, Lees, Friswell (2002): independent equations, as many as unknowns, give them, here to 1e-9."""
    equations = bearing_equations(hydrostatic.rotor, read_at(hydrostatic, probes))
    found = per_speed_least_squares(system := residual_in(equations, unknowns, hydrostatic.bearings))
    true = np.stack([hydrostatic.bearings.coefficient(name) for name in unknowns], axis=-1)
    assert np.isfinite(conditions(equations, system)).all()
    # Coefficients of one kind are measured by the largest of them: some pass zero.
    assert (np.abs(found - true) / np.abs(true).max(axis=-1, keepdims=True)).max() < 1e-9


def test_least_squares_on_ball_bearings(ball: Machine) -> None:
    """One run gives four real equations a bearing and speed: enough for kxx and kyy, and for damping too."""
    for unknowns in (("kxx", "kyy"), ("kxx", "kyy", "cxx", "cyy")):
        found = per_speed_least_squares(residual_in(ball.equations, unknowns, ball.bearings))
        for u, name in enumerate(unknowns):
            w = 1.0 if is_stiffness(name) else ball.speeds
            error = np.abs(found[..., u] - ball.bearings.coefficient(name)) * w
            assert (error / ball.bearings.coefficient("kxx")).max() < 1e-9


def test_least_squares_of_all_eight(hydrostatic: Machine) -> None:
    """method.md, section 3: unbalance runs on two journal bearings have rank 2 and a condition number of 1e3
    to 1e5, which clean data in double precision bear: 1e-8 is asked, and what is reached is printed.
    """
    true = hydrostatic.bearings.values
    unread = replace(hydrostatic.bearings, values=np.full_like(true, np.nan))
    condition = conditions(hydrostatic.equations, system := residual_in(hydrostatic.equations, COEFFICIENTS, unread))
    error = float(
        (np.linalg.norm(per_speed_least_squares(system) - true, axis=-1) / np.linalg.norm(true, axis=-1)).max()
    )
    print(f"eight coefficients: error {error:.1e}, condition {condition.min():.1e} to {condition.max():.1e}")
    assert error < 1e-8
    assert condition.min() > 200


@examples(15)
@given(exponents=st.lists(st.floats(-9, 9), min_size=4, max_size=4), rows=st.floats(-6, 6))
def test_condition_number_does_not_depend_on_units(hydrostatic: Machine, exponents: list[float], rows: float) -> None:
    """The condition number speaks of the orbits: other units of a coefficient or of force leave it alone."""
    system = residual_in(hydrostatic.equations, SUBSETS[1], hydrostatic.bearings)
    factors = 10.0 ** np.array(exponents)
    other = replace(system, matrix=system.matrix * factors * 10.0**rows, offset=system.offset * 10.0**rows)
    np.testing.assert_allclose(*(conditions(hydrostatic.equations, each) for each in (other, system)), rtol=1e-9)
    np.testing.assert_allclose(per_speed_least_squares(other) * factors, per_speed_least_squares(system), rtol=1e-9)


def test_condition_number_of_a_rank_one_system(hydrostatic: Machine) -> None:
    """Two runs with the same orbit are one: the four coefficients of a row then have no finite answer."""
    equations = hydrostatic.equations
    twice = of_runs(equations, [0, 0])
    system = residual_in(twice, ("kxx", "kxy", "cxx", "cxy"), hydrostatic.bearings)
    assert (conditions(twice, system) > 1e13).all()
    assert np.isfinite(per_speed_least_squares(system)).all()
    with pytest.raises(IdentifiabilityError, match="orbits are multiples of each other"):
        require(twice, system)
    require(equations, residual_in(equations, COEFFICIENTS, hydrostatic.bearings))


@pytest.mark.parametrize("unknowns", [("kxx", "kxy", "cxx", "cxy"), COEFFICIENTS, ("kyx", "cyy", "cyx")])
def test_too_few_runs_are_refused(unknowns: tuple[str, ...], hydrostatic: Machine) -> None:
    """method.md, section 3: a run gives two real equations a direction; fewer than unknowns are refused."""
    few = of_runs(hydrostatic.equations, [0])
    with pytest.raises(
        IdentifiabilityError, match=f"the 1 run determine . of {len(unknowns)} unknowns: a run gives 2 real"
    ):
        require(few, residual_in(few, unknowns, hydrostatic.bearings))


def test_enough_runs_are_taken(hydrostatic: Machine) -> None:
    """All eight need two runs, and two unknowns a direction one."""
    for unknowns, runs in ((COEFFICIENTS, 2), (("kxx", "cxx", "kyy", "cyy"), 1)):
        system = residual_in(of_runs(hydrostatic.equations, range(runs)), unknowns, hydrostatic.bearings)
        assert system.matrix.shape == (2, 60, 4 * runs, len(unknowns))
