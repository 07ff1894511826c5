"""Errors of identified coefficients and of physical numbers against modelled ones; whether readings contradict laws.

"Percentage error" is the mean over speeds of |identified - modelled| / |modelled|.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from pipeline.coefficients import COEFFICIENTS
from pipeline.config.machine import MachineConfig
from pipeline.config.schema import Config
from pipeline.data.operating import split_states, spread_states
from pipeline.data.sensors import NOMINAL_95
from pipeline.identification.quality import MISMATCH
from pipeline.rotor.bearing_table import BearingTable
from pipeline.rotor.stored import load_modelled_bearings
from pipeline.write_numbers import write_rough

CoefficientErrors = dict[str, dict[str, dict[str, float]]]
"""Bearing node -> coefficient name -> ``mean_error_percent`` and so on, as ``metrics.json`` has them."""


def measure_relative_errors(identified: BearingTable, modelled: BearingTable, name: str) -> np.ndarray:
    """(B, S) |identified - modelled| / |modelled| in percent; NaN where the modelled value is zero."""
    value, true = identified.coefficient(name), modelled.coefficient(name)
    size = np.where(true == 0.0, np.nan, np.abs(true))
    return 100.0 * np.abs(value - true) / size


def measure_errors(
    identified: BearingTable, modelled: BearingTable, names: Sequence[Sequence[str]]
) -> CoefficientErrors:
    """Errors of the coefficients ``names`` of each bearing; one that is modelled as zero has none.

    Relative ones over the speeds, in percent: mean, median, 95th percentile, largest; and ``l2``, which is
    |identified - modelled|_2 / |modelled|_2.
    """
    result: CoefficientErrors = {str(node): {} for node in identified.nodes}
    for b, node in enumerate(identified.nodes):
        for name in names[b]:
            relative = measure_relative_errors(identified, modelled, name)[b]
            errors = relative[~np.isnan(relative)]
            if len(errors):
                value, true = identified.coefficient(name)[b], modelled.coefficient(name)[b]
                l2 = 100.0 * np.linalg.norm(value - true) / np.linalg.norm(true)
                median, p95 = np.percentile(errors, (50.0, 95.0))
                sizes = {"mean": errors.mean(), "median": median, "p95": p95, "max": errors.max(), "l2": l2}
                result[str(node)][name] = {f"{kind}_error_percent": float(size) for kind, size in sizes.items()}
    return result


def find_worst_mean(errors: CoefficientErrors, name: str) -> float:
    """The largest mean error of one coefficient among the bearings, percent."""
    return max((error[name]["mean_error_percent"] for error in errors.values() if name in error), default=0.0)


def measure_coverage(errors: np.ndarray, deviation: np.ndarray) -> np.ndarray:
    """Percent (over the last axis) of errors inside the nominal 95 % interval, 1.96 standard deviations."""
    return np.asarray(100.0 * (np.abs(errors) <= NOMINAL_95 * deviation).mean(axis=-1))


def list_coverage(
    identified: BearingTable, modelled: BearingTable, names: Sequence[Sequence[str]]
) -> dict[str, dict[str, float]]:
    """By node and coefficient, percent of the speeds at which the modelled one lies in the nominal 95 % interval."""
    inside = measure_coverage((identified.values - modelled.values).swapaxes(1, 2), identified.spread.swapaxes(1, 2))
    return {
        str(node): {name: float(inside[b, COEFFICIENTS.index(name)]) for name in names[b]}
        for b, node in enumerate(identified.nodes)
        if names[b]
    }


def model_unmeasured(config: Config, speeds: np.ndarray) -> BearingTable | None:
    """The modelled coefficients at every different speed of ``speeds`` (rad/s) and all conditions that are asked for.

    None where none are, or where data were measured.
    """
    wanted = config.machine.unmeasured
    if not wanted or config.machine.recordings.recorded:
        return None
    points = spread_states(np.unique(speeds), wanted)
    return load_modelled_bearings(config.machine.rotor, config.machine.bearings, *points)


def measure_unmeasured(
    answer: BearingTable, modelled: BearingTable, names: Sequence[Sequence[str]]
) -> dict[str, CoefficientErrors]:
    """Errors at each condition, by its words such as ``40 degC``."""
    states = split_states(modelled.speeds, modelled.operating)
    return {state: measure_errors(answer.at(points), modelled.at(points), names) for state, points in states}


# --- physical numbers -----------------------------------------------------------------------------


_MODELLED_AS = {"load": "static_load"}
"""What a number of a law is called in the section of a modelled bearing, where that is another name."""


def measure_numbers(numbers: Mapping[str, Mapping[str, float]], machine: MachineConfig) -> dict[str, dict[str, float]]:
    """The ``numbers`` (name -> ``value`` and standard ``deviation``, SI) that the modelled machine has, too.

    Each with its ``true`` value, the distance from it as a share of that (``error_percent``), and ``within``, whether
    the nominal 95 % interval has it.
    """
    true, measured = find_true_numbers(machine), {}
    for name in [name for name in numbers if name in true]:
        value, deviation, expected = numbers[name]["value"], numbers[name]["deviation"], true[name]
        measured[name] = {
            "value": value,
            "deviation": deviation,
            "true": expected,
            "error_percent": 100.0 * abs(value / expected - 1.0),
            "within": abs(value - expected) <= NOMINAL_95 * deviation,
        }
    return measured


def judge_numbers(numbers: Mapping[str, Mapping[str, Any]], machine: MachineConfig) -> dict[str, Any]:
    """The ``physical_numbers`` of a fit with their true values and errors, of a modelled machine."""
    errors = {} if machine.recordings.recorded else measure_numbers(numbers, machine)
    more = {name: {key: error[key] for key in ("true", "error_percent")} for name, error in errors.items()}
    return {name: {**entry, **more.get(name, {})} for name, entry in numbers.items()}


def find_true_numbers(machine: MachineConfig) -> dict[str, float]:
    """Numbers (SI) of the modelled bearings and their oil, under the names that the machine's laws have for them."""
    laws, bearings = machine.laws, machine.bearings
    if laws is None:
        return {}
    modelled_at = {node: bearings.at(node) for node in bearings.places or laws.bearings}
    numbers: dict[str, float] = {}
    for node, law in laws.bearings.items():
        modelled = modelled_at.get(node)
        for name in type(law).model_fields:
            value = getattr(modelled, _MODELLED_AS.get(name, name), None)
            if isinstance(value, float):
                numbers[f"{node}.{name}"] = value
        oil = getattr(modelled, "oil_viscosity", None)
        if laws.oil is None or oil is None:
            continue
        if isinstance(oil, float):
            numbers["oil.viscosity"] = oil
            continue
        # At the reference of the laws' oil, with the slope of its logarithm there.
        near = getattr(laws.oil, "reference", getattr(oil, "reference", 0.0)) + np.array([-1.0, 0.0, 1.0])
        viscosity = oil.viscosity_at(near)
        numbers |= {"oil.viscosity": float(viscosity[1]), "oil.slope": float(np.log(viscosity[0] / viscosity[2])) / 2}
        numbers |= {f"oil.{name}": getattr(oil, name) for name in ("b", "c") if hasattr(oil, name)}
    return numbers


def find_contradiction(about: Mapping[str, Any], kind: str, least: float = 1e-4) -> tuple[str, str] | None:
    """A sentence and the next step where the laws of a fit of the model ``kind`` cannot be it; None otherwise.

    ``about`` is its ``training.json`` or ``metrics.json``. A probability below ``least`` is not said in digits.
    """
    probability = about["fit"]["mismatch"]["probability"] if kind == "law" else None
    if probability is None or probability >= MISMATCH:
        return None
    chance = write_rough(probability) if probability >= least else f"below {least:g}"
    return (
        f"The readings contradict this bearing law (probability {chance}).",
        "Fit model=hybrid or model=network_operating, or take another table in machine.laws.",
    )


def list_contradicted(correction: Mapping[str, Mapping[str, float]], deviations: float = 2.0) -> list[str]:
    """The coefficients of a bearing whose ``correction`` by a network stands out of its own deviation.

    Beyond so many ``deviations`` of it the law without the correction is contradicted.
    """
    return [name for name, entry in correction.items() if entry["percent"] > deviations * entry["deviation_percent"]]
