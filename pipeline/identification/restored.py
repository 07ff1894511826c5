"""An answer together with the measurement that it is of: what everything behind a fit takes.

Legend: B bearings, S speeds, N balance planes.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from pathlib import Path

import numpy as np

from pipeline.config.identification import IdentifyConfig
from pipeline.errors import DataError
from pipeline.files import hash_file, read_json
from pipeline.identification.identified import IdentifiedModel
from pipeline.identification.storage import ARCHITECTURE, WEIGHTS, load_model
from pipeline.identification.uncertainty import UNCERTAINTY, Uncertainty, load_uncertainty
from pipeline.problem.measurement import Measurement
from pipeline.rotor.bearing_table import BearingTable
from pipeline.unknowns import UnknownSet


@dataclass(frozen=True, eq=False)
class Answer:
    """The trained model, and the measurement at the model parameters that the fit found; see :func:`answer_of`."""

    measurement: Measurement
    model: IdentifiedModel
    uncertainty: Uncertainty | None  # None for a loss that states no deviations

    @cached_property
    def table(self) -> BearingTable:
        """All eight coefficients at the points of the data."""
        return self.model.table(self.measurement.updated_known)

    def deviation(self, table: BearingTable) -> np.ndarray | None:
        """(B, S, 8) standard deviations at the points of ``table``, see :meth:`Uncertainty.deviation`."""
        if self.uncertainty is None:
            return None
        return self.uncertainty.deviation(self.model, table.speeds, table.operating)

    @property
    def tags(self) -> dict[str, str]:
        """What records and reports know the data by."""
        return {"data_fingerprint": self.measurement.dataset.fingerprint}

    @property
    def names(self) -> tuple[tuple[str, ...], ...]:
        """What is identified, bearing by bearing."""
        return self.model.unknowns.by_bearing

    @property
    def unbalance(self) -> np.ndarray | None:
        """(N,) complex residual unbalance, kg m."""
        return None if self.uncertainty is None else self.uncertainty.residual_unbalance


def answer_of(measurement: Measurement, model: IdentifiedModel, uncertainty: Uncertainty | None) -> Answer:
    """The answer of a fit to ``measurement``, which is as it was stated before."""
    updated = measurement if uncertainty is None else measurement.update(uncertainty.parameters)
    return Answer(updated, model, uncertainty)


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
