"""Uncertain numbers of probes, and what slow roll leaves of runout.

Legend: T parameters, P channels, n lateral DOF. SI units and radians.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np

from pipeline.config.quantities import Acceleration, Length, PositiveAngle, Velocity
from pipeline.data.dataset import VibrationDataset, project_direction
from pipeline.parameters.kind import (
    PARTS,
    UNSHOWN,
    Kind,
    Machine,
    ModelParameter,
    Place,
    PositiveShare,
    require_on_shaft,
    turns_with_rotor,
)
from pipeline.rotor.interpolation import shaft_rows
from pipeline.rotor.model import RotorModel


def sensor_matrix(dataset: VibrationDataset, rotor: RotorModel, parameters: Sequence[ModelParameter]) -> np.ndarray:
    """(P, n) what each channel shows of the rotor's lateral DOF at the values of the parameters."""
    matrix = dataset.sensor_matrix(rotor)
    for p in {parameter.place for parameter in parameters if parameter.row.probe}:
        matrix[p] = _channel(dataset, p, rotor, _probe(parameters, p))
    return matrix


def sensor_change(
    parameter: ModelParameter, dataset: VibrationDataset, rotor: RotorModel, parameters: Sequence[ModelParameter]
) -> np.ndarray | None:
    """(P, n) derivative of :func:`sensor_matrix` by the parameter; None for one that changes nothing of it."""
    kind, place = parameter.row, parameter.place
    if rotor.casings and kind.move:  # a casing moves by what bearings feel of the DOF, linearly
        shifted = kind.move(rotor, place, parameter.deviation)
        matrices = [sensor_matrix(dataset, each, parameters) for each in (shifted, rotor)]
        return np.asarray(matrices[0] - matrices[1])
    if not kind.probe:
        return None
    probe = _probe(parameters, place)
    if kind.probe == "gain":
        row = _channel(dataset, place, rotor, probe) / (1 + probe["gain"])
    elif kind.probe == "angle":  # the derivative of a direction is the direction a quarter turn on
        row = _channel(dataset, place, rotor, {**probe, "angle": probe["angle"] + np.pi / 2})
    else:
        row = _channel(dataset, place, rotor, probe, slope=True)
    change = np.zeros((len(dataset.channels), rotor.n_dof))
    change[place] = parameter.deviation * row
    return change


def runout(parameters: Sequence[ModelParameter], dataset: VibrationDataset) -> np.ndarray:
    """(S, P, R) m that each channel shows beside the motion, at the values of the parameters: of the shaft's surface,
    or a constant a of the derivative k that a probe measures, a / (j w)^k, in the runs that turn with the rotor.
    """
    shown = np.zeros(dataset.displacement.shape, dtype=complex)
    for parameter in parameters:
        if parameter.kind in _ORDERS:
            vector = parameter.shift * PARTS[parameter.detail] * turns_with_rotor(dataset)
            shown[:, parameter.place] += vector / (1j * dataset.frequencies) ** _ORDERS[parameter.kind]
    return shown


_ORDERS = {"runout": 0, "pickup_displacement": 0, "pickup_velocity": 1, "pickup": 2}
"""Kinds of vectors that are no motion of the probe: constant in this derivative of the displacement."""


def _list_parts(machine: Machine, probes: Sequence[Place]) -> list[Place]:
    """Real and imaginary part of a vector of each of the ``probes``, where some run shows it."""
    parts = [Place(f"{probe.label} {component}", probe.place, component) for probe in probes for component in PARTS]
    return parts if machine.shows_bow else []


def _probe(parameters: Sequence[ModelParameter], channel: int) -> dict[str, float]:
    """Shifts of a channel's gain, angle and position along the shaft."""
    shifts = {"gain": 0.0, "angle": 0.0, "position": 0.0}
    for parameter in parameters:
        if parameter.row.probe and parameter.place == channel:
            shifts[parameter.row.probe] = parameter.shift
    return shifts


def _channel(
    dataset: VibrationDataset, channel: int, rotor: RotorModel, probe: Mapping[str, float], slope: bool = False
) -> np.ndarray:
    """(n,) a channel's row, or its ``slope`` along the shaft, 1/m."""
    node, angle = dataset.channels[channel]
    cosine, sine = project_direction(angle)
    turned = (cosine + 1j * sine) * np.exp(1j * probe["angle"])
    x, y = shaft_rows(rotor, node, probe["position"], slope)
    return np.asarray((1 + probe["gain"]) * (turned.real * x + turned.imag * y))


KINDS = (
    Kind(
        name="probe_gain",
        prior=PositiveShare,
        meaning="of the scale of each probe, as a share",
        places=lambda machine: machine.probes,
        usual=0.02,
        scope="run",
        probe="gain",
    ),
    Kind(
        name="probe_angle",
        prior=PositiveAngle,
        meaning="of the angle of each probe",
        places=lambda machine: machine.probes,
        unit="rad",
        usual=np.pi / 180,
        mirrored=True,
        scope="run",
        probe="angle",
    ),
    Kind(
        name="probe_position",
        prior=Length,
        meaning="of the place of each probe along the shaft",
        places=lambda machine: machine.probes_on_shaft,
        missing="probes on casings alone",
        require=lambda parameter, machine: require_on_shaft(
            parameter, machine, machine.dataset.channels[parameter.place][0], max
        ),
        unit="m",
        usual=3e-3,
        widens=False,
        scope="run",
        probe="position",
    ),
    Kind(
        name="runout",
        prior=Length,
        meaning="of what slow roll leaves, a vector that a probe shows at all speeds alike; real and imaginary part",
        places=lambda machine: _list_parts(machine, machine.probes_on_shaft),
        missing=UNSHOWN,
        unit="m",
        shown=("um", 1e6),
        usual=1e-6,
        widens=False,
        scope="runs",
    ),
    *(
        Kind(
            name=name,
            prior=prior,
            meaning=f"of a 1X vector of probes on casings that no motion causes, constant as {quantity}; both parts",
            places=lambda machine: _list_parts(
                machine, [p for p in machine.probes if p not in machine.probes_on_shaft]
            ),
            missing="probes on casings in runs that turn with the rotor and that no baseline was subtracted from",
            unit=unit,
            shown=shown,
            scope="runs",
        )
        for name, prior, quantity, unit, shown in (
            ("pickup", Acceleration, "acceleration", "m/s^2", None),
            ("pickup_velocity", Velocity, "velocity", "m/s", ("mm/s", 1e3)),
            ("pickup_displacement", Length, "displacement", "m", ("um", 1e6)),
        )
    ),
)
