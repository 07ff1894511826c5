"""Physical numbers of a fit against those of the modelled machine; whether readings contradict the laws they are of."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np

from pipeline.config.machine import MachineConfig
from pipeline.data.noise import NOMINAL_95
from pipeline.identification.quality import MISMATCH
from pipeline.laws.law_set import LawsConfig
from pipeline.laws.oil import OilConfig

_MODELLED_AS = {"load": "static_load"}
"""What a number of a law is called in the section of a modelled bearing, where that is another name."""


@dataclass(frozen=True)
class NumberError:
    """A number beside the true one."""

    value: float  # SI
    deviation: float  # standard
    true: float

    @property
    def error_percent(self) -> float:
        """Its distance from the true one, as a share of that."""
        return 100.0 * abs(self.value / self.true - 1.0)

    @property
    def within(self) -> bool:
        """Whether the nominal 95 % interval has the true one."""
        return abs(self.value - self.true) <= NOMINAL_95 * self.deviation


def measure_numbers(numbers: Mapping[str, tuple[float, float]], machine: MachineConfig) -> dict[str, NumberError]:
    """The errors of ``numbers`` (name -> value and standard deviation, SI) that the modelled machine has, too."""
    true = find_true_numbers(machine)
    return {name: NumberError(*number, true[name]) for name, number in numbers.items() if name in true}


def judge_numbers(numbers: Mapping[str, Mapping[str, Any]], machine: MachineConfig) -> dict[str, Any]:
    """The ``physical_numbers`` of a fit with their true values and errors, of a modelled machine."""
    if machine.recordings.format != "none":
        return dict(numbers)
    errors = measure_numbers({name: (entry["value"], entry["deviation"]) for name, entry in numbers.items()}, machine)
    more = {name: {"true": error.true, "error_percent": error.error_percent} for name, error in errors.items()}
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
        numbers |= _find_oil(laws, getattr(modelled, "oil_viscosity", None))
    return numbers


def _find_oil(laws: LawsConfig, modelled: float | OilConfig | None) -> dict[str, float]:
    """The oil's viscosity at the reference of the laws' oil, and the slope of its logarithm there."""
    if laws.oil is None or modelled is None:
        return {}
    if isinstance(modelled, float):
        return {"oil.viscosity": modelled}
    near = getattr(laws.oil, "reference", getattr(modelled, "reference", 0.0)) + np.array([-1.0, 0.0, 1.0])
    viscosity = modelled.viscosity_at(near)
    slope = float(np.log(viscosity[0] / viscosity[2])) / 2
    pole = {f"oil.{name}": getattr(modelled, name) for name in ("b", "c") if hasattr(modelled, name)}
    return {"oil.viscosity": float(viscosity[1]), "oil.slope": slope} | pole


def find_contradiction(about: Mapping[str, Any], kind: str, least: float = 1e-4) -> tuple[str, str] | None:
    """A sentence and the next step where the laws of a fit of the model ``kind`` cannot be it; None otherwise.

    ``about`` is its ``training.json`` or ``metrics.json``. A probability below ``least`` is not said in digits.
    """
    probability = about["fit"]["mismatch"]["probability"] if kind == "law" else None
    if probability is None or probability >= MISMATCH:
        return None
    chance = f"{probability:.2g}" if probability >= least else f"below {least:g}"
    return (
        f"The readings contradict this bearing law (probability {chance}).",
        "Fit model=hybrid or model=network_operating, or take another table in machine.laws.",
    )


def list_contradicted(correction: Mapping[str, Mapping[str, float]], deviations: float = 2.0) -> list[str]:
    """The coefficients of a bearing whose ``correction`` by a network stands out of its own deviation.

    Beyond so many ``deviations`` of it the law without the correction is contradicted.
    """
    return [name for name, entry in correction.items() if entry["percent"] > deviations * entry["deviation_percent"]]
