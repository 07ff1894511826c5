"""Which uncertain numbers a measurement has, and what those of probes and bearings change.

See :mod:`pipeline.rotor.parameters` for what a parameter is and for those of the rotor, and
:mod:`pipeline.problem.force_parameters` for those of weights and of the bow.

Legend: T parameters, S speeds, P channels, R runs, B bearings, n lateral DOF. SI units and radians.
"""

from __future__ import annotations

from collections.abc import Collection, Mapping, Sequence
from dataclasses import replace
from typing import Any

import numpy as np

from pipeline.coefficients import COEFFICIENTS
from pipeline.data.dataset import DIRECTIONS, VibrationDataset, name_direction, project_direction, synchronous
from pipeline.errors import ConfigError
from pipeline.problem.force_parameters import PARTS, number_excitations, size_excitations, write_label
from pipeline.rotor.bearing_table import BearingTable
from pipeline.rotor.interpolation import move_casing, shaft_rows
from pipeline.rotor.model import RotorModel, casing_dof
from pipeline.rotor.parameters import (
    OF_ALL_WEIGHTS,
    OF_COUPLING,
    OF_DISC,
    OF_LABEL,
    OF_PROBE,
    OF_SHAFT,
    OF_SUPPORT,
    OF_WEIGHT,
    ModelParameter,
)
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
    parameters: list[ModelParameter] = []
    places = _list_places(rotor, dataset, known, unknowns)
    for kind, deviation in deviations.items():
        kind_parameters = [ModelParameter(kind, deviation, *place) for place in places.get(kind, ())]
        if kind in (*OF_SUPPORT, "base_softening"):
            matrix = OF_SUPPORT["support_stiffness" if kind == "base_softening" else kind][0]
            held = np.diagonal(getattr(rotor, matrix))[casing_dof(rotor)].ravel()
            # A node of the ground has two coordinates: an odd number of modes leaves one without a parameter.
            kind_parameters = [replace(p, stated=float(n)) for p, n in zip(kind_parameters, held, strict=False)]
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
            kind_parameters = [ModelParameter(kind, deviation, f"node {coupling_node}", coupling_node)]
        if kind in _ALONG_SHAFT:
            _require_on_shaft(kind_parameters, rotor, dataset)
        if not kind_parameters:
            raise ConfigError(
                f"identify.model_parameters.{kind} must belong to something that the machine has, but it has "
                f"{_MISSING[kind]}: leave it out"
            )
        parameters += kind_parameters
    return tuple(parameters)


def set_values(
    parameters: Sequence[ModelParameter], values: Sequence[float] | np.ndarray
) -> tuple[ModelParameter, ...]:
    """The parameters at other ``values`` (T,), in prior deviations."""
    return tuple(replace(parameter, value=float(v)) for parameter, v in zip(parameters, values, strict=True))


USUAL = {
    "youngs_modulus": 0.01,
    "density": 0.005,
    "unbalance_magnitude": 0.02,
    "unbalance_phase": np.pi / 90,
    "probe_gain": 0.02,
    "probe_angle": np.pi / 180,
}
"""Standard deviations of what is never known exactly, where the configuration states none: steel varies by 1 %, a trial
weight and its place are off by 2 % and 2 degrees (docs/noise.md), the scale of a proximity probe by 5 % at most
(API 670)."""


ALWAYS_FITTED = USUAL | {"disc_mass": 0.02, "bearing_drift": 0.02}
"""As :data:`USUAL`, for models that fit their tolerances: discs are known to 2 %, and a bearing is in each run as it is
on average to 2 % (oil temperature, alignment, amplitude); so it is in the baseline."""
BASELINE = ""
"""The run of a bearing's drift in the baseline that was taken off the others."""


def usual_tolerances(
    stated: Collection[str],
    rotor: RotorModel,
    dataset: VibrationDataset,
    known: BearingTable,
    unknowns: UnknownSet,
    usual: Mapping[str, float] = USUAL,
) -> tuple[ModelParameter, ...]:
    """The ``usual`` numbers that the machine has and whose kinds are not ``stated``."""
    places = _list_places(rotor, dataset, known, unknowns)
    return tuple(
        ModelParameter(kind, deviation, *place)
        for kind, deviation in usual.items()
        if kind not in stated
        for place in places[kind]
    )


_MISSING = {
    **dict.fromkeys(OF_DISC, "no disc"),
    **dict.fromkeys((*OF_WEIGHT, *OF_ALL_WEIGHTS, *OF_LABEL), "no run with an unbalance"),
    **dict.fromkeys(OF_SUPPORT, "no support (machine.rotor.supports) and no base (machine.rotor.base)"),
    "support_mass": "no support (machine.rotor.supports); modes of a base have unit mass by definition",
    **dict.fromkeys(("base_participation", "base_softening"), "no base (machine.rotor.base)"),
    "bearing_position": "bearings on soft ground",
    "known_coefficients": "no known coefficient other than zero",
    "probe_position": "probes on casings alone",
    "runout": "no run that turns with the rotor and that no baseline was subtracted from",
    "bow": "no run that turns with the rotor and that no baseline was subtracted from, or no disc between or beyond "
    "two bearings",
}
_ALONG_SHAFT = ("bearing_position", "probe_position")


def _require_on_shaft(parameters: Sequence[ModelParameter], rotor: RotorModel, dataset: VibrationDataset) -> None:
    """Raise ConfigError where one deviation along the shaft leaves it."""
    first, last = float(rotor.positions[0]), float(rotor.positions[-1])
    for parameter in parameters:
        node = (
            rotor.bearing_nodes[parameter.place]
            if parameter.kind == "bearing_position"
            else dataset.channels[parameter.place][0]
        )
        place = float(rotor.view_positions[node])
        room = (
            max(place - first, last - place) if parameter.kind == "probe_position" else min(place - first, last - place)
        )
        if parameter.deviation > room:
            raise ConfigError(
                f"identify.model_parameters.{parameter.kind} must leave node {node} on the shaft, whose end is "
                f"{1e3 * room:g} mm from it, but got {1e3 * parameter.deviation:g} mm: state less, or "
                "model the shaft's end"
            )


def _list_places(
    rotor: RotorModel, dataset: VibrationDataset, known: BearingTable, unknowns: UnknownSet
) -> dict[str, list[tuple[str, int, str]]]:
    """Kind -> (label, place, detail) of what the machine has of it; a coupling is where the configuration says."""
    everywhere, parts = [("", 0, "")], list(PARTS)
    weights = [
        (f"{weight.run} node {weight.node}", i, weight.run)
        for i, weight in number_excitations(dataset.excitations)
        if weight.kind == "unbalance"
    ]
    labels = dict.fromkeys(write_label(w) for w in dataset.excitations if w.kind == "unbalance" and w.magnitude)
    discs = [(f"node {node}", node, "") for node in dict.fromkeys(rotor.disc_nodes)]
    probes = [(f"node {node} {name_direction(angle)}", p, "") for p, (node, angle) in enumerate(dataset.channels)]
    on_casing = range(rotor.n_nodes, rotor.n_nodes + len(rotor.casings))
    on_shaft = [probe for probe in probes if dataset.channels[probe[1]][0] not in on_casing]
    ground_labels = [f"node {node} {axis}" for node in rotor.casings for axis in DIRECTIONS]
    if rotor.participation.size:
        ground_labels = [f"mode {r + 1}" for r in np.flatnonzero(rotor.participation.any(axis=(0, 1)))]
    ground = [(rotor.n_nodes + c, axis) for c in range(rotor.n_ground) for axis in DIRECTIONS]
    supports = [(label, *place) for label, place in zip(ground_labels, ground, strict=False)]
    shaken = [
        (f"mode {r + 1} at node {rotor.n_nodes + q} {'xy'[d]}", i, "")
        for i, (q, d, r) in enumerate(np.ndindex(rotor.participation.shape))
        if rotor.participation[:, :, r].any()
    ]
    shown = dataset.subtracted is None and turns_with_rotor(dataset).any()
    bent = [(label, node) for label, node, _ in discs if node not in rotor.bearing_nodes]
    free = np.argwhere(~unknowns.identified & known.values.any(axis=1))
    return {
        **dict.fromkeys(OF_SHAFT, everywhere),
        **dict.fromkeys(OF_DISC, discs),
        **dict.fromkeys(OF_WEIGHT, weights),
        **dict.fromkeys(OF_PROBE, probes),
        **dict.fromkeys(OF_SUPPORT, supports),
        "support_mass": [] if shaken else supports,
        "base_participation": shaken,
        "base_softening": supports if shaken else [],
        "bearing_drift": [
            (f"node {node} {run or 'baseline'}", b, run)
            for b, node in enumerate(rotor.bearing_nodes)
            for run in (*dataset.runs, *([] if dataset.subtracted is None else [BASELINE]))
        ],
        "probe_position": on_shaft,
        **dict.fromkeys(("weight_angle", "weight_gain"), everywhere if weights else []),
        **{kind: [(label, 0, label) for label in labels] for kind in OF_LABEL},
        "weight_law": [(component, 0, component) for component in parts if weights],
        "bearing_position": [(f"node {n}", b, "") for b, n in enumerate(rotor.bearing_nodes) if not rotor.casings],
        "bow": [
            (f"{label} {component}", node, component)
            for label, node in bent
            for component in parts
            if shown and len(rotor.bearing_nodes) > 1
        ],
        "runout": [(f"{label} {component}", p, component) for label, p, _ in on_shaft for component in parts if shown],
        "known_coefficients": [(f"{COEFFICIENTS[c]} node {known.nodes[b]}", int(b), COEFFICIENTS[c]) for b, c in free],
    }


def turns_with_rotor(dataset: VibrationDataset) -> np.ndarray:
    """(R,) mask of the runs that turn with the rotor."""
    return np.asarray(synchronous(dataset.frequencies, dataset.speeds[:, None]).all(axis=0))


# --- probes --------------------------------------------------------------------------------------------


def sensor_matrix(dataset: VibrationDataset, rotor: RotorModel, parameters: Sequence[ModelParameter]) -> np.ndarray:
    """(P, n) what each channel shows of the rotor's lateral DOF at the values of the parameters."""
    matrix = dataset.sensor_matrix(rotor)
    for p in {parameter.place for parameter in parameters if parameter.kind in OF_PROBE}:
        matrix[p] = _channel(dataset, p, rotor, _probe(parameters, p))
    return matrix


def sensor_change(
    parameter: ModelParameter, dataset: VibrationDataset, rotor: RotorModel, parameters: Sequence[ModelParameter]
) -> np.ndarray | None:
    """(P, n) derivative of :func:`sensor_matrix` by the parameter; None for one that is none of a probe's."""
    if parameter.kind == "base_participation":  # linear
        shifted = move_casing(rotor, parameter.place, parameter.deviation)
        return np.asarray(sensor_matrix(dataset, shifted, parameters) - sensor_matrix(dataset, rotor, parameters))
    if parameter.kind not in OF_PROBE:
        return None
    probe = _probe(parameters, parameter.place)
    if parameter.kind == "probe_gain":
        row = _channel(dataset, parameter.place, rotor, probe) / (1 + probe["probe_gain"])
    elif parameter.kind == "probe_angle":  # the derivative of a direction is the direction a quarter turn on
        turned = probe | {"probe_angle": probe["probe_angle"] + np.pi / 2}
        row = _channel(dataset, parameter.place, rotor, turned)
    else:
        row = _channel(dataset, parameter.place, rotor, probe, slope=True)
    change = np.zeros((len(dataset.channels), rotor.n_dof))
    change[parameter.place] = parameter.deviation * row
    return change


def runout(parameters: Sequence[ModelParameter], n_channels: int) -> np.ndarray:
    """(P,) m that each channel shows of the shaft's surface at the values of the parameters."""
    shown = np.zeros(n_channels, dtype=complex)
    for parameter in parameters:
        if parameter.kind == "runout":
            shown[parameter.place] += parameter.shift * PARTS[parameter.detail]
    return shown


def _probe(parameters: Sequence[ModelParameter], channel: int) -> dict[str, float]:
    """Shifts of a channel's gain, angle and position along the shaft."""
    shifts = {p.kind: p.shift for p in parameters if p.kind in OF_PROBE and p.place == channel}
    return dict.fromkeys(OF_PROBE, 0.0) | shifts


def _channel(
    dataset: VibrationDataset, channel: int, rotor: RotorModel, probe: Mapping[str, float], slope: bool = False
) -> np.ndarray:
    """(n,) a channel's row, or its ``slope`` along the shaft, 1/m."""
    node, angle = dataset.channels[channel]
    cosine, sine = project_direction(angle)
    turned = (cosine + 1j * sine) * np.exp(1j * probe["probe_angle"])
    x, y = shaft_rows(rotor, node, probe["probe_position"], slope)
    return np.asarray((1 + probe["probe_gain"]) * (turned.real * x + turned.imag * y))


def of_machine_alone(parameters: Sequence[ModelParameter]) -> tuple[ModelParameter, ...]:
    """The same with exact probes and weights and a straight shaft, for vibration that no probe shows."""
    kept_out = (*OF_PROBE, *OF_ALL_WEIGHTS, *OF_LABEL, "runout", "bow", "bearing_drift", "base_softening")
    return tuple(
        replace(parameter, deviation=0.0, place=0) if parameter.kind in kept_out else parameter
        for parameter in parameters
    )


# --- supports ------------------------------------------------------------------------------------------


def support_change(parameters: Sequence[ModelParameter], rotor: RotorModel, frequencies: np.ndarray) -> np.ndarray:
    """(S, C, 8, T) what one deviation of each parameter changes of the casings' supports, N/m and N s/m.

    At ``frequencies`` w (S,) rad/s, where a mass m is the stiffness ``-w^2 m``.
    """
    result = np.zeros((len(frequencies), rotor.n_ground, len(COEFFICIENTS), len(parameters)))
    share: dict[str, tuple[str, Any]] = {
        "support_stiffness": ("k", 1.0),
        "support_damping": ("c", 1.0),
        "support_mass": ("k", -(frequencies**2)),
    }
    for t, parameter in enumerate(parameters):
        if parameter.kind in OF_SUPPORT:
            letter, factor = share[parameter.kind]
            c = COEFFICIENTS.index(letter + 2 * parameter.detail)
            result[:, parameter.place - rotor.n_nodes, c, t] = parameter.deviation * parameter.stated * factor
    return result


def softening(
    parameters: Sequence[ModelParameter], rotor: RotorModel, dataset: VibrationDataset
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Which stiffnesses fall with the size of what excites a run: ``k exp(growth theta - fall theta)``.

    (B + C, 8) N/m, k as stated, and zero for all else; (B + C, 8, T) growth, by one deviation of each parameter; (R, S,
    B + C, 8, T) fall, by the root of the stated force, of no run where nothing softens. That root is what trials with a
    measured base showed (studies/soft_base): softer modes need no other number than this one.
    """
    first, n_runs = len(rotor.bearing_nodes), len(dataset.runs)
    stated = np.zeros((first + rotor.n_ground, len(COEFFICIENTS)))
    growth = np.zeros((*stated.shape, len(parameters)))
    softer = [(t, p) for t, p in enumerate(parameters) if p.kind == "base_softening"]
    fall = np.zeros((n_runs if softer else 0, len(dataset.speeds), *growth.shape))
    for t, parameter in enumerate(parameters):
        if parameter.kind in ("support_stiffness", "base_softening"):
            at = first + parameter.place - rotor.n_nodes, COEFFICIENTS.index("k" + 2 * parameter.detail)
            if parameter.kind == "support_stiffness":
                growth[*at, t] = parameter.deviation
            else:
                stated[at] = parameter.stated
                fall[:, :, *at, t] = parameter.deviation * size_excitations(dataset).T
    return stated, growth, fall
