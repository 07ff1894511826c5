"""Machines that are not built as modelled: what is refused, what is read of them, and what only the generator knows."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import scipy.linalg
from conftest import refused

from pipeline.config.compose import compose_config
from pipeline.config.schema import Config
from pipeline.data.dataset import assemble_forces, subtract_baseline
from pipeline.data.sensors import list_directions, project
from pipeline.errors import ConfigError
from pipeline.problem.configured import (
    build_measurement,
    configure_sensors,
    model_machine,
    read_probes,
)
from pipeline.rotor.model import bearing_dof
from pipeline.rotor.stored import load_rotor

SMALL = [
    "experiment=realistic",
    "machine.speeds={start_rpm: 600, stop_rpm: 5400, step_rpm: 480}",
    "identify.unknowns=[kxx,kyy]",
    "model.width=4",
]


def small(*overrides: str) -> Config:
    """The configuration of a machine with few speeds and a small network."""
    return compose_config(["stage=train", *SMALL, *overrides])


@pytest.mark.parametrize(
    ("overrides", "words"),
    [
        (["identify.model_parameters.youngs_modulus=0"], "youngs_modulus: must be greater than 0"),
        (["identify.model_parameters.density=1.5"], "density: must be less than 1"),
        (["identify.model_parameters.unbalance_phase=2 mm"], "must convert to rad"),
        (["loss=residual"], "identify.model_parameters must come with loss=response"),
        (["identify.model_parameters.stiffness=0.1"], "has no 'stiffness'"),
        (["machine.bearings.nodess=3"], "did you mean 'nodes'"),
        (["machine.speeds.start_rpm=0"], "must be above zero where a run turns with the rotor"),
        (["+machine.as_built.pedestal_mass=20 kg"], "must have a pedestal_stiffness beside pedestal_mass"),
        (["+machine.as_built.shaft=[{length: 1 m, outer_diameter: 50 mm, elements: 3}]"], "have the 8 elements"),
        (["+machine.as_built.method=time", "+machine.runs.3.frequency_ratio=0.5"], "turn with the rotor"),
        (["+machine.as_built.pedestal_stiffness=1e8", "+machine.runs.3.frequency_ratio=0.5"], "turn with the rotor"),
    ],
)
def test_a_wrong_tolerance_is_refused(overrides: list[str], words: str) -> None:
    """The key, what came, and no traceback; also where nodes are keys of the same machine."""
    with refused(words, kind=ConfigError):
        small(*overrides)


@pytest.mark.parametrize(
    ("overrides", "words"),
    [
        (["identify.coupling_node=6"], "identify.coupling_node must be a node without a bearing"),
        (["identify.coupling_node=99"], "identify.coupling_node must be one of the nodes 0 to 8"),
        (["machine.rotor.discs=[]"], "identify.model_parameters.disc_mass must belong to something"),
    ],
)
def test_a_parameter_of_nothing_is_refused(overrides: list[str], words: str) -> None:
    """What the machine does not have can't be uncertain."""
    config = small(*overrides)
    rotor, truth, complete = model_machine(config)
    with pytest.raises(ConfigError, match=words):
        build_measurement(config, rotor, read_probes(config, rotor, complete), truth)


def test_a_baseline_leaves_no_runout_to_fit() -> None:
    """It is in both runs, and cancels."""
    config = small()
    rotor, truth, complete = model_machine(config)
    dataset = subtract_baseline(read_probes(config, rotor, complete), "both")
    with pytest.raises(ConfigError, match=r"runout must belong to something .* no baseline was subtracted from"):
        build_measurement(config, rotor, dataset, truth)


@pytest.mark.slow
@pytest.mark.parametrize("machine", ["overhung", "overhung_as_built"])
def test_trial_weights_are_those_of_a_balancing(machine: str) -> None:
    """At every speed and in every run readings are well above the noise, and orbits below a third of the clearance."""
    config = compose_config(["stage=train", "experiment=realistic", f"machine={machine}"])
    rotor, _, complete = model_machine(config)
    shown = np.abs(project(complete, configure_sensors(config, rotor).channels).displacement)
    assert np.sqrt((shown**2).mean(axis=1)).min() > 6 * config.stated_noise.additive
    for node, bearing in config.machine.bearings.nodes.items():
        moved = project(complete, list_directions((node,))).displacement  # (S, 2, R)
        orbit = [np.abs(moved[:, 0] + sign * 1j * moved[:, 1]) / 2 for sign in (1, -1)]
        assert bearing.radial_clearance / 6 < sum(orbit).max() < bearing.radial_clearance / 3


def test_what_was_built_is_not_what_is_assumed() -> None:
    """The measurement has the stated rotor and weights; the readings are those of another machine."""
    stated = small("machine=overhung")
    readings = []
    for one in (small(), stated):
        rotor, truth, complete = model_machine(one)
        measurement = build_measurement(one, rotor, read_probes(one, rotor, complete), truth)
        assert measurement.rotor.fingerprint == load_rotor(stated.machine.rotor).fingerprint
        assert measurement.dataset.excitations == replace(complete).excitations
        readings.append(measurement.dataset.displacement)
    assert np.abs(readings[0] / readings[1] - 1).max() > 0.15


def test_a_finer_mesh_of_the_same_shaft_is_nearly_the_same_machine() -> None:
    """Readings of three elements for one agree to the error of the mesh, and not to the last digit."""
    built = (["+machine.as_built={refinement: 3}"], [])
    fine, coarse = (model_machine(small("machine=overhung", *more))[2] for more in built)
    assert fine.channels == coarse.channels
    assert 1e-5 < np.abs(fine.displacement - coarse.displacement).max() / np.abs(coarse.displacement).max() < 1e-4


@pytest.mark.parametrize(
    ("built", "least", "most"),
    [
        ("shear_effects: false", 0.005, 0.1),  # Euler and Bernoulli's beam beside Timoshenko's
        ("rotary_inertia: false", 1e-4, 0.02),
        ("shaft: [{length: 1200 mm, outer_diameter: 50 mm, end_diameter: 49.5 mm, elements: 8}]", 0.01, 0.3),
        ("pedestal_stiffness: 2e8 N/m, pedestal_mass: 20 kg", 0.01, 0.3),
    ],
)
def test_another_beam_and_a_soft_pedestal_move_the_readings(built: str, least: float, most: float) -> None:
    """By far more than the mesh, and the machine is still nearly the same."""
    other, same = (
        project(model_machine(small("machine=overhung", *more))[2], ((1, 0.0), (6, 0.0))).displacement
        for more in ([f"+machine.as_built={{{built}}}"], [])
    )
    assert least < np.linalg.norm(other - same) / np.linalg.norm(same) < most


def test_integration_in_time_gives_what_the_dynamic_stiffness_gives() -> None:
    """Within a thousandth of the largest reading, at a critical speed too: the error is that of the step."""
    near = [
        "experiment=realistic",
        "machine=overhung",
        "machine.speeds={start_rpm: 900, stop_rpm: 5700, step_rpm: 800}",
    ]
    in_time, stated = (
        model_machine(compose_config(["stage=train", *near, *more]))[2]
        for more in (["+machine.as_built={method: time}"], [])
    )
    assert in_time.channels == stated.channels
    off = np.abs(in_time.displacement - stated.displacement).max(axis=(1, 2))
    share = off / np.abs(stated.displacement).max(axis=(1, 2))
    assert (share > 1e-9).all()  # it is no copy
    assert share.max() < 1e-3


def test_bearing_and_pedestal_are_springs_in_series() -> None:
    """Against the response of a rotor whose pedestals have equations of their own."""
    pedestal = "+machine.as_built={pedestal_stiffness: 2e8, pedestal_mass: 20}"
    rotor, film, complete = model_machine(small("machine=overhung", pedestal))
    n, places, own = rotor.n_dof, bearing_dof(rotor).ravel(), rotor.n_dof + np.arange(4)
    for s in (0, 5, -1):
        w = film.speeds[s]
        joined = np.zeros((n + 4, n + 4), dtype=complex)
        joined[:n, :n] = rotor.stiffness - w**2 * rotor.mass + 1j * w * (rotor.damping + w * rotor.gyroscopic)
        joined[n:, n:] = (2e8 - w**2 * 20) * np.eye(4)
        coupling = scipy.linalg.block_diag(*film.impedance()[:, s])
        for first, second, sign in ((places, places, 1), (places, own, -1), (own, places, -1), (own, own, 1)):
            joined[np.ix_(first, second)] += sign * coupling
        force = np.zeros((n + 4, len(complete.runs)), dtype=complex)
        force[:n] = assemble_forces(rotor, complete.excitations, complete.runs, film.speeds[[s]])[0]
        expected = np.linalg.solve(joined, force)[np.arange(n).reshape(-1, 4)[:, :2].ravel()]
        assert complete.displacement[s] == pytest.approx(expected, rel=1e-9, abs=1e-15)
