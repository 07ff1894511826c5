"""What several stages read of what others made: the identified model, its quality, the modelled coefficients."""

from __future__ import annotations

from typing import Any

import numpy as np

from pipeline.config.schema import Config
from pipeline.data.coefficient_files import read_coefficients
from pipeline.errors import DataError
from pipeline.files import hash_file, read_json
from pipeline.identification.identified import IdentifiedModel
from pipeline.identification.storage import ARCHITECTURE, WEIGHTS, load_model
from pipeline.identification.uncertainty import UNCERTAINTY
from pipeline.problem.measurement import Measurement
from pipeline.rotor.bearing_table import BearingTable
from pipeline.stages.execution import make_missing
from pipeline.stages.workspace import input_files, workspace


def load_identified(config: Config, measurement: Measurement) -> IdentifiedModel:
    """The trained model, training first where it is missing. Raises DataError where other data trained it."""
    work = workspace(config)
    model_files = [work.folder / name for name in (WEIGHTS, ARCHITECTURE, UNCERTAINTY)]
    make_missing(config, "train", *model_files, work.training, work.history)
    about = read_json(work.training)
    identified = load_model(work.folder)
    laws = {
        "the data at hand": about.get("data_fingerprint") == measurement.dataset.fingerprint,
        "the model beside it": about.get("model") == " ".join(hash_file(path) for path in model_files),
        f"the bearings at nodes {list(measurement.rotor.bearing_nodes)}": identified.bearing_nodes
        == measurement.rotor.bearing_nodes,
        f"the unknowns {', '.join(config.identify.named())}": _same_unknowns(config, identified),
    }
    for law, holds in laws.items():
        if not holds:
            raise DataError(
                f"'{work.training}' must belong to {law}, but it does not: run stage=train with the same overrides"
            )
    return identified


def _same_unknowns(config: Config, identified: IdentifiedModel) -> bool:
    wanted, found = config.identify.unknowns_of(identified.bearing_nodes), identified.unknowns
    order = [found.names.index(name) for name in wanted.names] if set(wanted.names) == set(found.names) else []
    return bool(order) and np.array_equal(wanted.expansion, found.expansion[..., order])


QUALITY = ("fit", "residual", "condition_number")
"""What ``training.json`` holds of :class:`pipeline.identification.quality.Quality`."""


def load_quality(config: Config) -> dict[str, Any]:
    """How well the fit explains its readings. Raises DataError where ``training.json`` does not say."""
    path = workspace(config).training
    written = read_json(path, "train again with stage=train")
    found = {name: written[name] for name in QUALITY if name in written}
    if not found:
        raise DataError(f"'{path}' must say how well the fit explains its readings, but it does not: train again")
    return found


def load_modelled(config: Config, measurement: Measurement) -> BearingTable | None:
    """The truth of modelled data; None where there is none, as with measured data."""
    path = workspace(config).modelled
    if not input_files(config).own or not path.exists():
        return None
    return read_coefficients(path, measurement.rotor.bearing_nodes, measurement.dataset.speeds)
