"""What the data determine: the rank theorem, structures, and the preconditioned loss."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import torch
from conftest import Machine, MachineFactory, bearings_of

from pipeline.coefficients import COEFFICIENTS
from pipeline.config.compose import compose_config
from pipeline.data.dataset import Excitation
from pipeline.data.simulate import simulate
from pipeline.identification.fit import fit
from pipeline.identification.residual_loss import ResidualTraining, initial_parameters, prepare_residual
from pipeline.identification.training import setup_of
from pipeline.problem.identifiability import Identifiability, Solvability, decompose, judge_identifiability
from pipeline.problem.residual import (
    BearingEquations,
    LinearResidual,
    bearing_equations,
    linear_residual,
    per_speed_least_squares,
)
from pipeline.rotor.bearing_table import BearingTable
from pipeline.unknowns import UnknownSet, tie, unknown_set

FEW = ("machine.speeds.start_rpm=500", "machine.speeds.step_rpm=250")
UNBALANCES = tuple(
    Excitation(run, "unbalance", node, 1e-4, phase)
    for run, node, phase in (("a", 2, 0.0), ("b", 4, 0.0), ("c", 2, 0.0), ("c", 4, 1.5), ("d", 4, 2.5), ("d", 1, 0.3))
)
BACKWARD = Excitation("backward", "force", 2, 10.0, 0.0, "backward")
ANISOTROPIC = dict(zip(COEFFICIENTS, (6e6, 8e6, -1.4e7, 9e6, 2e5, 4e4, 4e4, 3e5), strict=True))
ISOTROPIC = {"kxx": 7e6, "kxy": 5e6, "kyx": -5e6, "kyy": 7e6, "cxx": 2e5, "cyy": 2e5}


@pytest.fixture(scope="module")
def rotor_of(machine: MachineFactory) -> Machine:
    """The rotor with two discs; its bearings are chosen by the tests."""
    return machine("experiment=all_coefficients", *FEW)


def everything(nodes: tuple[int, ...]) -> UnknownSet:
    """All eight coefficients of every bearing."""
    return unknown_set(dict.fromkeys(nodes, tie(COEFFICIENTS)))


def table_of(machine: Machine, *bearings: dict[str, float]) -> BearingTable:
    """Bearings with these coefficients at every speed."""
    each = [
        bearings_of((node,), machine.speeds, **b) for node, b in zip(machine.rotor.bearing_nodes, bearings, strict=True)
    ]
    return BearingTable(machine.rotor.bearing_nodes, machine.speeds, np.concatenate([one.values for one in each]))


def equations_of(
    machine: Machine, table: BearingTable, acting: tuple[Excitation, ...], own: np.ndarray | None = None
) -> tuple[BearingEquations, LinearResidual]:
    """What clean readings of these runs say, of all eight coefficients of both bearings."""
    equations = bearing_equations(machine.rotor, simulate(machine.rotor, table, acting, own))
    return equations, linear_residual(equations, everything(table.nodes), table)


def accounts_of(
    machine: Machine, table: BearingTable, acting: tuple[Excitation, ...], own: np.ndarray | None = None
) -> tuple[Identifiability, ...]:
    """What the runs determine of all eight coefficients of both bearings."""
    return judge_identifiability(*equations_of(machine, table, acting, own), constant=False)


def reports_of(machine: Machine) -> tuple[Identifiability, ...]:
    """What the machine's own runs determine of its own unknowns."""
    return judge_identifiability(machine.equations, machine.measurement.residual, constant=False)


@pytest.mark.parametrize(
    ("bearings", "more", "ranks"),
    [
        ((ANISOTROPIC, ANISOTROPIC), (), (2, 2)),
        ((ANISOTROPIC, ISOTROPIC), (), (1, 2)),
        ((ISOTROPIC, ANISOTROPIC), (), (2, 1)),
        ((ISOTROPIC, ISOTROPIC), (), (1, 1)),
        ((ANISOTROPIC, ISOTROPIC), (BACKWARD,), (2, 2)),
        ((ISOTROPIC, ISOTROPIC), (BACKWARD,), (2, 2)),
    ],
)
def test_the_rank_of_the_orbits(
    rotor_of: Machine, bearings: tuple[dict[str, float], ...], more: tuple[Excitation, ...], ranks: tuple[int, int]
) -> None:
    """Of unbalance, backward whirl comes from anisotropic bearings alone; one backward run adds it whatever they are.

    The only one of them has it in a fixed ratio to its own forward whirl: rank 1, whatever the planes. The isotropic
    bearing beside it sees the two in any ratio. Each dimension determines four of the eight unknowns.
    """
    accounts = accounts_of(rotor_of, table_of(rotor_of, *bearings), (*UNBALANCES, *more))
    for account, rank in zip(accounts, ranks, strict=True):
        assert (set(account.orbit_rank), set(account.rank)) == ({rank}, {4 * rank})
        assert (account.verdict is Solvability.IDENTIFIABLE) is (rank == 2)


def test_a_third_unbalance_run_adds_no_equation(rotor_of: Machine) -> None:
    """Two runs span what all four do: the ranks are the same, and the smallest singular value stays of its order."""
    table = table_of(rotor_of, ANISOTROPIC, ANISOTROPIC)
    two, four = (accounts_of(rotor_of, table, acting) for acting in (UNBALANCES[:2], UNBALANCES))
    for few, many in zip(two, four, strict=True):
        assert (few.rank == many.rank).all()
        assert (many.condition > 0.05 * few.condition).all()


def test_condition_numbers_of_the_papers_rotor(rotor_of: Machine) -> None:
    """Orbits: near a thousand with three unbalance runs, about 2 to 3 with a backward one."""
    modelled, acting = rotor_of.bearings, rotor_of.excitations
    for account in accounts_of(rotor_of, modelled, acting):
        assert 5e2 < np.median(account.orbit_condition) < 2e3
        assert account.verdict is Solvability.IDENTIFIABLE
    for account in accounts_of(rotor_of, modelled, (*acting, BACKWARD)):
        assert np.median(account.orbit_condition) < 4


def test_asynchronous_forward_runs_do_what_a_backward_one_does(rotor_of: Machine) -> None:
    """One orbit shape at two frequencies tells stiffness from damping and x from y: rank 8."""
    table = table_of(rotor_of, ANISOTROPIC, ISOTROPIC)
    acting = (UNBALANCES[0], *(Excitation(f"at {node}", "force", node, 10.0, 0.0, "forward") for node in (2, 4)))
    own = np.stack([rotor_of.speeds, 0.6 * rotor_of.speeds, 0.6 * rotor_of.speeds], axis=1)
    assert set(accounts_of(rotor_of, table, acting)[0].rank) == {4}
    assert set(accounts_of(rotor_of, table, acting, own)[0].rank) == {8}


def test_the_free_combination_changes_nothing_that_is_measured(rotor_of: Machine) -> None:
    """Adding the combination that the account names to the true coefficients leaves the residual at zero."""
    equations, system = equations_of(rotor_of, table_of(rotor_of, ANISOTROPIC, ISOTROPIC), UNBALANCES)
    account = judge_identifiability(equations, system, constant=False)[0]
    length = np.linalg.norm(system.matrix[0], axis=1)
    size = np.linalg.norm(equations.free_residual[0], axis=(1, 2))[:, None]
    moved = np.einsum("sru,su->sr", system.matrix[0], account.free / length * size)
    np.testing.assert_allclose(moved / size, 0.0, atol=1e-9)
    assert account.free_combination().count(" k") + account.free_combination().count(" c") >= 2


def test_what_is_determined_least_does_not_hang_on_rounding(rng: np.random.Generator) -> None:
    """Two smallest singular values tie: any rotation of the rows leaves the direction, which has unit length."""
    left, right = (np.linalg.qr(rng.standard_normal((5, 5)))[0] for _ in range(2))
    columns = np.stack([left, left[::-1]]) * [3.0, 2.0, 1.0, 0.5, 0.5] @ right.T
    values, least = decompose(columns)
    assert values == pytest.approx(np.tile([3.0, 2.0, 1.0, 0.5, 0.5], (2, 1)))
    assert least[0] == pytest.approx(least[1], abs=1e-10)
    assert np.linalg.norm(columns[0] @ least[0]) == pytest.approx(0.5)
    assert np.linalg.norm(least[0]) == pytest.approx(1.0)
    assert decompose(np.diag([1.0, -2.0, 0.0])[None])[1] == pytest.approx(np.array([[0.0, 0.0, 1.0]]))


@pytest.mark.slow
def test_verdicts_of_the_compressor(machine: MachineFactory) -> None:
    """The journal bearing can't be identified; the isotropic one can, by its structure; a backward run cures."""
    made = machine("experiment=compressor_journal_and_isotropic", "machine.speeds.step_rpm=200")
    journal, isotropic = reports_of(made)
    assert (set(journal.rank), set(journal.orbit_rank)) == ({4}, {1})
    assert isotropic.verdict is Solvability.IDENTIFIABLE
    cured = machine(
        "experiment=compressor_journal_and_isotropic",
        "machine=compressor_journal_and_isotropic_backward",
        "machine.speeds.step_rpm=200",
    )
    assert [account.verdict for account in reports_of(cured)] == [Solvability.IDENTIFIABLE] * 2


def test_a_constant_is_identifiable_across_speeds(rotor_of: Machine) -> None:
    """One run determines half of eight unknowns at each speed; that they are the same at all speeds does the rest."""
    said = equations_of(rotor_of, table_of(rotor_of, ANISOTROPIC, ANISOTROPIC), UNBALANCES[:1])
    constant, free = (judge_identifiability(*said, constant=constant) for constant in (True, False))
    assert [one.verdict for one in constant] == [Solvability.ACROSS_SPEEDS] * 2
    assert [one.verdict for one in free] == [Solvability.NOT_IDENTIFIABLE] * 2
    assert "2 real equations" in free[0].reason


def trained(machine: Machine, table: BearingTable, acting: tuple[Excitation, ...], *overrides: str) -> BearingTable:
    """The table that a short training gives."""
    few = ("optimizer.levenberg_marquardt.steps=40", "training.holdout_every=0")
    config = compose_config(["experiment=all_coefficients", *few, *overrides])
    data = replace(machine, bearings=table).measured(simulate(machine.rotor, table, acting), config)
    return fit(data, replace(setup_of(config), seed=1)).table(table)


@pytest.mark.slow
@pytest.mark.parametrize(
    ("structure", "ties", "bearing"),
    [
        ("isotropic", [("kxx", "kyy", 1), ("kxy", "kyx", -1), ("cxx", "cyy", 1), ("cxy", "cyx", -1)], ISOTROPIC),
        ("symmetric_damping", [("cxy", "cyx", 1)], ANISOTROPIC),
    ],
)
def test_a_structure_is_respected_exactly(
    rotor_of: Machine, structure: str, ties: list[tuple[str, str, int]], bearing: dict[str, float]
) -> None:
    """To the last bit, and it removes unknowns for real: the isotropic one needs a forward and a backward run."""
    acting = (UNBALANCES[0], BACKWARD) if structure == "isotropic" else (*UNBALANCES, BACKWARD)
    table = table_of(rotor_of, bearing, bearing)
    found = trained(rotor_of, table, acting, f"identify.structure={structure}")
    for one, other, sign in ties:
        assert np.array_equal(found.coefficient(one), sign * found.coefficient(other))
    for name in ("kxx", "kyy", "cxx"):
        np.testing.assert_allclose(found.coefficient(name), table.coefficient(name), rtol=7e-5)


def test_bearings_may_have_different_unknowns(rotor_of: Machine) -> None:
    table = table_of(rotor_of, ANISOTROPIC, ISOTROPIC)
    exception = "+identify.bearings={5: {unknowns: [kxx, kyy], structure: isotropic}}"
    found = trained(rotor_of, table, (*UNBALANCES, BACKWARD), exception)
    kept = [COEFFICIENTS.index(name) for name in COEFFICIENTS if name not in ("kxx", "kyy")]
    assert np.array_equal(found.values[1][:, kept], table.values[1][:, kept])
    assert np.array_equal(found.coefficient("kxx")[1], found.coefficient("kyy")[1])
    np.testing.assert_allclose(found.values[0], table.values[0], rtol=1e-5)


def prepared_with(machine: Machine, *overrides: str) -> ResidualTraining:
    """The training of all eight coefficients of a machine."""
    config = compose_config(["experiment=all_coefficients", *overrides])
    return prepare_residual(machine.measured(machine.dataset, config), setup_of(config))


@pytest.mark.slow
def test_both_losses_have_the_same_minimiser_on_clean_data(rotor_of: Machine) -> None:
    """At the true coefficients both are zero to rounding, and their answers at each speed are the truth."""
    for loss in ("residual", "preconditioned"):
        problem = prepared_with(rotor_of, f"loss={loss}", "training.holdout_every=0").problem
        _, answer = problem.per_speed(0.0)
        np.testing.assert_allclose(answer * problem.scale.numpy(), rotor_of.bearings.values, rtol=1e-5, atol=1.0)
        rows = (problem.matrix @ torch.as_tensor(rotor_of.bearings.values)[..., None])[..., 0] + problem.offset
        assert rows.square().sum().sqrt() < 1e-9


@pytest.mark.slow
def test_the_preconditioned_loss_is_the_distance_from_the_answer_of_each_speed(rotor_of: Machine) -> None:
    """Without regularisation its rows are the relative distance itself; with it, no direction is weighed more."""
    problem = prepared_with(rotor_of, "loss=residual").problem
    plain, damped = problem.preconditioned(0.0), problem.preconditioned(1e-3)
    size = np.sqrt(plain.offset.shape[1] * plain.offset.shape[2])
    for m in range(2):
        # Double precision over a condition number of up to 1e5.
        unit = plain.matrix[m] * plain.scale[m, 0] * size
        np.testing.assert_allclose(unit, np.broadcast_to(np.eye(8), unit.shape), atol=1e-8)
        weights = np.linalg.svd((damped.matrix[m] * damped.scale[m, 0] * size).numpy(), compute_uv=False)
        assert weights.max() <= 1 + 1e-9
        assert weights.min() < 3e-3


def test_the_start_from_least_squares_is_near_the_answer(rotor_of: Machine) -> None:
    """``initialisation: per_speed`` starts below a thousandth of the loss of a guess."""
    losses = []
    for initialisation in ("guess", "per_speed"):
        config = compose_config(["experiment=all_coefficients", f"model.initialisation={initialisation}"])
        prepared = prepare_residual(rotor_of.measured(rotor_of.dataset, config), setup_of(config))
        losses.append(float(prepared.problem.loss(initial_parameters(prepared, setup_of(config), 0)).max()))
    assert losses[1] < 1e-3 * losses[0]


def test_asynchronous_data_are_identified(machine: MachineFactory) -> None:
    """Forces at another frequency than the rotor's speed: least squares finds the coefficients of the rotor speed."""
    runs = (
        "[{name: a, unbalances: [{node: 2, magnitude: 1e-4}]}, "
        "{name: b, forces: [{node: 4, magnitude: 10}], frequency_ratio: 0.4}, "
        "{name: c, forces: [{node: 2, magnitude: 5, whirl: backward}], frequency_hz: 30}]"
    )
    made = machine("experiment=all_coefficients", *FEW, f"machine.runs={runs}")
    assert made.dataset.frequencies.shape == (len(made.speeds), 3)
    np.testing.assert_allclose(made.dataset.frequencies[:, 2], 60 * np.pi)
    values = per_speed_least_squares(linear_residual(made.equations, everything((1, 5)), made.bearings))
    np.testing.assert_allclose(values, made.bearings.values, rtol=1e-6, atol=1.0)
    residual: BearingEquations = made.equations
    impedance = made.bearings.impedance(made.dataset.frequencies)
    assert np.abs(residual.residual(impedance)).max() < 1e-8 * np.abs(residual.free_residual).max()
