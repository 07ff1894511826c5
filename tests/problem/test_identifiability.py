"""What the data determine: the rank theorem, predicted deviations, structures, and the preconditioned loss."""

from __future__ import annotations

import itertools
import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pandas as pd
import pytest
import torch
from conftest import Machine, MachineFactory, Run, assert_says, bearings_of

from pipeline.coefficients import COEFFICIENTS
from pipeline.config.compose import compose_config
from pipeline.data.dataset import Excitation, VibrationDataset
from pipeline.data.sensors import NoiseModel
from pipeline.data.simulate import add_noise, simulate
from pipeline.errors import ConfigError, IdentifiabilityError
from pipeline.identification.fit import fit
from pipeline.identification.residual_loss import ResidualTraining, initial_parameters, prepare_residual
from pipeline.identification.training import setup_of
from pipeline.problem.design import choose, merit
from pipeline.problem.identifiability import Identifiability, Solvability, decompose, judge_identifiability
from pipeline.problem.noise import least_squares_deviation, lower_root, residual_root, whiten
from pipeline.problem.residual import (
    BearingEquations,
    LinearResidual,
    bearing_equations,
    linear_residual,
    per_speed_least_squares,
)
from pipeline.rotor.bearing_table import BearingTable
from pipeline.unknowns import UnknownSet, tie, unknown_set

EIGHT = "identify.unknowns=[kxx,kxy,kyx,kyy,cxx,cxy,cyx,cyy]"
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


def test_a_structure_needs_both_of_a_pair() -> None:
    with pytest.raises(ValueError, match="ties cxy and cyx: both must be unknown or neither"):
        tie(("kxx", "cxy"), "symmetric_damping")


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


def fits(machine: Machine, dataset: VibrationDataset, unknowns: UnknownSet, root: np.ndarray) -> LinearResidual:
    """The weighted equations of a data set."""
    return whiten(linear_residual(bearing_equations(machine.rotor, dataset), unknowns, machine.bearings), root)


@pytest.mark.slow
@pytest.mark.parametrize("sensors", ["every node", "bearings alone"])
def test_the_predicted_deviation_is_the_spread_of_noisy_fits(
    rotor_of: Machine, sensors: str, rng: np.random.Generator
) -> None:
    """200 weighted least-squares fits to data with noise: the same deviation within 10 %, for all sixteen."""
    dataset = simulate(rotor_of.rotor, rotor_of.bearings, (*rotor_of.excitations, BACKWARD))
    if sensors == "bearings alone":
        kept = [p for p, (node, _) in enumerate(dataset.channels) if node in (1, 5)]
        channels = tuple(dataset.channels[p] for p in kept)
        dataset = replace(dataset, channels=channels, displacement=dataset.displacement[:, kept])
    unknowns = everything((1, 5))
    deviation = NoiseModel(0.0, 1e-4).deviation(dataset.displacement)
    root = residual_root(rotor_of.rotor, dataset, rotor_of.bearings, deviation)
    predicted = least_squares_deviation(fits(rotor_of, dataset, unknowns, root))
    found = np.array(
        [
            per_speed_least_squares(fits(rotor_of, add_noise(dataset, deviation, rng), unknowns, root))
            for _ in range(200)
        ]
    )
    # The spread of 200 fits is itself known to 5 %; its median over the speeds to much less.
    np.testing.assert_allclose(np.median(found.std(axis=0, ddof=1) / predicted, axis=1), 1.0, atol=0.1)
    bias = (found.mean(axis=0) - rotor_of.bearings.values) / (predicted / np.sqrt(len(found)))
    assert np.abs(bias).max() < 5  # deviations of the mean, over 60 speeds and sixteen coefficients


def test_a_root_whitens_where_its_product_is_no_covariance(rng: np.random.Generator) -> None:
    """Its factor is Cholesky's, and rows of nearly one direction, 1e-9 apart, stay apart."""
    root = rng.standard_normal((5, 4, 6)) + 1j * rng.standard_normal((5, 4, 6))
    np.testing.assert_allclose(lower_root(root), np.linalg.cholesky(root @ root.conj().swapaxes(1, 2)), rtol=1e-9)
    root[:, 3] = root[:, 2] + 1e-9 * root[:, 3]
    white = np.linalg.solve(lower_root(root), root)
    np.testing.assert_allclose(white @ white.conj().swapaxes(1, 2), np.broadcast_to(np.eye(4), (5, 4, 4)), atol=1e-6)
    with pytest.raises(np.linalg.LinAlgError):
        np.linalg.cholesky(root @ root.conj().swapaxes(1, 2))


def test_what_is_free_has_an_infinite_deviation(rotor_of: Machine) -> None:
    table = table_of(rotor_of, ANISOTROPIC, ISOTROPIC)
    dataset = simulate(rotor_of.rotor, table, UNBALANCES)
    root = residual_root(rotor_of.rotor, dataset, table, NoiseModel(0.0, 1e-3).deviation(dataset.displacement))
    equations = fits(replace(rotor_of, bearings=table), dataset, everything(table.nodes), root)
    assert np.isinf(least_squares_deviation(equations)[0]).all()


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


def test_frequencies_go_through_the_files(machine: MachineFactory, tmp_path: Path) -> None:
    """A column of the vibration file; blank and absent mean synchronous."""
    from pipeline.data.excitation_files import write_excitation
    from pipeline.data.vibration_files import read_dataset, write_vibration

    runs = (
        "[{name: a, unbalances: [{node: 2, magnitude: 1e-4}]}, "
        "{name: b, forces: [{node: 4, magnitude: 10}], frequency_hz: 40}]"
    )
    made = machine("experiment=all_coefficients", *FEW, f"machine.runs={runs}")
    vibration, excitation = tmp_path / "v.csv", tmp_path / "e.csv"
    write_vibration(vibration, made.dataset, {"rotor": made.rotor.fingerprint})
    write_excitation(excitation, made.dataset)
    read = read_dataset(vibration, excitation, made.rotor)
    np.testing.assert_allclose(read.frequencies, made.dataset.frequencies, rtol=1e-12)
    text = vibration.read_text().splitlines()
    blank = [",".join([*line.split(",")[:-1], ""]) if line.startswith("a,") else line for line in text]
    vibration.write_text("\n".join(blank) + "\n")
    np.testing.assert_allclose(read_dataset(vibration, excitation, made.rotor).frequencies, read.frequencies, rtol=1e-9)


@pytest.mark.slow
def test_diagnose_writes_its_account(run: Run, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """JSON, a table with a row a bearing and speed, a figure; the verdict. No modelled coefficient is read."""
    chosen = ("experiment=compressor_journal_and_isotropic", "machine.speeds.step_rpm=300")
    run("generate", chosen, tmp_path / "my data")
    (tmp_path / "my data" / "modelled_coefficients.csv").unlink()
    run("diagnose", chosen, tmp_path / "my data")
    said = capsys.readouterr().out
    assert_says(said, "bearing at node 8: not identifiable, because", "bearing at node 21: identifiable")
    account = json.loads((tmp_path / "my data" / "diagnosis.json").read_text())["bearings"]
    assert (account["8"]["rank"], account["8"]["orbit_rank"]) == ({"least": 4, "most": 4}, {"least": 1, "most": 1})
    assert set(account["8"]["median_deviation_percent"].values()) == {None}
    assert account["21"]["verdict"] == "identifiable"
    table = pd.read_csv(tmp_path / "my data" / "diagnosis.csv")
    assert len(table) == 2 * 15
    assert (table.loc[table["bearing_node"] == 8, "rank"] == 4).all()
    assert (tmp_path / "my data" / "figures" / "diagnosis.png").stat().st_size > 20_000


@pytest.mark.slow
def test_training_of_what_is_not_identifiable(run: Run, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """It stops with the sentence, and force=true goes on with the same sentence as a line."""
    chosen = ("experiment=compressor_journal_and_isotropic", "machine.speeds.step_rpm=300")
    with pytest.raises(IdentifiabilityError, match=r"8: not identifiable, because .*rank 1 of 2.*backward.*force=true"):
        run("train", chosen, tmp_path / "x")
    assert not (tmp_path / "x" / "model.json").exists()
    run("train", [*chosen, "force=true", "optimizer.levenberg_marquardt.steps=2"], tmp_path / "x")
    assert "bearing at node 8: not identifiable" in capsys.readouterr().out
    assert (tmp_path / "x" / "model.json").exists()


@pytest.mark.slow
def test_design_beats_the_papers_runs_and_simulations_confirm_it(
    run: Run, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """The worst deviation falls at least 150 times; 200 noisy fits at 0.1 % give the same ratio within 20 %."""
    folder = tmp_path / "my design"
    run("design", ["experiment=all_coefficients"], folder)
    summary = json.loads((folder / "design.json").read_text())
    print(f"gain {summary['gain']:.3g}, in simulations {summary['simulated_gain']:.3g}")
    assert summary["stated_noise"] == {"additive": 0.0, "multiplicative": 0.001, "drift": 0.0, "record": 0.0}
    assert len(summary["runs"]) == len(compose_config(["experiment=all_coefficients"]).machine.runs)
    assert summary["gain"] >= 150
    assert summary["simulated_gain"] == pytest.approx(summary["gain"], rel=0.2)
    assert "machine.runs_file=" in capsys.readouterr().out


@pytest.mark.slow
def test_a_design_can_be_used_at_once(run: Run, tmp_path: Path) -> None:
    """``machine.runs_file`` takes it; a file that holds something else is refused by name."""
    few = ("experiment=all_coefficients", "machine.speeds.step_rpm=500", "design.speeds=5", "design.simulations=0")
    run("design", few, tmp_path / "a")
    file = tmp_path / "a" / "designed_excitation.yaml"
    config = compose_config(["experiment=all_coefficients", f"machine.runs_file='{file}'"])
    assert [run.name for run in config.machine.runs] == json.loads((tmp_path / "a" / "design.json").read_text())["runs"]
    assert config.machine.speeds.step_rpm == 500
    run("generate", ["experiment=all_coefficients", f"machine.runs_file='{file}'"], tmp_path / "b")
    (tmp_path / "c.yaml").write_text("- 1")
    (tmp_path / "e.yaml").write_text(file.read_text() + "rotor: {file: x}\n")
    for name, law in (
        ("c", r"machine\.runs_file must have speeds and runs"),
        ("e", r"nothing else, but '.*e\.yaml' has speeds, runs, rotor"),
        ("absent", r"machine\.runs_file must be speeds and runs such as stage=design writes"),
    ):
        with pytest.raises(ConfigError, match=law):
            compose_config([f"machine.runs_file='{tmp_path / name}.yaml'"])


def test_the_best_set_of_runs_is_found(rng: np.random.Generator) -> None:
    """Greedy exchange against the best of all sets, for random information; both criteria prefer more information."""
    rows = rng.normal(size=(8, 2, 3, 2, 4)) * 10.0 ** rng.uniform(-1, 1, (8, 1, 1, 1, 1))
    information = np.einsum("cmsru,cmsrv->cmsuv", rows, rows)
    present = np.ones((2, 4), dtype=bool)
    for criterion in ("A", "D"):
        sets = list(itertools.combinations(range(8), 3))
        values = [merit(information[list(s)].sum(axis=0), present, criterion) for s in sets]
        found = merit(information[list(choose(information, present, 3, criterion))].sum(axis=0), present, criterion)
        assert found <= np.sort(values)[2]  # an exchange may end at a neighbour of the best
        assert merit(information[:4].sum(axis=0), present, criterion) < merit(
            information[:3].sum(axis=0), present, criterion
        )
