"""Trained models as files: numbers in ``model.safetensors``, architecture in ``model.json``; no pickles."""

from __future__ import annotations

from dataclasses import asdict, fields
from pathlib import Path
from typing import Any

from pipeline.errors import DataError
from pipeline.files import read_json, write_beside, write_json
from pipeline.identification.coefficient_model import CoefficientModel
from pipeline.identification.identified import IdentifiedModel

SCHEMA = 1
WEIGHTS, ARCHITECTURE = "model.safetensors", "model.json"


def save_model(folder: Path, identified: IdentifiedModel) -> list[Path]:
    """Write both files. Raises StorageError."""
    from safetensors.torch import save_file

    weights = {"parameters": identified.parameters.contiguous()}
    description = {
        "schema": SCHEMA,
        "bearing_nodes": list(identified.bearing_nodes),
        "model": asdict(identified.model),
    }
    return [
        write_beside(folder / WEIGHTS, lambda beside: save_file(weights, beside)),
        write_json(folder / ARCHITECTURE, description),
    ]


def load_model(folder: Path) -> IdentifiedModel:
    """Read what :func:`save_model` wrote. Raises DataError: missing, damaged or of another schema."""
    from safetensors import SafetensorError
    from safetensors.torch import load_file

    description = read_json(folder / ARCHITECTURE)
    if description.get("schema") != SCHEMA:
        raise DataError(
            f"'{folder / ARCHITECTURE}' must have schema {SCHEMA}, but it has {description.get('schema')}: train "
            "again with stage=train"
        )
    try:
        model = CoefficientModel(
            **{field.name: _tuples(description["model"][field.name]) for field in fields(CoefficientModel)}
        )
        parameters = load_file(folder / WEIGHTS)["parameters"]
        identified = IdentifiedModel(model, tuple(description["bearing_nodes"]), parameters)
        if parameters.shape != (len(model.scale), model.n_parameters):
            raise ValueError(f"{tuple(parameters.shape)} numbers do not fit the architecture")
    except (OSError, SafetensorError, KeyError, TypeError, ValueError) as error:
        raise DataError(
            f"'{folder}' must hold a complete trained model, but it does not ({error}): train again with stage=train"
        ) from None
    return identified


def _tuples(value: Any) -> Any:
    """JSON knows lists only; the model is hashable and has tuples."""
    return tuple(_tuples(item) for item in value) if isinstance(value, list) else value
