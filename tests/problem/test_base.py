"""A base that pedestals share: against a dense closed form of its modes, and what a fit of exact readings gives."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import torch
from running import GROUNDED
from training import assert_slopes, differences

from pipeline.config.rotor import RotorConfig
from pipeline.data.dataset import DIRECTIONS, Excitation
from pipeline.data.sensors import NoiseModel, project
from pipeline.data.simulate import simulate
from pipeline.errors import ConfigError
from pipeline.identification.fit import default_setup, fit
from pipeline.identification.linear_start import start_at
from pipeline.identification.output_error_start import drawn_basis
from pipeline.identification.problem import output_error
from pipeline.identification.readings import sensor_model
from pipeline.parameters.model import model_parameters
from pipeline.problem.measurement import Guess, Measurement
from pipeline.problem.slopes import ReadingSlopes
from pipeline.rotor.bearing_table import BearingTable
from pipeline.rotor.dynamic_stiffness import assemble_systems, banded, solve
from pipeline.rotor.interpolation import bearing_places
from pipeline.rotor.model import RotorModel
from pipeline.rotor.ross_export import export_rotor
from pipeline.rotor.stored import load_rotor
from pipeline.twin.modes import find_modes
from pipeline.unknowns import tie, unknown_set

NODES, SPEEDS = (1, 6), np.linspace(40.0, 500.0, 40)
FILMS = ((2e7, 3e6, -4e6, 1.5e7, 2e4, 1e3, 2e3, 1.5e4), (1e7, 1e6, -2e6, 2.5e7, 1e4, 1e3, 1e3, 0.5e4))
MODES = (
    (22.0, 0.06, ((0.14, 0.03), (0.11, -0.02), (0.05, 0.02))),
    (31.0, 0.09, ((-0.02, 0.16), (0.05, 0.12), (0.0, -0.1))),
    (52.0, 0.05, ((0.10, 0.04), (-0.17, 0.06), (0.1, 0.03))),
)
"""Hz, damping ratio, and x and y of both pedestals and of a third point, 1/sqrt(kg)."""
WEIGHTS = (Excitation("a", "unbalance", 3, 5e-4, 0.3), Excitation("b", "unbalance", 8, 5e-4, 1.3))
DEVIATIONS = {"support_stiffness": 0.3, "support_damping": 0.5, "base_participation": 0.05}


def config(modes: tuple[tuple[float, float, tuple[tuple[float, float], ...]], ...] = MODES) -> RotorConfig:
    """A shaft with a disc between its bearings and an overhung one; the third point is beside the second pedestal."""
    names = ("frequency", "damping_ratio", "participation")
    return RotorConfig.model_validate(
        {
            **GROUNDED,
            "base": {"points": (*NODES, 6), "modes": [dict(zip(names, mode, strict=True)) for mode in modes]},
        }
    )


def films(speeds: np.ndarray = SPEEDS) -> BearingTable:
    """The same at every speed."""
    return BearingTable(NODES, speeds, np.repeat(np.array(FILMS)[:, None], len(speeds), axis=1))


def test_a_shared_base_is_a_border_of_a_band_that_stays_narrow() -> None:
    """Against whole matrices, as they are and transposed; the band is that of supports."""
    rotor, w = load_rotor(config()), SPEEDS[:, None, None]
    mass, damping, stiffness = assemble_systems(rotor, films())
    held, places = bearing_places(rotor).spread(films().impedance()), bearing_places(rotor).dof
    right = np.random.default_rng(4).standard_normal((len(SPEEDS), rotor.n_dof, 3)) + 0j
    for turned in (False, True):
        found = solve(banded(rotor), SPEEDS, SPEEDS, right, held, places, turned)
        whole = stiffness + 1j * w * damping - w**2 * mass
        np.testing.assert_allclose((whole.swapaxes(1, 2) if turned else whole) @ found, right, atol=1e-8)
    assert (banded(rotor).bandwidth, banded(rotor).border) == (11, 4)


def stated() -> RotorModel:
    """The base as it is believed to be: frequencies, damping and participations are off."""
    off = [(0.93 * f, 1.4 * z, tuple((x + 0.01, y - 0.012) for x, y in u)) for f, z, u in MODES]
    return load_rotor(config(tuple(off)))


def measured(planes: tuple[int, ...] = ()) -> Measurement:
    """Exact readings of the shaft at both bearings, of both casings, and of the third point of the base."""
    nodes = (*NODES, 9, 10, 11)
    data = project(
        simulate(load_rotor(config()), films(), WEIGHTS), tuple((n, a) for n in nodes for a in DIRECTIONS.values())
    )
    unknowns = unknown_set(dict.fromkeys(NODES, tie(("kxx", "kyy", "cxx", "cyy"))), planes=planes)
    known = films()
    parameters = model_parameters(DEVIATIONS, stated(), data, known, unknowns)
    return Measurement(stated(), data, known, NoiseModel(1e-13, 1e-8), unknowns, Guess(1e7, 1e4), parameters=parameters)


def dense(w: float) -> tuple[np.ndarray, ...]:
    """M, C, K and the motion of both casings and the third point, of the shaft as ROSS has it with bearings to a base
    whose receptance is a sum of rank one, all degrees of freedom beside each other.
    """
    plain = load_rotor(config().model_copy(update={"base": RotorConfig.model_fields["base"].default}))
    n, count = plain.n_dof, len(MODES)
    mass, damping, stiffness = (np.zeros((n + count, n + count)) for _ in range(3))
    mass[:n, :n], damping[:n, :n], stiffness[:n, :n] = plain.mass, plain.damping + w * plain.gyroscopic, plain.stiffness
    seen = np.zeros((6, n + count))
    for r, (f, z, u) in enumerate(MODES):
        mass[n + r, n + r], stiffness[n + r, n + r] = 1.0, (2 * np.pi * f) ** 2
        damping[n + r, n + r] = 2 * z * 2 * np.pi * f
        seen[:, n + r] = np.ravel(u)
    for b, node in enumerate(NODES):
        feels = -seen[2 * b : 2 * b + 2]
        feels[[0, 1], [4 * node, 4 * node + 1]] += 1.0
        k, c = np.array(FILMS[b]).reshape(2, 2, 2)
        stiffness, damping = stiffness + feels.T @ k @ feels, damping + feels.T @ c @ feels
    return mass, damping, stiffness, seen


def test_the_response_and_the_modes_are_those_of_the_dense_matrices() -> None:
    """Shaft, casings, third point, and the shaft less its casings; natural frequencies and damping, too."""
    rotor, w = load_rotor(config()), float(SPEEDS[17])
    mass, damping, stiffness, seen = dense(w)
    force = np.zeros(len(mass), dtype=complex)
    force[[12, 13]] = w**2 * 5e-4 * np.exp(0.3j) * np.array([1.0, -1.0j])
    moving = np.linalg.solve(stiffness + 1j * w * damping - w**2 * mass, force)
    shaft, casings = moving[[4 * n + d for n in range(9) for d in (0, 1)]], seen @ moving
    expected = np.concatenate([shaft, casings, shaft.reshape(9, 2)[[1, 6, 6]].ravel() - casings])
    read = simulate(rotor, films(), WEIGHTS[:1]).displacement[17, :, 0]
    assert np.abs(read - expected).max() <= 1e-10 * np.abs(expected).max()
    inverse = np.linalg.inv(mass)
    state = np.block([[np.zeros_like(mass), np.eye(len(mass))], [-inverse @ stiffness, -inverse @ damping]])
    modes = find_modes(rotor, films(SPEEDS[[17]])).eigenvalues[0]
    assert (np.abs(np.linalg.eigvals(state) - modes[:, None]).min(axis=1) < 1e-9 * np.abs(modes)).all()
    with pytest.raises(ConfigError, match="hold no modes of a base"):
        export_rotor(config(), (), films())


def test_derivatives_by_the_base_are_those_of_the_rotor_solved_anew() -> None:
    """Central differences of the response itself, by every number."""
    measurement = measured()
    theta = 0.4 * np.cos(1.7 * np.arange(len(measurement.parameters)))
    slopes = ReadingSlopes(measurement.update(theta), films()).by_model * measurement.deviation[..., None]
    wanted = differences(lambda at: measurement.update(at).response.predict(films()), theta, 1e-4)
    assert_slopes(slopes, wanted, 1e-6)


@pytest.mark.slow
@pytest.mark.parametrize("planes", [(), (3, 8)])
def test_a_fit_of_exact_readings_gives_base_and_bearings_back(planes: tuple[int, ...]) -> None:
    """To 1e-6 %: frequencies, damping, participations of all points, and direct coefficients of both bearings. Where
    residual unbalance is unknown, too, the base starts at the modes that the readings show.
    """
    measurement, truth = measured(planes), load_rotor(config())
    found = fit(measurement, default_setup(Guess(1e7, 1e4), constant=True))
    updated = measurement.update(np.array([p.value for p in found.parameters])).updated_rotor
    for name in ("stiffness", "damping"):
        numbers, true = (np.diagonal(getattr(r, name))[[36, 37, 40]] for r in (updated, truth))
        assert numbers == pytest.approx(true, rel=1e-8)
    assert updated.participation == pytest.approx(truth.participation, abs=1e-8 * 0.17)
    assert found.table(films()).values[..., [0, 3, 4, 7]] == pytest.approx(films().values[..., [0, 3, 4, 7]], rel=1e-8)


def test_a_base_that_softens_is_the_dense_one_of_its_force() -> None:
    """Readings at a force of which the logarithm of each mode's stiffness falls by the root, with their derivatives:
    by softening and by stiffness (which is softened, too), against dense matrices.
    """
    rotor, w, fall = load_rotor(config()), float(SPEEDS[17]), 0.08
    data = simulate(rotor, films(), WEIGHTS[:1])
    unknowns = unknown_set(dict.fromkeys(NODES, tie(("kxx",))))
    parameters = model_parameters(DEVIATIONS | {"base_softening": fall}, rotor, data, films(), unknowns)
    made = Measurement(rotor, data, films(), NoiseModel(1e-9, 0.0), unknowns, Guess(1e7, 1e4), parameters=parameters)
    names = [parameter.name for parameter in parameters]
    theta, places = np.zeros(len(names)), [names.index(f"base_softening mode {r + 1}") for r in range(len(MODES))]
    theta[places] = 1.0, 0.4, -0.3
    values = torch.as_tensor(unknowns.to_active(unknowns.leading(films().values)))[None]
    none, at = torch.zeros(1, 0, dtype=torch.complex128), torch.as_tensor(theta)[None]
    read, _, _, slopes = sensor_model(made).derive(0, values, none, at)
    mass, damping, stiffness, _ = dense(w)
    force, root = np.zeros(len(mass), dtype=complex), np.sqrt(w**2 * WEIGHTS[0].magnitude)
    force[[12, 13]] = w**2 * WEIGHTS[0].magnitude * np.exp(0.3j) * np.array([1.0, -1.0j])
    modes = np.arange(len(mass) - len(MODES), len(mass))
    held = np.array([(2 * np.pi * f) ** 2 for f, _, _ in MODES]) * np.exp(-fall * root * theta[places])
    stiffness[modes, modes] += held - [(2 * np.pi * f) ** 2 for f, _, _ in MODES]
    inverse = np.linalg.inv(stiffness + 1j * w * damping - w**2 * mass)
    moving = inverse @ force
    shown = [data.channels.index((node, angle)) for node in NODES for angle in DIRECTIONS.values()]
    rows = [4 * node + d for node in NODES for d in (0, 1)]
    assert read[0, 17, shown, 0].numpy() == pytest.approx(moving[rows], rel=1e-10)
    for r, mode in enumerate(modes):
        by_stiffness = -inverse[np.ix_(rows, [mode])][:, 0] * held[r] * moving[mode]
        for name, share in (("base_softening", -fall * root), ("support_stiffness", DEVIATIONS["support_stiffness"])):
            slope = slopes[0, 17, shown, 0, names.index(f"{name} mode {r + 1}")].numpy()
            assert slope == pytest.approx(share * by_stiffness, rel=1e-9)


@pytest.mark.parametrize(("kind", "order"), [("pickup", 2), ("pickup_velocity", 1), ("pickup_displacement", 0)])
def test_a_pickup_is_constant_in_what_probes_on_casings_measure(kind: str, order: int) -> None:
    """(3 - 4j) 1e-2 m/s^k is that over (j w)^k at one probe in both runs; its derivative is that of one deviation."""
    made = measured()
    parameters = model_parameters({kind: 0.01}, stated(), made.dataset, made.known, made.unknowns)
    plain, theta = replace(made, parameters=parameters), np.zeros(len(parameters))
    theta[[p.place == 6 for p in parameters]] = 3.0, -4.0
    shown = plain.update(theta).response.predict(films()) - plain.response.predict(films())
    expected = np.zeros_like(shown)
    expected[:, 6] = ((0.03 - 0.04j) / (1j * SPEEDS) ** order)[:, None]
    slopes = np.tensordot(theta, plain.variations[0].forced_sensors, 1)
    assert len(parameters) == 2 * 6
    assert shown == pytest.approx(expected, abs=1e-14)
    assert slopes == pytest.approx(expected, abs=1e-14)


def test_a_residual_unbalance_of_which_readings_tell_nothing_is_as_large_as_is_known() -> None:
    """2e-5 kg m in each part, of readings with a metre of noise; with none known the readings alone tell it."""
    made = replace(measured((3, 8)), guess=Guess(1e7, 1e4, within=30.0, unbalance=2e-5), noise=NoiseModel(1.0, 0.0))
    setup = default_setup(made.guess, constant=True)
    problem = output_error(made, drawn_basis(setup, made, made.dataset.points), 1e-3)
    values = np.array(FILMS)[:, None, [0, 3, 4, 7]] * np.ones((1, len(SPEEDS), 1))
    spread = np.diag(problem.covariance(start_at(problem, values))[0])[problem.places.planes]
    assert 1e-3 * np.sqrt(spread) == pytest.approx(2e-5, rel=1e-6)
    free = replace(problem.measurement, guess=Guess(1e7, 1e4, within=30.0))
    assert not output_error(free, problem.basis, 1e-3).prior.information[problem.places.planes].any()
