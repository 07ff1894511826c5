"""Vibration of a machine that is not quite its model: a finer mesh, other numbers, weights and probes a little off.

Data from the very matrices of the fit would flatter it (an inverse crime; Kaipio and Somersalo 2007). Runs and channels
keep the node numbers of the model.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from pipeline.config.as_built import AsBuiltConfig
from pipeline.config.rotor import RotorConfig
from pipeline.data.dataset import Excitation, VibrationDataset
from pipeline.data.sensors import Channels, project
from pipeline.data.simulate import simulate
from pipeline.data.time_integration import integrate
from pipeline.rotor.bearing_table import BearingTable
from pipeline.rotor.model import RotorModel
from pipeline.rotor.parameters import OF_COUPLING, OF_DISC, OF_SHAFT, ModelParameter, update_rotor
from pipeline.rotor.stored import load_rotor


def build_rotor(rotor: RotorConfig, built: AsBuiltConfig) -> RotorModel:
    """The rotor as it was built, with ``refinement`` elements for each of the model.

    Raises ConfigError where the rotor file can't be read.
    """
    n, fine = built.refinement, rotor.model_copy(update=built.beam)
    if n > 1:
        fine = fine.model_copy(
            update={
                "shaft": tuple(section.model_copy(update={"elements": n * section.elements}) for section in fine.shaft),
                "discs": tuple(disc.model_copy(update={"node": n * disc.node}) for disc in rotor.discs),
                "bearing_nodes": tuple(n * node for node in rotor.bearing_nodes),
            }
        )
    model = load_rotor(fine)
    changes = [ModelParameter(kind, getattr(built, kind), "") for kind in OF_SHAFT]
    changes += [ModelParameter(kind, getattr(built, kind), "", node) for kind in OF_DISC for node in model.disc_nodes]
    at = built.coupling_node * built.refinement
    changes += [ModelParameter(kind, getattr(built, kind) or 0.0, "", at) for kind in OF_COUPLING]
    return update_rotor(model, changes, np.ones(len(changes)))


def stand_on_pedestals(bearings: BearingTable, built: AsBuiltConfig) -> BearingTable:
    """The bearings as the shaft feels them at its own frequency, on pedestals ``h = k - w^2 m``: ``(H^-1 + 1/h)^-1``.

    Film and pedestal are springs in series: no vibration of the shaft tells one from the other.
    """
    if built.pedestal_stiffness is None:
        return bearings
    film, w = bearings.impedance(), bearings.speeds[:, None, None]
    pedestal = (built.pedestal_stiffness - w**2 * (built.pedestal_mass or 0.0)) * np.eye(2)
    felt = pedestal @ np.linalg.solve(pedestal + film, film)
    parts = [felt.real.reshape(*felt.shape[:2], 4), (felt.imag / w).reshape(*felt.shape[:2], 4)]
    return replace(bearings, values=np.concatenate(parts, axis=-1))


def simulate_as_built(
    rotor: RotorModel,
    built: AsBuiltConfig,
    bearings: BearingTable,
    excitations: Sequence[Excitation],
    own_frequencies: np.ndarray | None,
    generator: np.random.Generator,
) -> VibrationDataset:
    """As :func:`pipeline.data.simulate.simulate`, x and y at every node of the model, without noise.

    ``rotor`` is that of :func:`build_rotor`; ``bearings`` and ``excitations`` have the nodes of the model.
    """
    n, angle = built.refinement, built.unbalance_phase or 0.0
    acting = list(refine_nodes(excitations, built))
    for i, weight in enumerate(acting):
        if weight.kind == "unbalance":
            size, turn = generator.standard_normal(2)
            magnitude = weight.magnitude * (1 + built.unbalance_magnitude * size)
            acting[i] = replace(weight, magnitude=magnitude, phase=weight.phase + angle * turn)
    felt = stand_on_pedestals(bearings, built)
    if built.in_time:
        simulated = integrate(rotor, felt, tuple(acting))
    else:
        simulated = simulate(rotor, felt, tuple(acting), own_frequencies)
    keep = [p for p, (node, _) in enumerate(simulated.channels) if node % n == 0]
    channels = tuple((simulated.channels[p][0] // n, simulated.channels[p][1]) for p in keep)
    return replace(
        simulated, channels=channels, displacement=simulated.displacement[:, keep], excitations=tuple(excitations)
    )


def refine_nodes(excitations: Sequence[Excitation], built: AsBuiltConfig) -> tuple[Excitation, ...]:
    """The same, at the nodes of the rotor as it was built."""
    return tuple(replace(excitation, node=built.refinement * excitation.node) for excitation in excitations)


def misplace_probes(
    dataset: VibrationDataset, built: AsBuiltConfig, channels: Channels, generator: np.random.Generator
) -> VibrationDataset:
    """What probes of the wrong gain and angle show along the ``channels``, of x and y at their nodes."""
    gain, turn = generator.standard_normal((2, len(channels)))
    turned = tuple(
        (node, angle + np.degrees((built.probe_angle or 0.0) * t))
        for (node, angle), t in zip(channels, turn, strict=True)
    )
    seen = project(dataset, turned)
    return replace(seen, channels=channels, displacement=seen.displacement * (1 + built.probe_gain * gain)[:, None])
