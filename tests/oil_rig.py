"""A published compressor rotor on two journal bearings, measured at several oil temperatures; the table and the oil are
those of the same source.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import Any, get_args

import numpy as np
from running import composed

from pipeline.coefficients import CoefficientName
from pipeline.config.models import HybridModelConfig, LawModelConfig, NetworkModelConfig
from pipeline.data.dataset import Excitation
from pipeline.data.sensors import NoiseModel
from pipeline.data.simulate import add_noise, simulate
from pipeline.identification.fit import default_setup
from pipeline.identification.training import FitSetup
from pipeline.laws.law_set import LawsConfig, LawSet, make_laws
from pipeline.problem.measurement import Guess, Measurement
from pipeline.rotor.bearing_table import BearingTable
from pipeline.rotor.stored import load_rotor
from pipeline.unknowns import tie, unknown_set

NODES = (8, 21)
NOISE = NoiseModel(5e-8, 0.01)
GUESS = Guess(1e7, 1e4)
LUND = {"kind": "journal_table", "table": "lund_thomsen_two_axial_groove"}
SHORT = {"kind": "short_journal", "load_angle": "0 deg"}
TRUE = {"oil.viscosity": 0.0277 * np.exp(0.034 * -15), "oil.slope": 0.034}
TRUE |= {"8.radial_clearance": 1e-4, "21.radial_clearance": 8.5e-5}
WEIGHTS = (("a", 5, 5e-4, 0.0), ("b", 15, 2.5e-4, 0.0), ("c", 5, 5e-4, 0.0), ("c", 15, 2.5e-4, np.pi / 2))
RUNS = tuple(Excitation(run, "unbalance", node, size, phase) for run, node, size, phase in WEIGHTS)
SHAKEN = tuple(
    Excitation(run, "force", node, size, 0.0, "backward") for run, node, size in (("d", 5, 50.0), ("e", 15, 20.0))
)
"""Runs of a shaker, whose force turns against the rotor."""


def laws_of(kind: dict[str, Any] = LUND, factors: Sequence[float] | None = None) -> LawSet:
    """The laws with the numbers that made the data (None), or with guesses that are these factors off."""
    names = dict(zip(TRUE, factors, strict=True)) if factors is not None else {}

    def number(name: str, unit: str, scale: float) -> object:
        value = f"{TRUE[name] * scale * names.get(name, 1.0)} {unit}"
        return {"guess": value, "within": 3} if names else value

    oil = {"viscosity": number("oil.viscosity", "mPa s", 1e3), "slope": number("oil.slope", "1/K", 1.0)}
    large = {"journal_diameter": "99.8 mm", "length": "49.9 mm", "static_load": "892.7 N"}
    small = {"journal_diameter": "50 mm", "length": "25 mm", "static_load": "45 N"}
    bearings = {
        node: kind | sizes | {"radial_clearance": number(f"{node}.radial_clearance", "mm", 1e3)}
        for node, sizes in zip(NODES, (large, small), strict=True)
    }
    section = {"oil": {"law": "exponential", "reference": "55 degC", **oil}, "bearings": bearings}
    return make_laws(LawsConfig.model_validate(section), NODES)


def bearings_at(rpm: np.ndarray, celsius: Sequence[float]) -> BearingTable:
    """The true coefficients at all speeds and temperatures."""
    import torch

    speeds = np.tile(rpm * np.pi / 30, len(celsius))
    operating = {"oil_temperature": np.repeat(np.array(celsius) + 273.15, len(rpm))}
    values, _ = laws_of().coefficients(torch.zeros(1, 0, dtype=torch.float64), speeds, operating)
    return BearingTable(NODES, speeds, values[0].numpy(), operating)


def measure(
    truth: BearingTable, laws: LawSet | None, seed: int = 0, runs: tuple[Excitation, ...] = RUNS
) -> Measurement:
    """What probes at the bearings read, with noise; all sixteen coefficients are unknown."""
    rotor = load_rotor(composed("machine=compressor_two_journals").machine.rotor)
    clean = simulate(rotor, truth, runs)
    seen = [p for p, (node, _) in enumerate(clean.channels) if node in NODES]
    clean = replace(clean, channels=tuple(clean.channels[p] for p in seen), displacement=clean.displacement[:, seen])
    data = add_noise(clean, NOISE.deviation(clean.displacement), np.random.default_rng(seed))
    unknowns = unknown_set(dict.fromkeys(NODES, tie(get_args(CoefficientName))))
    known = replace(truth, values=np.zeros_like(truth.values))
    return Measurement(rotor, data, known, NOISE, unknowns, GUESS, laws=laws)


def setup(kind: str = "law") -> FitSetup:
    """The output error to its minimum, of laws, of laws with a correction, or of a network."""
    made = default_setup(GUESS)
    shared = {name: getattr(made.model, name) for name in LawModelConfig.model_fields if name != "kind"}
    network = {"width": 48, "depth": 1, "activation": "tanh", "input_scaling": "log_rpm"}
    model, own = {
        "law": (LawModelConfig, {}),
        "hybrid": (HybridModelConfig, network),
        "network": (NetworkModelConfig, network | {"trend": True}),
    }[kind]
    return replace(made, model=model.model_validate({"kind": kind, **shared, **own}), force=True)
