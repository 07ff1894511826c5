"""Kalman's measurement update at each frequency, then least squares (after Kang, Shi, Zhang, Zhen and Gu 2020).

It is no filter that follows a signal in time: the motion is stationary, its state are complex amplitudes, and each
speed is solved by itself, with a prior of the bearing forces (:mod:`pipeline.problem.expansion`).

Legend: M members, S speeds, P channels, R runs, U unknowns, A those of them that members have.
"""

from __future__ import annotations

import numpy as np

from pipeline.methods.method import (
    Estimate,
    MethodOptions,
    Refusal,
    make_estimate,
    require_determined,
)
from pipeline.problem.expansion import filter_bearings, update_unknowns
from pipeline.problem.measurement import Measurement


def identify_by_filter(data: Measurement, options: MethodOptions, least_settled: float = 0.5) -> Estimate:
    """Coefficients of each speed by itself, from any sensors whose runs are enough.

    Raises Refusal where it settles at fewer than the share ``least_settled`` of the speeds.
    """
    require_determined(data, together=False)
    values, settled = filter_bearings(data)
    if settled.mean() < least_settled:
        raise Refusal("not_settled", f"it does at {int(settled.sum())} of {len(settled)} speeds")
    text = f"{int(settled.sum())} of {len(settled)} speeds settled"
    return make_estimate(data, values, _propagate_noise(data, values), text)


def _propagate_noise(data: Measurement, values: np.ndarray, difference: float = 1e-6) -> np.ndarray:
    """(M, S, U): a fixed point ``p = T(p, z)`` moves with the readings by ``(I - T_p)^-1 T_z``."""
    active, measured = data.unknowns.active, data.dataset.displacement

    def updated(state: np.ndarray, readings: np.ndarray) -> np.ndarray:
        """(S, A) after one more update."""
        return data.unknowns.to_active(update_unknowns(data, state, readings))

    base, by_value = updated(values, measured), []
    for m, u in active:
        step = np.zeros_like(values)
        step[m, :, u] = difference * np.maximum(np.abs(values[m, :, u]), 1.0)
        by_value.append((updated(values + step, measured) - base) / step[m, :, u, None])
    inverse = np.linalg.pinv(np.eye(len(active)) - np.stack(by_value, axis=2))
    variance = np.zeros_like(base)
    for p, r in np.ndindex(measured.shape[1:]):
        size = difference * np.abs(measured[:, p, r])
        for unit in (1.0, 1j):
            other = measured.copy()
            other[:, p, r] += unit * size
            change = (inverse @ ((updated(values, other) - base) / size[:, None])[..., None])[..., 0]
            variance += (change * data.deviation[:, p, r, None]) ** 2 / 2
    return data.unknowns.from_active(np.sqrt(variance))
