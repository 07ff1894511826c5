"""An answer together with the measurement that it is of: what everything behind a fit takes.

Legend: B bearings, S speeds, N balance planes.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np

from pipeline.identification.identified import IdentifiedModel
from pipeline.identification.uncertainty import Uncertainty
from pipeline.problem.measurement import Measurement
from pipeline.rotor.bearing_table import BearingTable


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
