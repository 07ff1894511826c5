"""Uncertain numbers of the model: derivatives against differences of rotors that ROSS makes, and laws of the fit."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import torch
from scipy.optimize import least_squares
from training import assert_slopes, differences

from pipeline.coefficients import COEFFICIENTS
from pipeline.config.rotor import RotorConfig
from pipeline.data.dataset import Excitation, VibrationDataset
from pipeline.data.sensors import NoiseModel
from pipeline.errors import ConfigError
from pipeline.identification.readings import sensor_model
from pipeline.parameters import ground
from pipeline.parameters.model import KINDS, ModelParameter, model_parameters, update_rotor
from pipeline.problem.baseline import find_baseline
from pipeline.problem.diagnosis import systematic_shifts
from pipeline.problem.measurement import Guess, Measurement
from pipeline.problem.response import derive_by_parameters, impedance_change, respond
from pipeline.rotor.bearing_table import BearingTable
from pipeline.rotor.model import RotorModel
from pipeline.rotor.stored import load_rotor
from pipeline.unknowns import tie, unknown_set

MATERIAL = {"density": 7810.0, "youngs_modulus": 211e9, "shear_modulus": 81.2e9}
DEVIATIONS = {
    "youngs_modulus": 0.02,
    "density": 0.01,
    "disc_mass": 0.01,
    "disc_inertia": 0.05,
    "coupling_stiffness": 1e5,
    "coupling_mass": 0.5,
    "unbalance_magnitude": 0.02,
    "unbalance_phase": 0.035,
    "probe_gain": 0.01,
    "probe_angle": 0.035,
    "probe_position": 0.003,
    "runout": 2e-7,
    "known_coefficients": 0.05,
    "bearing_position": 0.02,
    "bow": 1e-5,
    "weight_angle": 0.2,
    "weight_law": 400.0,
    "weight_gain": 0.3,
    "label_gain": 0.1,
    "label_angle": 0.1,
    "bearing_drift": 0.02,
    "added_mass": 2.0,
}


def rotor(**material: float) -> RotorModel:
    """A shaft with a disc between its bearings and an overhung one."""
    shaft = [{"length": 1.2, "outer_diameter": 0.05, "inner_diameter": 0.0, "elements": 8}]
    discs = [
        {"node": 3, "width": 0.06, "inner_diameter": 0.05, "outer_diameter": 0.26},
        {"node": 8, "mass": 12.0, "diametral_inertia": 0.05, "polar_inertia": 0.09},
    ]
    config = {"material": MATERIAL | material, "shaft": shaft, "discs": discs, "bearing_nodes": [1, 6]}
    return load_rotor(RotorConfig.model_validate(config | {"shear_effects": True}))


@pytest.fixture(scope="module")
def measurement() -> Measurement:
    """Four probes at 45 degrees, two runs; kxx and kyy are identified."""
    model, speeds = rotor(), np.linspace(60.0, 550.0, 7)
    eight = [2e7, 3e6, -4e6, 1.5e7, 2e4, 1e3, 2e3, 1.5e4]
    known = BearingTable(model.bearing_nodes, speeds, np.tile(eight, (2, len(speeds), 1)))
    channels = tuple((node, angle) for node in model.bearing_nodes for angle in (45.0, 135.0))
    weights = (Excitation("a", "unbalance", 3, 5e-4, 0.3), Excitation("b", "unbalance", 8, 3e-4, 1.0))
    data = VibrationDataset(speeds, ("a", "b"), channels, np.ones((len(speeds), 4, 2), complex) * 1e-5, weights)
    unknowns = unknown_set(dict.fromkeys(model.bearing_nodes, tie(("kxx", "kyy"))), planes=(3,))
    made = Measurement(model, data, known, NoiseModel(1e-7, 0.0), unknowns, Guess(1e7, 1e4))
    parameters = model_parameters(DEVIATIONS, model, data, known, unknowns, coupling_node=0, seal_nodes=(1,))
    return replace(made, parameters=parameters).update(0.3 * np.cos(np.arange(len(parameters))))


_OF_GROUND = tuple(kind.name for kind in ground.KINDS)


def test_every_kind_has_its_parameters(measurement: Measurement) -> None:
    """One for each disc, weight, probe and known coefficient."""
    count = {kind: sum(p.kind == kind for p in measurement.parameters) for kind in KINDS}
    assert count == dict.fromkeys(KINDS, 1) | dict.fromkeys(_OF_GROUND, 0) | {
        "disc_mass": 2,
        "disc_inertia": 2,
        "bearing_position": 2,
        "bow": 4,
        "weight_law": 2,
        "label_gain": 2,
        "label_angle": 2,
        "unbalance_magnitude": 2,
        "unbalance_phase": 2,
        "probe_gain": 4,
        "pickup": 0,
        "pickup_velocity": 0,
        "pickup_displacement": 0,
        "probe_angle": 4,
        "probe_position": 4,
        "runout": 8,
        "known_coefficients": 12,
        "bearing_drift": 4,
        "added_mass": 2,
    }


def readings(measurement: Measurement) -> np.ndarray:
    """(S, P, R) on the known coefficients, with a residual unbalance."""
    return measurement.response.predict(measurement.updated_known, np.array([1e-4 + 2e-5j]))


def test_a_bearing_that_drifts_is_another_one_in_that_run(measurement: Measurement) -> None:
    """One deviation at bearing 0 in run b: readings of run a stay, those of b are those of a scaled bearing."""
    at = [(p.kind, p.place, p.detail) for p in measurement.parameters].index(("bearing_drift", 0, "b"))
    alone = replace(measurement, parameters=(replace(measurement.parameters[at], value=0.0),))
    model, none = sensor_model(alone), torch.zeros(1, 0, dtype=torch.float64)
    values = torch.as_tensor(alone.known.values[..., [0, 3]].swapaxes(0, 1).reshape(1, 7, -1))
    (moved,) = model.predict(values, torch.zeros(1, 1, dtype=torch.complex128), none.new_ones(1, 1))
    scaled = alone.known.values * np.array([1.02, 1.0])[:, None, None]
    for run, bearings in ((0, alone.known), (1, replace(alone.known, values=scaled))):
        assert np.allclose(moved[0, ..., run].numpy(), alone.response.predict(bearings)[..., run], rtol=1e-12, atol=0)


def test_a_baseline_is_taken_off_as_its_own_bearings_had_it(measurement: Measurement) -> None:
    """Readings of two runs and a baseline on bearings of their own, by the response itself: its unbalance is found, and
    the differences and their derivatives are those of the rows.
    """
    stated, shown = replace(measurement, parameters=()), np.array([3e-6, 2e-6j, 0.0, 1e-6])
    discs = (Excitation("", "unbalance", 3, 2e-4, 1.1), Excitation("", "unbalance", 8, 5e-5, -2.0))
    scales, read = {"a": (1.02, 1.0), "b": (1.0, 0.98), "": (1.04, 0.96)}, []
    for run, scale in scales.items():
        weights = (*(replace(w, run=run) for w in discs), *(w for w in stated.dataset.excitations if w.run == run))
        data = replace(stated.dataset.of_runs(np.array([0])), runs=(run,), excitations=weights)
        bearings = replace(stated.known, values=stated.known.values * np.array(scale)[:, None, None])
        read.append(replace(stated, dataset=data).response.predict(bearings)[..., 0])
    less, before = np.stack([read[0] - read[2], read[1] - read[2]], axis=-1), read[2] + shown
    data = replace(stated.dataset, displacement=less, subtracted=np.stack([before, before], axis=-1))
    unknowns = replace(stated.unknowns, planes=())
    drifting = model_parameters({"bearing_drift": 0.02}, stated.rotor, data, stated.known, unknowns)
    values = np.array([(scales[parameter.detail][parameter.place] - 1) / 0.02 for parameter in drifting])
    drifted = replace(stated, dataset=data, unknowns=unknowns, parameters=drifting).update(values)
    problem = replace(drifted, as_found=find_baseline(drifted, stated.known, least=1e-12))
    expected = [w.magnitude * np.exp(1j * w.phase) for w in discs]
    np.testing.assert_allclose(np.array(problem.as_found)[[3, 8]], expected, rtol=1e-5)
    model, none = sensor_model(problem), torch.zeros(1, 0, dtype=torch.complex128)
    at = (
        torch.as_tensor(stated.known.values[..., [0, 3]].swapaxes(0, 1).reshape(1, 7, -1)),
        torch.as_tensor(values)[None],
    )
    np.testing.assert_allclose(model.predict(at[0], none, at[1])[0][0], less, rtol=1e-7, atol=1e-12)
    readings, by_unknowns, _, by_parameters = model.derive(0, at[0], none, at[1])
    np.testing.assert_allclose(readings[0], less, rtol=1e-7, atol=1e-12)
    for slopes, place, size in ((by_unknowns, 0, 1e2), (by_parameters, 4, 1e-4), (by_parameters, 5, 1e-4)):
        unit = size * torch.nn.functional.one_hot(torch.tensor(place), slopes.shape[-1])
        move = (unit, 0) if slopes is by_unknowns else (0, unit)
        ahead, behind = (model.predict(at[0] + s * move[0], none, at[1] + s * move[1])[0][0] for s in (1, -1))
        difference = (ahead - behind) / (2 * size)
        assert (slopes[0, ..., place] - difference).abs().max() <= 1e-6 * difference.abs().max()


def test_derivatives_are_those_of_differences(measurement: Measurement) -> None:
    """Central differences of the whole response, at parameters that are not those stated."""
    (block,), (variation,) = measurement.response.blocks, measurement.variations
    change = impedance_change(
        measurement.updated_known.values.swapaxes(0, 1), block.frequencies, measurement.response.reference
    )
    unbalance = np.array([1e-4 + 2e-5j])
    found = derive_by_parameters(
        variation, respond(block, change[None], unbalance[None]), change[None], unbalance[None]
    )
    assert np.allclose(respond(block, change, unbalance).sensors, readings(measurement))
    wanted = differences(lambda at: readings(measurement.update(at)), measurement.parameter_values, 1e-3)
    rest = np.array([parameter.kind != "known_coefficients" for parameter in measurement.parameters])  # by the bearings
    assert_slopes(found[0][..., rest], wanted[..., rest], 1e-6)
    assert measurement.response.sensitivity(measurement.updated_known).shape[-1] == len(COEFFICIENTS)


@pytest.mark.parametrize(
    ("kind", "other"),
    [
        ("youngs_modulus", {"youngs_modulus": 211e9 * 1.02, "shear_modulus": 81.2e9 * 1.02}),
        ("density", {"density": 7810.0 * 1.01}),
    ],
)
def test_the_updated_rotor_is_the_one_that_ross_makes(kind: str, other: dict[str, float]) -> None:
    """A rotor of another material. A disc from geometry has the new density, too, so the shafts are compared."""
    stated, made = rotor(), rotor(**other)
    moved = update_rotor(stated, [ModelParameter(kind, DEVIATIONS[kind], "", value=1.0)])
    assert np.allclose(moved.stiffness, made.stiffness, rtol=1e-12, atol=0)
    assert np.allclose(moved.mass - stated.mass, made.shaft_mass - stated.shaft_mass, rtol=1e-9, atol=1e-12)


@pytest.mark.parametrize("kind", ["known_coefficients", "disc_mass", "unbalance_phase"])
def test_a_parameter_that_the_machine_lacks_is_refused(kind: str, measurement: Measurement) -> None:
    """No disc, no weight, nothing known."""
    bare = replace(measurement.rotor, disc_nodes=())
    unknowns = unknown_set(dict.fromkeys(bare.bearing_nodes, tie(COEFFICIENTS)))
    data = replace(measurement.dataset, excitations=(Excitation("a", "force", 3, 1.0, 0.0),))
    with pytest.raises(ConfigError, match=f"{kind} must belong to something that the machine has"):
        model_parameters({kind: 0.1}, bare, data, measurement.known, unknowns)


@pytest.mark.parametrize(
    ("kind", "deviation", "law"),
    [
        ("bearing_position", 0.4, "on the shaft, whose end is 150 mm from it, but got 400 mm"),
        ("probe_position", 1.3, "on the shaft, whose end is 1050 mm from it, but got 1300 mm"),
    ],
)
def test_what_leaves_the_shaft_is_refused(kind: str, deviation: float, law: str, measurement: Measurement) -> None:
    """The bearing at node 1 has 150 mm to the end; a probe may go either way."""
    with pytest.raises(ConfigError, match=law):
        model_parameters(
            {kind: deviation}, measurement.rotor, measurement.dataset, measurement.known, measurement.unknowns
        )


def test_a_bow_that_a_baseline_took_off_is_refused(measurement: Measurement) -> None:
    """As a runout is: what is the same in all runs cancels."""
    less = replace(measurement.dataset, subtracted=np.zeros_like(measurement.dataset.displacement))
    with pytest.raises(ConfigError, match=r"bow must belong to .* no baseline was subtracted from"):
        model_parameters({"bow": 1e-5}, measurement.rotor, less, measurement.known, measurement.unknowns)


def test_the_budget_is_what_least_squares_makes_of_a_wrong_model(measurement: Measurement) -> None:
    """SciPy's least squares at each speed by itself, of readings from a model that is a little other than stated."""

    stated = measurement.update(np.zeros(len(measurement.parameters)))
    shifts = systematic_shifts(stated, stated.known)
    for t in (0, 3, 8, 14, len(stated.parameters) - 1):
        moved = stated.update(1e-3 * (np.arange(len(stated.parameters)) == t))
        readings = moved.response.predict(moved.updated_known)
        for s in (0, 3, 6):
            found = answer_at_one_speed(stated.select(np.array([s])), readings[[s]]) / 1e-3
            assert found == pytest.approx(shifts[s, :, t], rel=0.02, abs=1e-3 * np.abs(shifts[s]).max())


def answer_at_one_speed(one: Measurement, readings: np.ndarray) -> np.ndarray:
    """(A,) change of the unknowns that explains the readings best."""
    truth = one.unknowns.leading(one.known.values)  # (M, 1, U)

    def rows(shift: np.ndarray) -> np.ndarray:
        values = truth + one.unknowns.from_active(shift[None] * 1e4)
        off = (one.response.predict(one.table(values)) - readings) / one.deviation
        return np.concatenate([off.real.ravel(), off.imag.ravel()])

    start = np.zeros(len(one.unknowns.active))
    return np.asarray(least_squares(rows, start, xtol=1e-15, ftol=1e-15, gtol=1e-15).x * 1e4)
