"""Vibration of a machine that is not quite its model: a finer mesh, other numbers, weights and probes a little off.

Data from the very matrices of the fit would flatter it (an inverse crime; Kaipio and Somersalo 2007). Runs and channels
keep the node numbers of the model.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import replace
from typing import Any, Literal

import numpy as np
from pydantic import Field, PositiveInt

from pipeline.config.quantities import Mass, PositiveAngle, Stiffness
from pipeline.config.rotor import RotorConfig, ShaftSegmentConfig
from pipeline.config.section import NonNegativeInt, Section, Share, rule
from pipeline.data.dataset import Excitation, VibrationDataset
from pipeline.data.sensors import Channels, project
from pipeline.data.simulate import integrate, simulate
from pipeline.impedance import stand_in_series
from pipeline.parameters.kind import ModelParameter
from pipeline.parameters.model import update_rotor
from pipeline.rotor.bearing_table import BearingTable
from pipeline.rotor.model import RotorModel
from pipeline.rotor.stored import load_rotor


class AsBuiltConfig(Section):
    """The machine that makes the data, where it is not the one that the fit assumes: no identification reads it.

    Its vibration is that of the dynamic stiffness (``frequency``), or of integration in ``time``.

    Numbers of rotor and coupling are what they differ by, as a share where they have no unit. Weights and probes differ
    by normal deviates of the given standard deviations. ``shaft`` takes the place of the model's and has as many
    elements; ``shear_effects`` and ``rotary_inertia`` are those of its beam. A pedestal stands under every bearing and
    moves in x and y alike; the model's bearings stand on rock.
    """

    method: Literal["frequency", "time"] = "frequency"
    refinement: PositiveInt = 1  # elements for each one of the model
    shaft: tuple[ShaftSegmentConfig, ...] | None = None
    shear_effects: bool | None = None
    rotary_inertia: bool | None = None
    youngs_modulus: float = Field(default=0.0, gt=-1)
    density: float = Field(default=0.0, gt=-1)
    disc_mass: float = Field(default=0.0, gt=-1)
    disc_inertia: float = Field(default=0.0, gt=-1)
    coupling_stiffness: Stiffness | None = None
    coupling_mass: Mass | None = None
    coupling_node: NonNegativeInt = 0  # of the model
    pedestal_stiffness: Stiffness | None = None
    pedestal_mass: Mass | None = None
    unbalance_magnitude: Share = 0.0
    unbalance_phase: PositiveAngle | None = None
    probe_gain: Share = 0.0
    probe_angle: PositiveAngle | None = None

    @property
    def beam(self) -> dict[str, Any]:
        """What takes the place of the same keys of the rotor."""
        given = {name: getattr(self, name) for name in ("shaft", "shear_effects", "rotary_inertia")}
        return {name: value for name, value in given.items() if value is not None}

    @rule
    def _stands(self) -> Iterator[str]:
        if self.pedestal_mass and not self.pedestal_stiffness:
            yield "must have a pedestal_stiffness beside pedestal_mass, but it is missing"


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
    at = built.coupling_node * built.refinement
    places = {
        **dict.fromkeys(("youngs_modulus", "density"), (0,)),
        **dict.fromkeys(("disc_mass", "disc_inertia"), model.disc_nodes),
        **dict.fromkeys(("coupling_stiffness", "coupling_mass"), (at,)),
    }
    changes = [
        ModelParameter(kind, getattr(built, kind) or 0.0, "", node, value=1.0)
        for kind, nodes in places.items()
        for node in nodes
    ]
    return update_rotor(model, changes)


def stand_on_pedestals(bearings: BearingTable, built: AsBuiltConfig) -> BearingTable:
    """The bearings as the shaft feels them on pedestals ``h = k - w^2 m``."""
    if not built.pedestal_stiffness:
        return bearings
    pedestal = built.pedestal_stiffness - bearings.speeds**2 * (built.pedestal_mass or 0.0)
    return replace(bearings, values=stand_in_series(bearings.values, bearings.speeds, pedestal))


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
    if built.method == "time":
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
