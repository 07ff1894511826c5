"""How the readings move, over their noise, with everything that is unknown: linear about given bearings.

Diagnosis, design, budget, bearing laws and quick fits all ask for these derivatives; the information of readings is
twice the real part of the products of their columns.

Legend: S speeds, P channels, R runs, B bearings, A active unknowns, N balance planes, T model parameters.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import TYPE_CHECKING

import numpy as np

from pipeline.problem.measurement import Measurement
from pipeline.problem.response import derive_by_parameters, respond
from pipeline.rotor.bearing_table import BearingTable

if TYPE_CHECKING:
    import torch


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

    def rows(self, by_number: np.ndarray) -> np.ndarray:
        """(S, P, R, Z) complex rows of unit variance in each part: by numbers that the unknowns follow from, by both
        parts of each residual unbalance, by the model parameters.

        ``by_number`` (S, A, n) is the derivative of the active unknowns by the numbers; Z = n + 2 N + T.
        """
        first = np.einsum("spra,san->sprn", self.by_unknown, by_number, optimize=True)
        by_plane = self._over_noise(self.measurement.response.derive_by_unbalance(self.bearings))
        return np.asarray(np.sqrt(2.0) * np.concatenate([first, by_plane, 1j * by_plane, self.by_model], axis=-1))

    def _over_noise(self, slopes: np.ndarray) -> np.ndarray:
        return np.asarray(slopes / self.measurement.deviation[..., None])


def stack_rows(values: np.ndarray) -> np.ndarray:
    """Complex numbers (S, P, R, ..) as rows of each speed (S, 2 P R, ..): real parts, then imaginary ones."""
    flat = values.reshape(len(values), -1, *values.shape[3:])
    return np.concatenate([flat.real, flat.imag], axis=1)


def prior_information(measurement: Measurement, of_numbers: np.ndarray) -> np.ndarray:
    """(Z,) information before any reading on what :meth:`ReadingSlopes.rows` are derivatives by: ``of_numbers`` (n,),
    none on residual unbalance, that of unit deviations on the model parameters.
    """
    nothing, unit = np.zeros(2 * len(measurement.unknowns.planes)), np.ones(len(measurement.parameters))
    return np.concatenate([of_numbers, nothing, unit])


def deviate(slopes: np.ndarray, covariance: np.ndarray) -> np.ndarray:
    """(..) standard deviations of what has the derivatives ``slopes`` (.., Z) by numbers of this ``covariance``
    (.., Z, Z), to first order: the root of the diagonal of ``slopes covariance slopes'``; zero where rounding makes a
    variance negative.
    """
    # einsum, unlike *, doesn't warn of what overflows: coefficients that ran away have no finite deviation
    variance = np.einsum("...z,...z->...", slopes @ covariance, slopes)
    return np.asarray(np.sqrt(np.maximum(variance, 0.0)))


def invert(information: np.ndarray | torch.Tensor) -> np.ndarray:
    """(.., Z, Z) inverse of (.., Z, Z), whatever the sizes of the numbers; large where nothing is known."""
    import torch

    matrix = torch.as_tensor(information)
    size = matrix.diagonal(dim1=-2, dim2=-1).clamp(min=1e-300).sqrt()
    scaled = matrix / size[..., :, None] / size[..., None, :]
    factor, failed = torch.linalg.cholesky_ex(scaled)
    if failed.any():
        values, vectors = torch.linalg.eigh(scaled)
        inverse = (vectors / values[..., None, :].clamp(min=10 * torch.finfo(values.dtype).eps)) @ vectors.mT
    else:
        inverse = torch.cholesky_inverse(factor)  # in an eighth of the time
    return np.asarray((inverse / size[..., :, None] / size[..., None, :]).numpy())


def invert_root(information: np.ndarray) -> np.ndarray:
    """(Z, Z) ``root`` of the inverse ``root' root`` of (Z, Z), as :func:`invert` of it: in half the time."""
    from scipy.linalg.lapack import dpotrf, dtrtri

    size = np.sqrt(np.maximum(np.diag(information), 1e-300))
    scaled = information / size[:, None] / size
    factor, failed = dpotrf(scaled, lower=True)
    if not failed:
        return np.asarray(dtrtri(factor, lower=True)[0] / size)
    values, vectors = np.linalg.eigh(scaled)
    return np.asarray((vectors / np.sqrt(np.maximum(values, 10 * np.finfo(float).eps))).T / size)
