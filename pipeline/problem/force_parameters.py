"""What uncertain numbers change of the forces: weights, and a bow of the shaft.

A shaft with the bow ``u`` resists ``q - u``, not q: with the shaft's own stiffness K its force is ``-K (q - u)``, so
that ``K u`` acts on the straight one and turns with it (Nelson and McVaugh 1976; Childs 1993). The same at all speeds,
it is no unbalance. The shapes here are those that a force at a disc gives the shaft between its bearings.

Legend: T parameters, S speeds, R runs, n lateral DOF. SI units and radians.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import replace
from functools import lru_cache

import numpy as np

from pipeline.data.dataset import Excitation, VibrationDataset, assemble_forces
from pipeline.rotor.model import RotorModel, bearing_dof, translation_dof
from pipeline.rotor.parameters import OF_ALL_WEIGHTS, OF_LABEL, OF_WEIGHT, ModelParameter

PARTS = {"real": 1.0, "imaginary": 1j}
"""A complex number is two parameters: its parts, and the unit of each."""


def number_excitations(excitations: Sequence[Excitation]) -> Iterator[tuple[int, Excitation]]:
    """Each excitation with its position among those of its run, which selecting runs does not change."""
    seen: dict[str, int] = {}
    for excitation in excitations:
        seen[excitation.run] = seen.get(excitation.run, -1) + 1
        yield seen[excitation.run], excitation


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


# --- weights -------------------------------------------------------------------------------------------


def update_excitations(dataset: VibrationDataset, parameters: Sequence[ModelParameter]) -> VibrationDataset:
    """The data set with the weights at the values of the parameters."""
    shifts = _shifts(parameters)
    updated = [_vector(weight, _act(weight, i, shifts)[0]) for i, weight in number_excitations(dataset.excitations)]
    return replace(dataset, excitations=tuple(updated)) if shifts else dataset


def force_change(
    parameter: ModelParameter, parameters: Sequence[ModelParameter], rotor: RotorModel, dataset: VibrationDataset
) -> np.ndarray | None:
    """(S, n, R) N, derivative of the forces by a parameter, at the values of all; None where it moves none.

    ``dataset`` has the weights as they are stated.
    """
    if parameter.kind not in _OF_ANY:
        return None
    shifts, changes = _shifts(parameters), []
    for i, weight in number_excitations(dataset.excitations):
        if parameter.kind in OF_WEIGHT:
            acts = (weight.run, i) == (parameter.detail, parameter.place)
        else:
            acts = weight.kind == "unbalance" and parameter.detail in ("", *PARTS, write_label(weight))
        if acts:
            unit = PARTS[parameter.detail] if parameter.kind == "weight_law" else 1.0
            slope = _act(weight, i, shifts)[1][parameter.kind] * unit
            changes.append(_vector(weight, parameter.deviation * slope))
    return assemble_forces(rotor, tuple(changes), dataset.runs, dataset.frequencies) if changes else None


_OF_ANY = (*OF_WEIGHT, *OF_ALL_WEIGHTS, *OF_LABEL)
_Shifts = Mapping[tuple[str, str, int], float]


def _shifts(parameters: Sequence[ModelParameter]) -> _Shifts:
    """(kind, detail, place) -> what a weight's number moves by."""
    return {(p.kind, p.detail, p.place): p.shift for p in parameters if p.kind in _OF_ANY}


def _act(excitation: Excitation, i: int, shifts: _Shifts) -> tuple[complex, dict[str, complex]]:
    """What a weight acts as, ``turn U (1 + a |U|)`` of its size U, and the derivative of that by each kind of number;
    by the parts of a complex one over the unit of each.
    """
    common_shifts: _Shifts = shifts if excitation.kind == "unbalance" else {}
    law = sum((unit * common_shifts.get(("weight_law", name, 0), 0.0) for name, unit in PARTS.items()), 0j)
    common, label = common_shifts.get(("weight_angle", "", 0), 0.0), write_label(excitation)
    common += common_shifts.get(("label_angle", label, 0), 0.0)
    gain = common_shifts.get(("weight_gain", "", 0), 0.0) + common_shifts.get(("label_gain", label, 0), 0.0)
    angle = excitation.phase + common + shifts.get(("unbalance_phase", excitation.run, i), 0.0)
    share = 1 + shifts.get(("unbalance_magnitude", excitation.run, i), 0.0)
    size, turn = float(excitation.magnitude * np.exp(gain) * share), complex(np.exp(1j * angle))
    effective, by_size = turn * size * (1 + law * size), turn * size * (1 + 2 * law * size)
    return effective, {
        **dict.fromkeys(("unbalance_phase", "weight_angle", "label_angle"), 1j * effective),
        **dict.fromkeys(("weight_gain", "label_gain"), by_size),
        "unbalance_magnitude": turn * (size / share) * (1 + 2 * law * size) if share else 0j,
        "weight_law": turn * size**2,
    }


def _vector(excitation: Excitation, value: complex) -> Excitation:
    return replace(excitation, magnitude=abs(value), phase=float(np.angle(value)))


# --- the bow -------------------------------------------------------------------------------------------


def bow_change(parameter: ModelParameter, rotor: RotorModel) -> np.ndarray | None:
    """(n,) N, complex, derivative of the bow's force by the parameter; None where it is of no bow.

    ``rotor`` is the stated one: a bow is what its stiffness makes of the force.
    """
    if parameter.kind != "bow":
        return None
    x, y = (_bend(rotor, parameter.place, direction) for direction in range(2))
    return np.asarray(parameter.deviation * PARTS[parameter.detail] * (x - 1j * y))


def bow_force(parameters: Sequence[ModelParameter], rotor: RotorModel) -> np.ndarray:
    """(n,) N, complex, that turns with the shaft at the values of the parameters."""
    total = np.zeros(rotor.n_dof, dtype=complex)
    for parameter in parameters:
        if parameter.kind == "bow":
            total += parameter.value * np.asarray(bow_change(parameter, rotor))
    return total


@lru_cache(maxsize=16)
def _bend(rotor: RotorModel, node: int, direction: int) -> np.ndarray:
    """(n,) N: the force that bends the shaft by 1 m at the node, held at its bearings, with what holds it there."""
    held = bearing_dof(rotor).ravel()
    free = np.setdiff1d(np.arange(rotor.n_dof), held)
    at, unit = translation_dof(node, direction), np.zeros(rotor.n_dof)
    unit[at] = 1.0
    shape = np.zeros(rotor.n_dof)
    shape[free] = np.linalg.solve(rotor.stiffness[np.ix_(free, free)], unit[free])
    unit[held] = rotor.stiffness[held] @ shape
    return np.asarray(unit / shape[at])
