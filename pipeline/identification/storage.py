"""Trained models as files: numbers in ``model.safetensors``, architecture in ``model.json``; no pickles."""

from __future__ import annotations

from dataclasses import asdict
from pathlib import Path

import numpy as np

from pipeline.coefficients import COEFFICIENTS
from pipeline.config.messages import name_first
from pipeline.errors import DataError
from pipeline.files import hash_file, read_json, write_beside, write_json
from pipeline.identification.identified import Answer, IdentifiedModel, answer_of
from pipeline.identification.model import CoefficientModel
from pipeline.identification.uncertainty import UNCERTAINTY, load_uncertainty
from pipeline.laws.law_set import NO_LAWS, LawSet
from pipeline.parameters.identify import IdentifyConfig
from pipeline.problem.measurement import Measurement
from pipeline.unknowns import UnknownSet

SCHEMA = 3
WEIGHTS, ARCHITECTURE = "model.safetensors", "model.json"


def save_model(folder: Path, identified: IdentifiedModel) -> list[Path]:
    """Write both files. Raises StorageError."""
    from safetensors.torch import save

    weights = {"parameters": identified.parameters.contiguous()}
    if identified.laws:
        weights["theta"] = identified.theta.contiguous()
    description = {
        "schema": SCHEMA,
        "bearing_nodes": list(identified.bearing_nodes),
        "model": asdict(identified.model),
        "laws": identified.laws.to_record() if identified.laws else None,
        "expansion": identified.unknowns.expansion.astype(int).tolist(),
    }
    return [
        write_beside(folder / WEIGHTS, lambda beside: beside.write_bytes(save(weights))),
        write_json(folder / ARCHITECTURE, description),
    ]


def load_model(folder: Path) -> IdentifiedModel:
    """Read what :func:`save_model` wrote. Raises DataError: missing, damaged or of another schema."""
    import torch
    from pydantic import TypeAdapter, ValidationError
    from safetensors import SafetensorError
    from safetensors.torch import load_file

    description = read_json(folder / ARCHITECTURE, "train again with stage=train")
    if description.get("schema") != SCHEMA:
        raise DataError(
            f"'{folder / ARCHITECTURE}' must have schema {SCHEMA}, but it has {description.get('schema')}: train "
            "again with stage=train"
        )
    try:
        model = TypeAdapter(CoefficientModel).validate_python(description["model"])
        nodes = TypeAdapter(tuple[int, ...]).validate_python(description["bearing_nodes"])
        expansion = np.array(description["expansion"], dtype=float)
        numbers = load_file(folder / WEIGHTS)
        parameters = numbers["parameters"]
        theta = numbers.get("theta", parameters.new_zeros(0))
        laws = LawSet.from_record(description["laws"]) if description.get("laws") else NO_LAWS
        rules = {
            "the numbers do not fit the bearing laws": theta.shape == (len(laws.parameters),),
            f"{tuple(parameters.shape)} numbers do not fit the architecture": parameters.shape
            == (len(model.scale), model.n_parameters),
            "the numbers are not finite and of double precision": bool(
                parameters.dtype == torch.float64 and parameters.isfinite().all() and theta.isfinite().all()
            ),
            "scale does not fit the bearings and unknowns": len(model.scale) in (1, len(nodes))
            and all(len(row) == len(model.unknowns) for row in model.scale),
            "expansion does not fit the bearings and unknowns": expansion.shape
            == (len(nodes), len(COEFFICIENTS), len(model.unknowns)),
        }
        for wrong, holds in rules.items():
            if not holds:
                raise ValueError(wrong)
    except (OSError, SafetensorError, KeyError, TypeError, ValueError) as error:
        wrong = name_first(error) if isinstance(error, ValidationError) else str(error)
        raise DataError(
            f"'{folder}' must hold a complete trained model, but it does not ({wrong}): train again with stage=train"
        ) from None
    unknowns = UnknownSet(model.unknowns, expansion, shared=len(model.scale) < len(nodes))
    return IdentifiedModel(model, unknowns, nodes, parameters, laws, theta)


# --- with the measurement --------------------------------------------------------------------------------


def load_answer(folder: Path, identify: IdentifyConfig, measurement: Measurement) -> Answer:
    """The answer that a folder holds. Raises DataError where there is none, or where other data trained it."""
    training, files = folder / "training.json", [folder / name for name in (WEIGHTS, ARCHITECTURE, UNCERTAINTY)]
    about, model = read_json(training), load_model(folder)
    stated = [[parameter.name, parameter.deviation] for parameter in measurement.parameters]
    fitted = [[name, entry["prior_deviation"]] for name, entry in about.get("model_parameters", {}).items()]
    nodes = measurement.rotor.bearing_nodes
    laws = {
        "the data at hand": about.get("data_fingerprint") == measurement.dataset.fingerprint,
        "the model beside it": about.get("model") == " ".join(map(hash_file, files)),
        f"the bearings at nodes {list(nodes)}": model.bearing_nodes == nodes,
        f"the unknowns {', '.join(identify.named())}": _match(identify.unknowns_of(nodes), model.unknowns),
        "identify.model_parameters": fitted == stated,
    }
    for law, holds in laws.items():
        if not holds:
            raise DataError(
                f"'{training}' must belong to {law}, but it does not: run stage=train with the same overrides"
            )
    return answer_of(measurement, model, load_uncertainty(folder, model))


def _match(wanted: UnknownSet, trained: UnknownSet) -> bool:
    """Whether both have the same unknowns, in whatever order."""
    order = [trained.names.index(name) for name in wanted.names] if set(wanted.names) == set(trained.names) else []
    if not order or len(wanted.expansion) != len(trained.expansion):
        return False
    return np.array_equal(wanted.expansion, trained.expansion[..., order])
