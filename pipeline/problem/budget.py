"""What the tolerance of each assumed quantity does to each coefficient: the systematic budget beside the deviations.

At one speed, weighted least squares takes a wrong model for other coefficients. Where the readings of a machine that is
not as stated differ by ``V``, and move by ``J`` with the unknowns, both over the noise, the unknowns move by
``(J'J)^-1 J'V``. A fit over all speeds shares what is smooth over the speed, and a model error is: it moves by about as
much.

Legend: S speeds, P channels, R runs, B bearings, A active unknowns, T model parameters.
"""

from __future__ import annotations

import numpy as np

from pipeline.problem.measurement import Measurement
from pipeline.problem.slopes import ReadingSlopes
from pipeline.rotor.bearing_table import BearingTable


def systematic_shifts(measurement: Measurement, bearings: BearingTable) -> np.ndarray | None:
    """(S, A, T) error of each active unknown, N/m and N s/m, where the machine is one prior deviation off.

    ``bearings`` are the best at hand. None where a speed by itself does not determine the unknowns.
    """
    linear = ReadingSlopes(measurement, bearings)
    scaled = [slopes.reshape(len(slopes), -1, slopes.shape[-1]) for slopes in (linear.by_unknown, linear.by_model)]
    unknown, model = (np.concatenate([slopes.real, slopes.imag], axis=1) for slopes in scaled)
    size = np.linalg.norm(unknown, axis=1, keepdims=True)
    if unknown.shape[1] < unknown.shape[2] or not size.all():
        return None
    return np.asarray(np.linalg.pinv(unknown / size) @ model / size.swapaxes(1, 2))


def budget_percent(measurement: Measurement, bearings: BearingTable) -> dict[str, np.ndarray] | None:
    """Kind of parameter -> (A,) percent of the coefficient, the median over the speed.

    Parameters of one kind are independent: their squares add. None as :func:`systematic_shifts`.
    """
    shifts = systematic_shifts(measurement, bearings)
    if shifts is None:
        return None
    values = measurement.unknowns.leading(bearings.values)  # (M, S, U)
    sizes = np.stack([values[m, :, u] for m, u in measurement.unknowns.active], axis=-1)  # (S, A)
    kinds = np.array([parameter.kind for parameter in measurement.parameters])
    return {
        kind: 100 * np.median(np.sqrt((shifts[..., kinds == kind] ** 2).sum(axis=-1)) / np.abs(sizes), axis=0)
        for kind in dict.fromkeys(kinds.tolist())
    }
