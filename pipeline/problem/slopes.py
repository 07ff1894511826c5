"""How the readings move, over their noise, with everything that is unknown: linear about given bearings.

Diagnosis, design, budget, bearing laws and quick fits all ask for these derivatives; the information of readings is
twice the real part of the products of their columns.

Legend: S speeds, P channels, R runs, B bearings, A active unknowns, N balance planes, T model parameters.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np

from pipeline.problem.measurement import Measurement
from pipeline.problem.response import derive_by_parameters, respond
from pipeline.rotor.bearing_table import BearingTable


@dataclass(frozen=True, eq=False)
class ReadingSlopes:
    """Derivatives of the readings over their noise, complex."""

    measurement: Measurement
    bearings: BearingTable

    @cached_property
    def _by_coefficient(self) -> np.ndarray:
        """(S, P, R, B, 8) m over N/m and N s/m."""
        return self.measurement.response.sensitivity(self.bearings)

    @property
    def by_unknown(self) -> np.ndarray:
        """(S, P, R, A) by the active unknowns, over N/m and N s/m."""
        influence = self.measurement.unknowns.influence
        return self._over_noise(np.einsum("sprbc,bca->spra", self._by_coefficient, influence, optimize=True))

    @property
    def by_unbalance(self) -> np.ndarray:
        """(S, P, R, N) by residual unbalance, over kg m."""
        return self._over_noise(self.measurement.response.derive_by_unbalance(self.bearings))

    @property
    def by_model(self) -> np.ndarray:
        """(S, P, R, T) by the model parameters, over their prior deviations."""
        measurement, response = self.measurement, self.measurement.response
        slopes = np.einsum("sprbc,sbct->sprt", self._by_coefficient, measurement.known_variation).astype(complex)
        for block, variation in zip(
            response.blocks if measurement.parameters else (), measurement.variations, strict=True
        ):
            change = response.change(self.bearings, block)
            slopes[:, :, block.runs] += derive_by_parameters(variation, respond(block, change), change[None], None)[0]
        return self._over_noise(slopes)

    def _over_noise(self, slopes: np.ndarray) -> np.ndarray:
        return np.asarray(slopes / self.measurement.deviation[..., None])
