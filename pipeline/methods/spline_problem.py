"""What the spline of :mod:`pipeline.methods.spline` fits: free numbers of each speed, and how far the readings are off.

Legend: M members, S speeds, P channels, R runs, U unknowns, A active unknowns, N balance planes.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from pipeline.coefficients import is_direct
from pipeline.methods.method import differentiate_response, stack_rows
from pipeline.problem.measurement import Measurement
from pipeline.unknowns import outputs_of, scale_outputs

_UNBALANCE = 1e-4
"""kg m: the unit in which a residual unbalance is sought."""


@dataclass(frozen=True, eq=False)
class Parameters:
    """x (S, A) stands for ``size exp(x)`` of a direct coefficient, ``size x`` of a cross-coupled one."""

    task: Measurement
    size: np.ndarray  # (A,) N/m and N s/m
    positive: np.ndarray  # (A,)

    def values(self, x: np.ndarray) -> np.ndarray:
        """(M, S, U) unknowns."""
        return self.task.unknowns.from_active(scale_outputs(x, self.size, self.positive)[0])

    def from_values(self, values: np.ndarray) -> np.ndarray:
        """(S, A) from unknowns (M, S, U); what must be positive is kept above a thousandth of its size."""
        every = np.stack([values[m, :, u] for m, u in self.task.unknowns.active], axis=1)
        return np.asarray(outputs_of(every, self.size, self.positive))

    def slope(self, x: np.ndarray) -> np.ndarray:
        """(S, A) derivative of the unknowns by x."""
        slope = scale_outputs(x, self.size, self.positive)[1]
        return np.asarray(np.broadcast_to(slope, x.shape))

    def unbalance(self, pairs: np.ndarray) -> np.ndarray:
        """(N,) complex kg m, from real and imaginary parts (2 N,)."""
        return np.asarray(_UNBALANCE * (pairs[::2] + 1j * pairs[1::2]))

    def predict(self, x: np.ndarray, pairs: np.ndarray) -> np.ndarray:
        """(S, P, R) m, the response."""
        return self.task.response.predict(self.task.table(self.values(x)), self.unbalance(pairs))

    def sensitivity(self, x: np.ndarray, pairs: np.ndarray) -> np.ndarray:
        """(S, P, R, A + 2 N) derivative of the response by x and by the unbalance."""
        values = self.values(x)
        by_x = differentiate_response(self.task, values, self.unbalance(pairs)) * self.slope(x)[:, None, None]
        unit = _UNBALANCE * self.task.response.derive_by_unbalance(self.task.table(values))
        by_pairs = np.stack([unit, 1j * unit], axis=-1).reshape(*unit.shape[:-1], -1)
        return np.concatenate([by_x, by_pairs], axis=-1)


def make_parameters(task: Measurement, size: np.ndarray | None = None) -> Parameters:
    """The free numbers, with sizes (M, U) of the unknowns or the configured guesses."""
    sizes = task.guess.sizes(task.unknowns) if size is None else size
    return Parameters(
        task,
        np.array([sizes[m, u] for m, u in task.unknowns.active]),
        np.array([is_direct(task.unknowns.names[u]) for _, u in task.unknowns.active]),
    )


@dataclass(frozen=True, eq=False)
class SplineProblem:
    """Readings and weights: what does not change with the size of the spline."""

    task: Measurement
    parameters: Parameters
    weight: np.ndarray  # (S, P, R) 1/m: root of 2 over the deviation, so that real and imaginary part count

    @property
    def n_pairs(self) -> int:
        """2 N."""
        return 2 * len(self.task.unknowns.planes)

    def deviations(self, x: np.ndarray, pairs: np.ndarray) -> np.ndarray:
        """(S, rows) whitened, for x (S, A) and the residual unbalance (2 N,)."""
        return stack_rows((self.parameters.predict(x, pairs) - self.task.dataset.displacement) * self.weight)

    def sensitivity(self, x: np.ndarray, pairs: np.ndarray) -> np.ndarray:
        """(S, rows, A + 2 N) derivative of :meth:`deviations`."""
        return stack_rows(self.parameters.sensitivity(x, pairs) * self.weight[..., None])

    def reweighted(self, x: np.ndarray, pairs: np.ndarray) -> SplineProblem:
        """The same with weights from the predicted readings: the measured ones share their noise, which biases."""
        deviation = self.task.deviation_of(self.parameters.predict(x, pairs), self.task.baseline)
        return replace(self, weight=np.sqrt(2.0) / deviation)
