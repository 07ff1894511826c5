"""Kalman filter from a single measured location, then least squares (Kang, Shi, Zhang, Zhen and Gu 2020).

Each speed by itself; :mod:`pipeline.equations.filtered` has the equations.

Legend: M members, S speeds, P channels, R runs, U unknowns, A of them that members have.
"""

from __future__ import annotations

import numpy as np

from pipeline.comparison.method import Estimate, Reason, Refusal, Task
from pipeline.comparison.parameters import require_determined
from pipeline.equations.filtered import BearingFilter, filtered

_DIFFERENCE = 1e-6
_LEAST_SETTLED = 0.5
"""Share of the speeds; with fewer the answer is none."""


def kalman(task: Task) -> Estimate:
    """Coefficients of each speed by itself, from any sensors whose runs are enough."""
    task = task.without_unbalance()
    require_determined(task, together=False)
    measured = task.dataset.displacement
    problem = BearingFilter(task.response(), measured, task.deviation, task.unknowns, task.known, task.alike)
    values, settled = filtered(problem, task.guess())
    if settled.mean() < _LEAST_SETTLED:
        raise Refusal(Reason.NOT_SETTLED, f"it does at {int(settled.sum())} of {len(settled)} speeds")
    words = f"{int(settled.sum())} of {len(settled)} speeds settled"
    return task.estimate(values, _deviation(task, problem, values), words)


def _deviation(task: Task, problem: BearingFilter, values: np.ndarray) -> np.ndarray:
    """(M, S, U): a fixed point ``p = T(p, z)`` moves with the readings by ``(I - T_p)^-1 T_z``."""
    active, measured = task.active, problem.measured

    def updated(of: np.ndarray, readings: np.ndarray) -> np.ndarray:
        """(S, A)."""
        found = problem.update(of, readings)
        return np.stack([found[m, :, u] for m, u in active], axis=1)

    base, by_value = updated(values, measured), []
    for m, u in active:
        step = np.zeros_like(values)
        step[m, :, u] = _DIFFERENCE * np.maximum(np.abs(values[m, :, u]), 1.0)
        by_value.append((updated(values + step, measured) - base) / step[m, :, u, None])
    own = np.linalg.pinv(np.eye(len(active)) - np.stack(by_value, axis=2))
    variance = np.zeros_like(base)
    for p, r in np.ndindex(measured.shape[1:]):
        size = _DIFFERENCE * np.abs(measured[:, p, r])
        for unit in (1.0, 1j):
            other = measured.copy()
            other[:, p, r] += unit * size
            moved = (own @ ((updated(values, other) - base) / size[:, None])[..., None])[..., 0]
            variance += (moved * task.deviation[:, p, r, None]) ** 2 / 2
    return task.active_values(np.sqrt(variance))
