"""Uncertain numbers of the weights: of each by itself, of all alike, and of all of one stated size.

A weight of the stated size U at the stated angle acts as ``turn u (1 + a |u|)`` with ``u = U exp(gain) share``.

Legend: T parameters, S speeds, R runs, n lateral DOF. SI units and radians.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
from pydantic import PositiveFloat

from pipeline.config.quantities import PositiveAngle, WeightLaw
from pipeline.data.dataset import Excitation, VibrationDataset, assemble_forces
from pipeline.parameters.kind import (
    PARTS,
    Kind,
    Machine,
    ModelParameter,
    Place,
    PositiveShare,
    everywhere,
    number_excitations,
)
from pipeline.rotor.model import RotorModel


def write_label(excitation: Excitation) -> str:
    """What is written on a weight: all of the same stated size are one weight, wherever they are put."""
    return f"{1e6 * excitation.magnitude:.6g} g mm"


def size_excitations(dataset: VibrationDataset) -> np.ndarray:
    """(S, R) root of N: of the forces that are stated of each run, their sizes summed."""
    forces = np.zeros(dataset.frequencies.shape)
    for excitation in dataset.excitations:
        run = dataset.runs.index(excitation.run)
        share = dataset.frequencies[:, run] ** 2 if excitation.kind == "unbalance" else 1.0
        forces[:, run] += excitation.magnitude * share
    return np.sqrt(forces)


def update_excitations(dataset: VibrationDataset, parameters: Sequence[ModelParameter]) -> VibrationDataset:
    """The data set with the weights at the values of the parameters."""
    if not any(parameter.row.weight for parameter in parameters):
        return dataset
    acting = _list_acting(dataset.excitations, parameters)
    updated = [
        _vector(weight, _act(weight, those)[0]) for weight, those in zip(dataset.excitations, acting, strict=True)
    ]
    return replace(dataset, excitations=tuple(updated))


def force_changes(
    parameters: Sequence[ModelParameter], rotor: RotorModel, dataset: VibrationDataset
) -> list[np.ndarray | None]:
    """(S, n, R) N, derivative of the forces by each parameter, at the values of all; None where it moves none.

    ``dataset`` has the weights as they are stated.
    """
    changes: list[list[Excitation]] = [[] for _ in parameters]
    for weight, acting in zip(dataset.excitations, _list_acting(dataset.excitations, parameters), strict=True):
        slopes = _act(weight, acting)[1]
        for t, parameter in acting:
            changes[t].append(_vector(weight, _unit(parameter) * slopes[parameter.row.weight]))
    runs, frequencies = dataset.runs, dataset.frequencies
    return [assemble_forces(rotor, tuple(change), runs, frequencies) if change else None for change in changes]


_Acting = Sequence[tuple[int, ModelParameter]]


def _list_acting(excitations: Sequence[Excitation], parameters: Sequence[ModelParameter]) -> list[_Acting]:
    """Which of the parameters shift a number of each weight."""
    uncertain = [(t, parameter) for t, parameter in enumerate(parameters) if parameter.row.weight]
    return [
        [(t, parameter) for t, parameter in uncertain if parameter.row.belongs(parameter, i, weight)]
        if weight.kind == "unbalance"
        else []
        for i, weight in number_excitations(excitations)
    ]


def _unit(parameter: ModelParameter) -> complex:
    """By how much one deviation shifts a weight's number."""
    return bend_law(parameter) or parameter.deviation


def _act(weight: Excitation, acting: _Acting) -> tuple[complex, dict[str, complex]]:
    """What a weight acts as, and the derivative of that by each of its numbers."""
    numbers: dict[str, complex] = {"angle": weight.phase, "gain": 0.0, "share": 1.0, "law": 0.0}
    for _, parameter in acting:
        numbers[parameter.row.weight] += parameter.value * _unit(parameter)
    share, law = numbers["share"].real, numbers["law"]
    size, turn = float(weight.magnitude * np.exp(numbers["gain"].real) * share), np.exp(1j * numbers["angle"].real)
    by_size = turn * (1 + 2 * law * size)
    return turn * size * (1 + law * size), {
        "angle": 1j * turn * size * (1 + law * size),
        "gain": by_size * size,
        "share": by_size * (size / share) if share else 0j,
        "law": turn * size**2,
    }


def _vector(excitation: Excitation, value: complex) -> Excitation:
    return replace(excitation, magnitude=abs(value), phase=float(np.angle(value)))


def bend_law(parameter: ModelParameter) -> complex:
    """What one deviation adds to a of the weights' law, 1/(kg m); zero for a parameter that is none of it."""
    return parameter.deviation * PARTS[parameter.detail] if parameter.row.weight == "law" else 0j


def _find_each(machine: Machine) -> list[Place]:
    return [Place(f"{weight.run} node {weight.node}", i, weight.run) for i, weight in machine.weights]


def _find_labels(machine: Machine) -> list[Place]:
    labels = dict.fromkeys(write_label(weight) for _, weight in machine.weights if weight.magnitude)
    return [Place(label, 0, label) for label in labels]


def _is_that(parameter: ModelParameter, i: int, weight: Excitation) -> bool:
    return (weight.run, i) == (parameter.detail, parameter.place)


def _has_label(parameter: ModelParameter, _: int, weight: Excitation) -> bool:
    return parameter.detail == write_label(weight)


KINDS = (
    Kind(
        name="unbalance_magnitude",
        prior=PositiveShare,
        meaning="of each weight, as a share",
        places=_find_each,
        missing="no run with an unbalance",
        usual=0.02,
        scope="run",
        weight="share",
        belongs=_is_that,
    ),
    Kind(
        name="unbalance_phase",
        prior=PositiveAngle,
        meaning="of the angle of each weight",
        places=_find_each,
        missing="no run with an unbalance",
        unit="rad",
        usual=np.pi / 90,
        scope="run",
        mirrored=True,
        weight="angle",
        belongs=_is_that,
    ),
    Kind(
        name="weight_angle",
        prior=PositiveAngle,
        meaning="of the angle of all weights alike, as a keyphasor's unknown place",
        places=lambda machine: everywhere(machine) if machine.weights else [],
        missing="no run with an unbalance",
        unit="rad",
        mirrored=True,
        scope="runs",
        weight="angle",
    ),
    Kind(
        name="weight_law",
        prior=WeightLaw,
        meaning="of the a in U (1 + a |U|), as all weights act; real and imaginary part",
        places=lambda machine: [Place(component, 0, component) for component in PARTS if machine.weights],
        missing="no run with an unbalance",
        unit="1/(kg m)",
        scope="runs",
        weight="law",
    ),
    Kind(
        name="weight_gain",
        prior=PositiveFloat,
        meaning="of the logarithm of a factor of all weights alike, as an unknown unit",
        places=lambda machine: everywhere(machine) if machine.weights else [],
        missing="no run with an unbalance",
        unit="ln",
        scope="runs",
        weight="gain",
    ),
    Kind(
        name="label_gain",
        prior=PositiveFloat,
        meaning="of the logarithm of a factor of all weights of one stated size",
        places=_find_labels,
        missing="no run with an unbalance",
        unit="ln",
        scope="runs",
        weight="gain",
        belongs=_has_label,
    ),
    Kind(
        name="label_angle",
        prior=PositiveAngle,
        meaning="of the angle of all weights of one stated size",
        places=_find_labels,
        missing="no run with an unbalance",
        unit="rad",
        mirrored=True,
        scope="runs",
        weight="angle",
        belongs=_has_label,
    ),
)
