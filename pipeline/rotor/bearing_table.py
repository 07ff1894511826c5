"""Bearing coefficients over operating points (speed and conditions), and the impedance that they make.

Legend: B bearings, S operating points, 8 coefficients in the order of :data:`pipeline.coefficients.COEFFICIENTS`.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, replace

import numpy as np

from pipeline.coefficients import COEFFICIENTS
from pipeline.unknowns import UnknownSet


@dataclass(frozen=True, eq=False)
class BearingTable:
    """The eight coefficients of every bearing at every operating point."""

    nodes: tuple[int, ...]  # B
    speeds: np.ndarray  # (S,) rad/s
    values: np.ndarray  # (B, S, 8) N/m and N s/m
    operating: Mapping[str, np.ndarray] = field(default_factory=dict)  # name -> (S,) SI, temperatures in K
    deviation: np.ndarray | None = None  # (B, S, 8) standard deviations; NaN where known; None where none is stated
    by: str = ""  # in words: what the deviations follow from

    def coefficient(self, name: str) -> np.ndarray:
        """(B, S) values of one coefficient."""
        return self.values[..., COEFFICIENTS.index(name)]

    @property
    def spread(self) -> np.ndarray:
        """(B, S, 8) standard deviations; NaN where none is stated."""
        return np.full_like(self.values, np.nan) if self.deviation is None else self.deviation

    def with_unknowns(self, unknowns: UnknownSet, values: np.ndarray) -> BearingTable:
        """These coefficients, with unknowns (M, S, U), or constants (M, 1, U), in their places."""
        return replace(self, values=unknowns.expand(values, self.values))

    def impedance(self, frequencies: np.ndarray | None = None) -> np.ndarray:
        """(B, S, 2, 2) complex ``K + j w C`` in N/m; (B, S, R, 2, 2) for ``frequencies`` (S, R).

        Coefficients belong to the rotor speed, ``w`` is the excitation frequency (rad/s); the two are
        the same unless ``frequencies`` (S,) or (S, R) are given.
        """
        w = self.speeds if frequencies is None else frequencies
        stiffness, damping = np.moveaxis(self.values.reshape(*self.values.shape[:2], 2, 2, 2), 2, 0)
        if w.ndim == 1:
            return stiffness + 1j * w[:, None, None] * damping
        return stiffness[:, :, None] + 1j * w[:, :, None, None] * damping[:, :, None]

    @property
    def bounded(self) -> np.ndarray:
        """(S,) mask of the points at which every coefficient is a number far from where its square overflows."""
        return np.asarray((np.abs(self.values) < 1e100).all(axis=(0, 2)))  # false for NaN

    def at(self, keep: np.ndarray) -> BearingTable:
        """The same at the points that the mask or index ``keep`` selects."""
        operating = {name: values[keep] for name, values in self.operating.items()}
        spread, speeds = None if self.deviation is None else self.deviation[:, keep], self.speeds[keep]
        return replace(self, speeds=speeds, values=self.values[:, keep], operating=operating, deviation=spread)
