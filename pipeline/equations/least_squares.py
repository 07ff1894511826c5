"""The conventional answer: least squares at each speed by itself (Tiwari, Lees, Friswell 2002)."""

from __future__ import annotations

import numpy as np

from pipeline.equations.unknown_system import UnknownSystem


def per_speed_least_squares(system: UnknownSystem) -> tuple[np.ndarray, np.ndarray]:
    """Unknowns (M, S, U) that minimise ``|A p + y|`` at each speed, and condition numbers (M, S) of A.

    Columns are scaled to unit length first: stiffness and damping differ by orders of magnitude, and the
    condition number should speak of the orbits rather than of the units. An unknown that a bearing does not have is 0.
    """
    length = np.linalg.norm(system.matrix, axis=2, keepdims=True)  # (M, S, 1, U)
    length = np.where(length > 0, length, 1.0)
    left, singular, right = np.linalg.svd(system.matrix / length, full_matrices=False)
    largest = singular[..., :1]
    usable = singular > largest * np.finfo(float).eps * system.matrix.shape[2]
    inverse = np.where(usable, 1.0 / np.where(usable, singular, 1.0), 0.0)
    projected = np.einsum("bsru,bsr->bsu", left, system.offset) * inverse
    scaled = -np.einsum("bsuv,bsu->bsv", right, projected)
    return scaled / length[:, :, 0], condition_numbers(singular, system)


def condition_numbers(singular: np.ndarray, system: UnknownSystem) -> np.ndarray:
    """(M, S) ratio of the largest to the smallest of the ``singular`` values (M, S, min(rows, U)) that count.

    An unknown that a bearing does not have is a singular value of zero that does not count; with fewer rows than
    unknowns the ratio is infinite.
    """
    condition = np.empty(singular.shape[:2])
    for m, present in enumerate(system.unknowns.present):
        count = int(present.sum())
        if count > singular.shape[2]:
            condition[m] = np.inf
            continue
        with np.errstate(divide="ignore"):
            condition[m] = singular[m, :, 0] / singular[m, :, count - 1] if count else 1.0
    return condition
