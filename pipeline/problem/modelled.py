"""The configured machine modelled: its bearings, and the vibration that its probes would read.

Legend: S speeds, R runs.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from pipeline.config.schema import Config
from pipeline.data.as_built import build_rotor, misplace_probes, simulate_as_built
from pipeline.data.dataset import Excitation, VibrationDataset, require_synchronous
from pipeline.data.operating_points import group_rows, spread_states
from pipeline.data.sensors import Channels, Sensors, list_directions, measure, name_channel
from pipeline.data.simulate import simulate
from pipeline.problem.known import list_known
from pipeline.rotor.bearing_table import BearingTable
from pipeline.rotor.model import RotorModel
from pipeline.rotor.stored import load_modelled_bearings, load_rotor, require_nodes


def model_machine(config: Config, seed: int | None = None) -> tuple[RotorModel, BearingTable, VibrationDataset]:
    """The configured machine, and its vibration without noise at every node; as it was built, if it says so.

    ``seed`` draws what weights are off by; None for that of the probes.
    """
    speeds, operating = spread_states(config.machine.speeds.rad_s(), config.machine.operating)
    rotor, built = load_rotor(config.machine.rotor), config.machine.as_built
    list_known(config, rotor.bearing_nodes)  # refuses exceptions without a bearing
    bearings = load_modelled_bearings(config.machine.rotor, config.machine.bearings, speeds, operating)
    runs, residual = configure_excitations(config), _configure_residual(config)
    require_nodes(rotor, "machine.runs", [excitation.node for excitation in (*runs, *residual)])
    acting, frequencies = (*runs, *residual), configure_frequencies(config, speeds)
    if built is None:
        complete = simulate(rotor, bearings, acting, frequencies)
        require_synchronous(rotor, complete)
    else:
        require_nodes(rotor, "machine.as_built.coupling_node", [built.coupling_node])
        generator = np.random.default_rng([config.machine.probes.seed if seed is None else seed, 1])
        fine = build_rotor(config.machine.rotor, built)
        complete = simulate_as_built(fine, built, bearings, acting, frequencies, generator)
    # The residual unbalance is in the vibration and nobody knows of it.
    return rotor, bearings, replace(complete, excitations=runs)


def read_probes(
    config: Config, rotor: RotorModel, complete: VibrationDataset, seed: int | None = None
) -> VibrationDataset:
    """What the probes make of a vibration with x and y at every node; ``seed`` as :func:`model_machine`."""
    probes, built = configure_sensors(config, rotor), config.machine.as_built
    seed = config.machine.probes.seed if seed is None else seed
    if built is not None and probes.channels is not None:
        complete = misplace_probes(complete, built, probes.channels, np.random.default_rng([seed, 2]))
        probes = replace(probes, channels=None)
    return measure(complete, probes, np.random.default_rng(seed))


def find_idle(bearings: BearingTable) -> list[str]:
    """The operating conditions that take several values and change no coefficient."""
    idle = []
    for name, values in bearings.operating.items():
        others = [bearings.speeds, *(levels for other, levels in bearings.operating.items() if other != name)]
        changes = any(np.ptp(bearings.values[:, rows], axis=1).any() for rows in group_rows(np.stack(others, axis=1)))
        if np.ptp(values) > 0 and not changes:
            idle.append(name)
    return idle


def configure_excitations(config: Config) -> tuple[Excitation, ...]:
    """The configured runs."""
    acting: list[Excitation] = []
    for run in config.machine.runs:
        acting += [
            Excitation(run.name, "unbalance", unbalance.node, unbalance.magnitude, unbalance.phase)
            for unbalance in run.unbalances
        ]
        acting += [
            Excitation(run.name, "force", force.node, force.magnitude, force.phase, force.whirl) for force in run.forces
        ]
    return tuple(acting)


def _configure_residual(config: Config) -> tuple[Excitation, ...]:
    """The configured residual unbalance, in every run that turns with the rotor."""
    turning = [run for run in config.machine.runs if not run.frequency_hz and not run.frequency_ratio]
    return tuple(
        Excitation(run.name, "unbalance", weight.node, weight.magnitude, weight.phase)
        for run in turning
        for weight in config.machine.residual_unbalance
    )


def configure_sensors(config: Config, rotor: RotorModel) -> Sensors:
    """The configured sensors."""
    spec = config.machine.probes
    channels: Channels | None = None
    if spec.at == "bearings":
        channels = list_directions(rotor.bearing_nodes)
    elif spec.at != "all":
        require_nodes(rotor, "machine.probes.at", [probe.node for probe in spec.at])
        channels = tuple(name_channel(probe.node, probe.angle) for probe in spec.at)
    return Sensors(
        channels, spec.additive, spec.multiplicative, spec.runout, spec.quantisation, spec.slow_roll_readings
    )


def configure_frequencies(config: Config, speeds: np.ndarray) -> np.ndarray | None:
    """(S, R) rad/s of the configured runs at ``speeds`` (S,) rad/s; None where all are synchronous."""
    runs = config.machine.runs
    if not any(run.frequency_hz or run.frequency_ratio for run in runs):
        return None
    columns = [
        np.full(len(speeds), 2 * np.pi * run.frequency_hz)
        if run.frequency_hz
        else speeds * (run.frequency_ratio or 1.0)
        for run in runs
    ]
    return np.stack(columns, axis=1)
