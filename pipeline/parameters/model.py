"""Uncertain numbers of the machine's model.

An engineer knows the shaft, the discs, the weights and the probes to a tolerance only. Each such number is a parameter
``theta`` in units of its prior standard deviation: its prior is normal with mean 0 and variance 1, and theta = 0 is
what the configuration states. The dynamic stiffness is linear in the parameters of the rotor,

    D(w, theta) = D(w) + sum_t theta_t dD_t(w),

so the sensitivity of the structure is exact: it comes from the matrices of its parts, not from differences.
Supports are known to an order of magnitude: theta is the logarithm of each of their numbers over what is stated.

Legend: T parameters. SI units and radians.
"""

from __future__ import annotations

from collections.abc import Collection, Mapping, Sequence
from dataclasses import astuple, replace
from typing import Any

import numpy as np

from pipeline.data.dataset import VibrationDataset
from pipeline.errors import ConfigError
from pipeline.parameters import bearings, geometry, ground, probes, shaft, weights
from pipeline.parameters.kind import Kind, Machine, ModelParameter
from pipeline.rotor.bearing_table import BearingTable
from pipeline.rotor.model import NO_SEALS, RotorModel
from pipeline.unknowns import UnknownSet

KINDS: Mapping[str, Kind] = {
    kind.name: kind for group in (shaft, ground, geometry, weights, probes, bearings) for kind in group.KINDS
}
"""Every kind by its name."""
USUAL = {name: kind.usual for name, kind in KINDS.items() if kind.usual and kind.widens}
"""Standard deviations of what is never known exactly, where the configuration states none: steel varies by 1 %, a trial
weight and its place are off by 2 % and 2 degrees (docs/noise.md), the scale of a proximity probe by 5 % at most
(API 670)."""
ALWAYS_FITTED = USUAL | {name: kind.usual for name, kind in KINDS.items() if kind.usual}
"""As :data:`USUAL`, for models that fit their tolerances: discs are known to 2 %, their inertias to 3 %, and a bearing
is in each run as it is on average to 2 % (oil temperature, alignment, amplitude); so it is in the baseline. A free end
of the shaft may have a coupling that nobody stated. Probes are 3 mm off. Where no baseline is subtracted, 1 um of
runout is left over."""


def set_values(
    parameters: Sequence[ModelParameter], values: Sequence[float] | np.ndarray
) -> tuple[ModelParameter, ...]:
    """The parameters at other ``values`` (T,), in prior deviations."""
    return tuple(replace(parameter, value=float(v)) for parameter, v in zip(parameters, values, strict=True))


def model_parameters(
    deviations: Mapping[str, float],
    rotor: RotorModel,
    dataset: VibrationDataset,
    known: BearingTable,
    unknowns: UnknownSet,
    coupling_node: int | None = None,
    seal_nodes: Collection[int] = (),
) -> tuple[ModelParameter, ...]:
    """The parameters of a machine: one for each disc, weight, probe and known coefficient.

    ``deviations`` has prior standard deviations by kind. Raises ConfigError for a kind that the machine does not have.
    """
    machine, parameters = Machine(rotor, dataset, known, unknowns, coupling_node, seal_nodes), list[ModelParameter]()
    for name, deviation in deviations.items():
        kind_parameters = _make(name, deviation, machine)
        for parameter in kind_parameters:
            KINDS[name].require(parameter, machine)
        if not kind_parameters:
            raise ConfigError(
                f"identify.model_parameters.{name} must belong to something that the machine has, but it has "
                f"{KINDS[name].missing}: leave it out"
            )
        parameters += kind_parameters
    return tuple(parameters)


def usual_tolerances(
    stated: Collection[str],
    rotor: RotorModel,
    dataset: VibrationDataset,
    known: BearingTable,
    unknowns: UnknownSet,
    usual: Mapping[str, float] = USUAL,
) -> tuple[ModelParameter, ...]:
    """The ``usual`` numbers that the machine has and whose kinds are not ``stated``."""
    machine = Machine(rotor, dataset, known, unknowns)
    return tuple(
        parameter for name, size in usual.items() if name not in stated for parameter in _make(name, size, machine)
    )


def _make(name: str, deviation: float, machine: Machine) -> list[ModelParameter]:
    return [ModelParameter(name, deviation, *astuple(place)) for place in KINDS[name].places(machine)]


def rotor_change(parameter: ModelParameter, rotor: RotorModel) -> RotorModel | None:
    """The rotor's matrices dM, dC, dG, dK of one deviation; None for a parameter that moves none of them."""
    change = parameter.row.rotor(parameter, rotor)
    nothing: dict[str, Any] = dict.fromkeys(_MATRICES, np.zeros_like(rotor.mass))
    return replace(rotor, **nothing | dict(change), seals=NO_SEALS) if change else None  # none changes the seals


def update_rotor(rotor: RotorModel, parameters: Sequence[ModelParameter]) -> RotorModel:
    """The rotor at the values of the parameters."""
    sums: dict[str, Any] = {name: getattr(rotor, name) for name in _MATRICES}
    for parameter in (p for p in parameters if p.value):
        if parameter.row.move:
            rotor = parameter.row.move(rotor, parameter.place, parameter.shift)
        for name, change in parameter.row.rotor(parameter, rotor).items():
            sums[name] = sums[name] + parameter.step * change
    return replace(rotor, **sums)


_MATRICES = ("mass", "damping", "gyroscopic", "stiffness")
