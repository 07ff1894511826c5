"""The conventional answer: least squares at each speed by itself (Tiwari, Lees, Friswell 2002)."""

from __future__ import annotations

import numpy as np

from pipeline.equations.bearing_equations import UnknownSystem


def per_speed_least_squares(system: UnknownSystem) -> tuple[np.ndarray, np.ndarray]:
    """Coefficients (B, S, U) that minimise ``|A p + y|`` at each speed, and condition numbers (B, S) of A.

    Columns are scaled to unit length first: stiffness and damping differ by orders of magnitude, and the
    condition number should speak of the orbits rather than of the units.
    """
    length = np.linalg.norm(system.matrix, axis=2, keepdims=True)  # (B, S, 1, U)
    length = np.where(length > 0, length, 1.0)
    left, singular, right = np.linalg.svd(system.matrix / length, full_matrices=False)
    largest = singular[..., :1]
    usable = singular > largest * np.finfo(float).eps * system.matrix.shape[2]
    inverse = np.where(usable, 1.0 / np.where(usable, singular, 1.0), 0.0)
    projected = np.einsum("bsru,bsr->bsu", left, system.offset) * inverse
    scaled = -np.einsum("bsuv,bsu->bsv", right, projected)
    with np.errstate(divide="ignore"):
        condition = largest[..., 0] / singular[..., -1]
    return scaled / length[:, :, 0], condition
