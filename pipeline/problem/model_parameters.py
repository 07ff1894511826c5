"""Which uncertain numbers a measurement has, and what those of weights, probes and bearings change.

See :mod:`pipeline.rotor.parameters` for what a parameter is, and for those of the rotor.

Legend: T parameters, S speeds, P channels, R runs, B bearings, n lateral DOF. SI units and radians.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import replace

import numpy as np

from pipeline.coefficients import COEFFICIENTS
from pipeline.data.dataset import (
    Excitation,
    VibrationDataset,
    assemble_forces,
    name_direction,
    project_direction,
    synchronous,
)
from pipeline.errors import ConfigError
from pipeline.rotor.bearing_table import BearingTable
from pipeline.rotor.model import RotorModel, translation_dof
from pipeline.rotor.parameters import OF_COUPLING, OF_DISC, OF_PROBE, OF_SHAFT, OF_WEIGHT, ModelParameter
from pipeline.unknowns import UnknownSet


def model_parameters(
    deviations: Mapping[str, float],
    rotor: RotorModel,
    dataset: VibrationDataset,
    known: BearingTable,
    unknowns: UnknownSet,
    coupling_node: int = 0,
) -> tuple[ModelParameter, ...]:
    """The parameters of a machine: one for each disc, weight, probe and known coefficient.

    ``deviations`` has prior standard deviations by kind. Raises ConfigError for a kind that the machine does not have.
    """
    found: list[ModelParameter] = []
    for kind, deviation in deviations.items():
        own = [ModelParameter(kind, deviation, *place) for place in _places(kind, rotor, dataset, known, unknowns)]
        if kind in OF_COUPLING:
            if not coupling_node < rotor.n_nodes:
                raise ConfigError(
                    f"identify.coupling_node must be one of the nodes 0 to {rotor.n_nodes - 1} of the rotor, but got "
                    f"{coupling_node}"
                )
            if coupling_node in rotor.bearing_nodes:
                raise ConfigError(
                    "identify.coupling_node must be a node without a bearing, since no vibration tells a coupling from "
                    f"the bearing beside it, but got the bearing node {coupling_node}"
                )
            own = [ModelParameter(kind, deviation, f"node {coupling_node}", coupling_node)]
        if not own:
            raise ConfigError(
                f"identify.model_parameters.{kind} must belong to something that the machine has, but it has "
                f"{_MISSING[kind]}: leave it out"
            )
        found += own
    return tuple(found)


_MISSING = {
    **dict.fromkeys(OF_DISC, "no disc"),
    **dict.fromkeys(OF_WEIGHT, "no run with an unbalance"),
    "known_coefficients": "no known coefficient other than zero",
    "runout": "no run that turns with the rotor and that no baseline was subtracted from",
}


def _places(
    kind: str, rotor: RotorModel, dataset: VibrationDataset, known: BearingTable, unknowns: UnknownSet
) -> Iterator[tuple[str, int, str]]:
    """(label, place, detail) of what ``kind`` belongs to."""
    if kind in OF_SHAFT:
        yield "", 0, ""
    if kind in OF_DISC:
        for node in dict.fromkeys(rotor.disc_nodes):
            yield f"node {node}", node, ""
    if kind in OF_WEIGHT:
        for i, one in _numbered(dataset.excitations):
            if one.kind == "unbalance":
                yield f"{one.run} node {one.node}", i, one.run
    if kind in OF_PROBE:
        for p, (node, angle) in enumerate(dataset.channels):
            yield f"node {node} {name_direction(angle)}", p, ""
    if kind == "runout" and dataset.subtracted is None and turns_with_rotor(dataset).any():
        for p, (node, angle) in enumerate(dataset.channels):
            for part in _PARTS:
                yield f"node {node} {name_direction(angle)} {part}", p, part
    if kind == "known_coefficients":
        for b, c in np.argwhere(~unknowns.identified & known.values.any(axis=1)):
            yield f"{COEFFICIENTS[c]} node {known.nodes[b]}", int(b), COEFFICIENTS[c]


_PARTS = {"real": 1.0, "imaginary": 1j}
"""A runout is constant in the shaft: a vector of each probe, the same at all speeds."""


def turns_with_rotor(dataset: VibrationDataset) -> np.ndarray:
    """(R,) mask of the runs that turn with the rotor."""
    return np.asarray(synchronous(dataset.frequencies, dataset.speeds[:, None]).all(axis=0))


def _numbered(excitations: Sequence[Excitation]) -> Iterator[tuple[int, Excitation]]:
    """Each excitation with its position among those of its run, which selecting runs does not change."""
    seen: dict[str, int] = {}
    for one in excitations:
        seen[one.run] = seen.get(one.run, -1) + 1
        yield seen[one.run], one


# --- weights -------------------------------------------------------------------------------------------


def update_excitations(
    dataset: VibrationDataset, parameters: Sequence[ModelParameter], values: np.ndarray
) -> VibrationDataset:
    """The data set with the weights at parameters ``values`` (T,)."""
    shift = {(p.kind, p.detail, p.place): v * p.deviation for p, v in zip(parameters, values, strict=True)}
    moved = [
        replace(
            one,
            magnitude=one.magnitude * (1 + shift.get(("unbalance_magnitude", one.run, i), 0.0)),
            phase=one.phase + shift.get(("unbalance_phase", one.run, i), 0.0),
        )
        for i, one in _numbered(dataset.excitations)
    ]
    return replace(dataset, excitations=tuple(moved))


def force_change(
    parameter: ModelParameter, rotor: RotorModel, dataset: VibrationDataset, value: float
) -> np.ndarray | None:
    """(S, n, R) derivative of the forces by the parameter, N; None where it moves none.

    ``dataset`` has the weights at the parameters' values, ``value`` is that of this one.
    """
    if parameter.kind not in OF_WEIGHT:
        return None
    own = [e for i, e in _numbered(dataset.excitations) if (e.run, i) == (parameter.detail, parameter.place)]
    if not own:
        return None
    force = assemble_forces(rotor, tuple(own), dataset.runs, dataset.frequencies)
    if parameter.kind == "unbalance_phase":
        return 1j * parameter.deviation * force
    return parameter.deviation / (1 + parameter.deviation * value) * force


# --- probes --------------------------------------------------------------------------------------------


def sensor_matrix(
    dataset: VibrationDataset, n_dof: int, parameters: Sequence[ModelParameter], values: np.ndarray
) -> np.ndarray:
    """(P, n) what each channel shows of the rotor's lateral DOF at parameters ``values`` (T,)."""
    matrix = dataset.sensor_matrix(n_dof)
    for p in {parameter.place for parameter in parameters if parameter.kind in OF_PROBE}:
        matrix[p] = _channel(dataset, p, n_dof, _probe(parameters, values, p))
    return matrix


def sensor_change(
    parameter: ModelParameter,
    dataset: VibrationDataset,
    n_dof: int,
    parameters: Sequence[ModelParameter],
    values: np.ndarray,
) -> np.ndarray | None:
    """(P, n) derivative of :func:`sensor_matrix` by the parameter; None for one that is none of a probe's."""
    if parameter.kind not in OF_PROBE:
        return None
    probe = _probe(parameters, values, parameter.place)
    row = _channel(dataset, parameter.place, n_dof, probe)
    if parameter.kind == "probe_gain":
        row = row / (1 + probe["probe_gain"])
    elif parameter.kind == "probe_angle":  # the derivative of a direction is the direction a quarter turn on
        turned = probe | {"probe_angle": probe["probe_angle"] + np.pi / 2}
        row = _channel(dataset, parameter.place, n_dof, turned)
    else:  # linear in the position
        moved = probe | {"probe_position": probe["probe_position"] + 1.0}
        row = _channel(dataset, parameter.place, n_dof, moved) - row
    change = np.zeros((len(dataset.channels), n_dof))
    change[parameter.place] = parameter.deviation * row
    return change


def runout(parameters: Sequence[ModelParameter], values: np.ndarray, n_channels: int) -> np.ndarray:
    """(P,) m that each channel shows of the shaft's surface at parameters ``values`` (T,)."""
    shown = np.zeros(n_channels, dtype=complex)
    for parameter, value in zip(parameters, values, strict=True):
        if parameter.kind == "runout":
            shown[parameter.place] += value * parameter.deviation * _PARTS[parameter.detail]
    return shown


def _probe(parameters: Sequence[ModelParameter], values: np.ndarray, channel: int) -> dict[str, float]:
    """Shifts of a channel's gain, angle and position along the shaft."""
    own = [
        (p.kind, p.deviation * float(v))
        for p, v in zip(parameters, values, strict=True)
        if p.kind in OF_PROBE and p.place == channel
    ]
    return dict.fromkeys(OF_PROBE, 0.0) | dict(own)


def _channel(dataset: VibrationDataset, channel: int, n_dof: int, probe: Mapping[str, float]) -> np.ndarray:
    """(n,) a channel's row: near its node the shaft runs straight, x' = beta and y' = -alpha."""
    node, angle = dataset.channels[channel]
    cosine, sine = project_direction(angle)
    turned = (cosine + 1j * sine) * np.exp(1j * probe["probe_angle"])
    x, y = np.zeros(n_dof), np.zeros(n_dof)
    first = translation_dof(node, 0)
    x[[first, first + 3]] = 1.0, probe["probe_position"]
    y[[first + 1, first + 2]] = 1.0, -probe["probe_position"]
    return np.asarray((1 + probe["probe_gain"]) * (turned.real * x + turned.imag * y))


def without_probes(parameters: Sequence[ModelParameter]) -> tuple[ModelParameter, ...]:
    """The same with probes that are exact, for what no probe shows."""
    shown = (*OF_PROBE, "runout")
    return tuple(replace(one, deviation=0.0, place=0) if one.kind in shown else one for one in parameters)


# --- known coefficients --------------------------------------------------------------------------------


def known_change(parameters: Sequence[ModelParameter], known: BearingTable) -> np.ndarray:
    """(S, B, 8, T) derivative of the known coefficients by the parameters, N/m and N s/m."""
    result = np.zeros((len(known.speeds), len(known.nodes), len(COEFFICIENTS), len(parameters)))
    for t, parameter in enumerate(parameters):
        if parameter.kind == "known_coefficients":
            c = COEFFICIENTS.index(parameter.detail)
            result[:, parameter.place, c, t] = parameter.deviation * known.values[parameter.place, :, c]
    return result
