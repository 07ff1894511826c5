"""The free numbers of the methods that predict the response: logarithms of what must be positive, shares of the rest.

Legend: M members, S speeds, P channels, R runs, B bearings, A unknowns that members have.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from pipeline.coefficients import is_direct
from pipeline.comparison.method import Reason, Refusal, Task
from pipeline.equations.identifiability import DEPENDENT
from pipeline.equations.response import ResponseEquations
from pipeline.identification.response_identifiability import UNEQUAL


@dataclass(frozen=True, eq=False)
class Parameters:
    """x (S, A) stands for ``size exp(x)`` of a direct coefficient, ``size x`` of a cross-coupled one."""

    task: Task
    size: np.ndarray  # (A,) N/m and N s/m
    positive: np.ndarray  # (A,)

    def values(self, x: np.ndarray) -> np.ndarray:
        """(M, S, U) unknowns."""
        return self.task.active_values(self.size * np.where(self.positive, np.exp(np.where(self.positive, x, 0.0)), x))

    def from_values(self, values: np.ndarray) -> np.ndarray:
        """(S, A) from unknowns (M, S, U); what must be positive is kept above a thousandth of its size."""
        columns = []
        for a, (m, u) in enumerate(self.task.active):
            own = values[m, :, u] / self.size[a]
            columns.append(np.log(np.maximum(own, _SMALLEST)) if self.positive[a] else own)
        return np.stack(columns, axis=1)

    def slope(self, x: np.ndarray) -> np.ndarray:
        """(S, A) derivative of the unknowns by x."""
        return np.asarray(self.size * np.where(self.positive, np.exp(np.where(self.positive, x, 0.0)), 1.0))

    def sensitivity(self, equations: ResponseEquations, x: np.ndarray) -> np.ndarray:
        """(S, P, R, A) derivative of the response by x."""
        return self.derivative(equations, self.values(x)) * self.slope(x)[:, None, None]

    def derivative(self, equations: ResponseEquations, values: np.ndarray) -> np.ndarray:
        """(S, P, R, A) derivative of the response by the active unknowns, at unknowns (M, S, U)."""
        task = self.task
        by_coefficient = equations.sensitivity(task.table(values))
        expansion = task.unknowns.expansion
        columns = []
        for m, u in task.active:
            moved = expansion[:, :, u] if task.alike else expansion[:, :, u] * (np.arange(len(expansion)) == m)[:, None]
            columns.append(np.einsum("sprbc,bc->spr", by_coefficient, moved))
        return np.stack(columns, axis=-1)


_SMALLEST = 1e-3


def require_determined(task: Task, together: bool) -> None:
    """Raise Refusal where the readings leave a combination of the unknowns free: all speeds ``together``, or each.

    Asked about bearings of the size of the guess that are alike: what their symmetry hides is hidden near it, too.
    """
    shape = np.array([UNEQUAL[2 * (name[1] == "y") + (name[2] == "y")] for name in task.unknowns.names])
    values = np.repeat((np.abs(task.guess()) * shape)[:, None], len(task.dataset.speeds), axis=1)
    parameters = parameters_of(task)
    rows = parameters.derivative(task.response(), values) / task.deviation[..., None]
    real = real_rows(rows)
    real = real.reshape(1, -1, real.shape[-1]) if together else real
    length = np.linalg.norm(real, axis=1, keepdims=True)
    singular = np.linalg.svd(real / np.where(length > 0, length, 1.0), compute_uv=False)
    enough = real.shape[1] >= real.shape[2]
    if not enough or np.median(singular[:, -1] / singular[:, 0]) < DEPENDENT:
        where = "all speeds together" if together else "a speed by itself"
        raise Refusal(
            Reason.NOT_DETERMINED,
            f"at {where} {task.sensors} leave{'s' * (task.n_nodes == 1)} a combination of them free",
        )


def parameters_of(task: Task, size: np.ndarray | None = None) -> Parameters:
    """The free numbers, with sizes (M, U) of the unknowns or the configured guesses."""
    of = task.guess() if size is None else size
    return Parameters(
        task,
        np.array([of[m, u] for m, u in task.active]),
        np.array([is_direct(task.unknowns.names[u]) for _, u in task.active]),
    )


def real_rows(values: np.ndarray) -> np.ndarray:
    """Complex numbers (S, P, R, ..) as rows of each speed (S, 2 P R, ..): real parts, then imaginary ones."""
    flat = values.reshape(len(values), -1, *values.shape[3:])
    return np.concatenate([flat.real, flat.imag], axis=1)
