"""Noise in levels: records of one condition scatter about their mean, and conditions drift about what they should show.

A condition's mean of n records, y = design @ coefficients + e, has the covariance of its level plus that of the records
divided by n. Both are circular complex. The levels are estimated by restricted maximum likelihood (REML): in closed
form where the numbers of records are equal, by expectation and maximisation (EM) otherwise. A bad condition is weighed
down by a multivariate Student t likelihood (Lange, Little and Taylor 1989), whose scatter is divided by what Gaussian
data would give, so that clean data have no bias.

Legend: C conditions, R runs (one a condition), S speeds, P channels, Q columns of the design, D = S P.
"""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from functools import cache

import numpy as np

from pipeline.data.conditions import Conditions
from pipeline.errors import IdentifiabilityError

FULL = 3
"""Degrees of freedom for each entry of a vector from which on the condition level is a full matrix, not shrunk."""
TAIL = 4.0
"""Degrees of freedom of the Student t that weighs conditions."""


@dataclass(frozen=True, eq=False)
class NoiseLevels:
    """Covariances of one record about its condition, and of a condition about the model; and what they mean for runs
    that are such conditions. :data:`pipeline.problem.condition_noise.NO_LEVELS` where readings have noise of their own.
    """

    record: np.ndarray  # (S, P, P) complex, m^2
    condition: np.ndarray  # (D, D) complex, m^2, index s * P + p
    freedom: float  # complex degrees of freedom behind the condition level; 0: a guess, infinite: known
    tail: float | None = None  # complex degrees of freedom of a condition's Student t; None: the freedom alone
    stretch: float = 1.0  # of the covariance, with that tail
    counts: np.ndarray = field(default_factory=lambda: np.zeros(0))  # (R,) records behind each run; none of no runs
    weights: np.ndarray = field(default_factory=lambda: np.zeros(0))  # (R,) about 1; small for a stranger among them

    def __bool__(self) -> bool:
        """Whether there are runs with noise in levels."""
        return bool(len(self.counts))

    def half_width(self, variance: np.ndarray, level: float = 0.95) -> np.ndarray:
        """Half of the interval of the real and of the imaginary part, for complex variances; infinite for a guess."""
        return np.asarray(student_factor(self.tail or self.freedom, level) * np.sqrt(self.stretch * variance / 2))

    def covariance(self, counts: np.ndarray) -> np.ndarray:
        """(C, D, D) complex, m^2, of means of ``counts`` (C,) records."""
        return np.asarray(self.condition + spread_blocks(self.record) / np.asarray(counts)[:, None, None])

    def deviation(self) -> np.ndarray:
        """(S, P, R) m, root mean square of each reading's noise."""
        variance = np.diagonal(self.covariance(self.counts), axis1=1, axis2=2).real  # (R, D)
        return np.asarray(np.sqrt(variance).reshape(-1, *self.record.shape[:2]).transpose(1, 2, 0))

    def mixing(self) -> np.ndarray:
        """(R, D, D): it makes readings over their own deviations independent."""
        covariance = self.covariance(self.counts)
        spread = np.sqrt(np.diagonal(covariance, axis1=1, axis2=2).real)
        correlation = covariance / spread[:, :, None] / spread[:, None, :]
        return np.asarray(np.linalg.inv(np.linalg.cholesky(correlation)))

    def conjugated(self) -> NoiseLevels:
        """That of conjugated readings."""
        return replace(self, record=self.record.conj(), condition=self.condition.conj())

    def select(self, speeds: np.ndarray, runs: np.ndarray | None) -> NoiseLevels:
        """The same at the ``speeds`` (mask or index) and for the ``runs`` (indices; None for all)."""
        if not self:
            return self
        kept = np.arange(len(self.condition)).reshape(self.record.shape[:2])[speeds].ravel()
        chosen = np.arange(len(self.counts)) if runs is None else runs
        return replace(
            self,
            record=self.record[speeds],
            condition=self.condition[np.ix_(kept, kept)],
            counts=self.counts[chosen],
            weights=self.weights[chosen],
        )


def student_factor(freedom: float, level: float = 0.95) -> float:
    """Half of an interval in standard deviations, for ``freedom`` complex degrees of freedom; infinite for none."""
    from scipy.special import ndtri, stdtrit

    if freedom <= 0:
        return float("inf")
    return float(stdtrit(2 * freedom, 0.5 + level / 2) if np.isfinite(freedom) else ndtri(0.5 + level / 2))


def fit_tail(distance: np.ndarray, size: int, freedom: float, below: float = np.inf) -> tuple[float, float]:
    """How heavy the tails of conditions are: complex degrees of freedom, and the stretch of their covariance.

    ``distance`` (C,) are the squared distances T^2 of conditions from models that know nothing of them, each with
    ``freedom`` degrees of freedom, for vectors of ``size`` entries. A multivariate Student t makes them
    stretch size F(2 size, 2 tail); Gaussian conditions have tail = freedom - size + 1 (Hotelling), which is the most.
    Distances that were chosen because they lie ``below`` another are fitted as such.
    """
    from scipy import optimize, special

    most = freedom - size + 1

    def loss(at: np.ndarray) -> float:
        tail, stretch = np.exp(at)
        ratio = distance / (stretch * tail)
        density = size * np.log(ratio) - np.log(distance) - (size + tail) * np.log1p(ratio)
        chosen = np.log(special.fdtr(2 * size, 2 * tail, below / (stretch * size)) + np.finfo(float).tiny)
        return -float((density - special.betaln(size, tail) - chosen).sum())

    start = [np.log(min(most, 8.0)), 0.0]
    minimum = optimize.minimize(loss, start, method="L-BFGS-B", bounds=[(np.log(0.5), np.log(most)), (-3.0, 3.0)])
    return float(np.exp(minimum.x[0])), float(np.exp(minimum.x[1]))


def spread_blocks(record: np.ndarray) -> np.ndarray:
    """(D, D) with the blocks of the speeds (S, P, P) on its diagonal."""
    from scipy.linalg import block_diag

    return np.asarray(block_diag(*record), dtype=complex)


def estimate_noise_levels(
    conditions: Conditions, design: np.ndarray, robust: bool = True
) -> tuple[NoiseLevels, np.ndarray]:
    """The levels, and the weight of each condition (C,), about 1 and small for one that does not belong to the others.

    ``design`` (C, Q) complex has what each channel's vector is a linear function of (a column of ones, the weights).
    With fewer than three degrees of freedom for each entry of a vector, the correlations of the condition level are
    shrunk by the share :func:`shrinkage_share`. Raises IdentifiabilityError where none is left.
    """
    vectors = conditions.vectors
    left = len(design) - np.linalg.matrix_rank(design)
    if left <= 0:
        raise IdentifiabilityError(
            f"the drift between conditions must be estimated from more conditions than the {design.shape[1]} "
            f"columns of their model, but there are {len(design)}: measure more conditions"
        )
    weights = robust_weights(vectors, design) if robust else np.ones(len(design))
    residual = vectors - design @ solve_weighted(vectors, design, weights)
    return levels_of(residual, weights, float(left), conditions.record_covariance, conditions.counts), weights


def levels_of(
    residual: np.ndarray, weights: np.ndarray, left: float, record_covariance: np.ndarray, counts: np.ndarray
) -> NoiseLevels:
    """The levels that explain the residuals (C, D) m, which have ``left`` complex degrees of freedom.

    ``weights`` are those of :func:`robust_weights`, or ones; ``record_covariance`` (S, P, P) is that of one record,
    ``counts`` (C,) are the records behind each residual.
    """
    record = spread_blocks(record_covariance)
    scale, alike = left / len(residual), np.ptp(weights) == 0.0
    k = 1.0 if alike else consistency(residual.shape[1], round(left, 6))  # of Gaussian data
    total = np.asarray((residual.T * weights) @ residual.conj()) / len(residual) / k / scale
    freedom = left * weights.sum() ** 2 / (weights**2).sum() / len(weights)
    total = shrink(total, freedom)
    level = total - record * np.mean(1 / counts)
    values, vectors = np.linalg.eigh((level + level.conj().T) / 2)  # the nearest without negative eigenvalues
    level = (vectors * np.maximum(values, 1e-9 * max(values[-1], 0.0))) @ vectors.conj().T
    if len(set(counts.tolist())) > 1:
        level = _maximise(residual * np.sqrt(weights / (k * scale))[:, None], record, counts, level)
    return NoiseLevels(record_covariance, level, freedom)


def robust_weights(vectors: np.ndarray, design: np.ndarray, steps: int = 200, tolerance: float = 1e-7) -> np.ndarray:
    """(C,) weights of the Student t likelihood with :data:`TAIL` degrees of freedom, for a linear model of the vectors.

    With too few conditions for a scatter of all D entries, the weights follow from the shrunk one.
    """
    weights, previous = np.ones(len(vectors)), np.zeros(len(vectors))
    left = len(design) - np.linalg.matrix_rank(design)
    for _ in range(steps):
        residual = vectors - design @ solve_weighted(vectors, design, weights)
        weights = student_weights(residual, weights, float(left))
        if abs(weights - previous).max() < tolerance:
            break
        previous = weights
    return weights


def student_weights(residual: np.ndarray, weights: np.ndarray, left: float) -> np.ndarray:
    """(C,) weights of residuals (C, D), which have ``left`` degrees of freedom, about the scatter matrix of the Student
    t that they have with the ``weights`` (C,) before.
    """
    scatter = shrink((residual.T * weights) @ residual.conj() / left, left)
    apart, size = residual * np.sqrt(len(residual) / left), residual.shape[1]
    distance = np.einsum("ci,ic->c", apart.conj(), np.linalg.solve(scatter, apart.T)).real
    return np.asarray((TAIL + 2 * size) / (TAIL + 2 * distance))


def solve_weighted(vectors: np.ndarray, design: np.ndarray, weights: np.ndarray) -> np.ndarray:
    """(Q, D) coefficients; the same for every covariance, since all entries of a vector have one design."""
    root = np.sqrt(weights)[:, None]
    return np.asarray(np.linalg.lstsq(design * root, vectors * root, rcond=None)[0])


@cache
def consistency(size: int, left: float) -> float:
    """Scatter that the Student t likelihood gives of Gaussian data with unit covariance and ``size`` complex entries.

    It solves E[w(d / k) d] = k size, where d is the distance of a residual from a fit that leaves ``left`` degrees of
    freedom: left times a Beta(size, left - size), which is a Gamma(size) for many conditions.
    """
    from scipy import optimize, stats

    share = (np.arange(2000) + 0.5) / 2000
    distance = left * stats.beta.ppf(share, size, max(left - size, 1.0))

    def excess(k: float) -> float:
        return float(np.mean((TAIL + 2 * size) / (TAIL + 2 * distance / k) * distance)) - k * float(np.mean(distance))

    return float(optimize.brentq(excess, 0.05, 2.0))


def leave_one_out(residual: np.ndarray, leverage: np.ndarray, weights: np.ndarray, left: float) -> np.ndarray:
    """(C,) squared distances T^2 of each condition from the model of the others, with left - 1 degrees of freedom.

    ``residual`` (C, D) and ``leverage`` (C,) are those of the fit of all, with these ``weights``.
    """
    ratio = weights / (1.0 if np.ptp(weights) == 0 else consistency(residual.shape[1], round(left, 6)))
    scatter = (residual.T * ratio) @ residual.conj()
    size = np.einsum("ci,ic->c", residual.conj(), np.linalg.solve(scatter, residual.T)).real
    kept = 1 - weights * leverage
    size = size / np.maximum(1 - ratio * size / kept, np.finfo(float).eps)
    return np.asarray((left - 1) * size / kept**2 / (1 + leverage / kept))


def shrink(covariance: np.ndarray, freedom: float) -> np.ndarray:
    """The covariance (D, D) with its correlations times 1 - share where the freedom is less than 3 D."""
    if freedom >= FULL * len(covariance):
        return covariance
    kept = 1 - shrinkage_share(covariance, freedom)
    return np.asarray(covariance * (kept + (1 - kept) * np.eye(len(covariance))))


def shrinkage_share(covariance: np.ndarray, freedom: float) -> float:
    """Share of the diagonal in a shrunk covariance: sum of the variances of the entries beside it over their squares.

    The variance of an entry of circular Gaussian data is the product of the two on the diagonal over the freedom
    (complex Wishart); the law is that of Ledoit and Wolf (2004) as Schaefer and Strimmer (2005) have it.
    """
    deviation = np.sqrt(np.diag(covariance).real)
    beside = ~np.eye(len(covariance), dtype=bool)
    squares = (abs(covariance / deviation[:, None] / deviation)[beside] ** 2).sum()
    return float(min(1.0, beside.sum() / freedom / squares)) if squares > 0 else 1.0


def _maximise(
    scaled: np.ndarray,
    record: np.ndarray,
    counts: np.ndarray,
    level: np.ndarray,
    steps: int = 200,
    tolerance: float = 1e-7,
) -> np.ndarray:
    """EM of the condition level where the conditions' numbers of records differ, from weighted residuals (C, D)."""
    for _ in range(steps):
        expected = np.zeros_like(level)
        for n in np.unique(counts):
            rows = scaled[counts == n]
            gain = level @ np.linalg.inv(level + record / n)
            drift = rows @ gain.T
            expected += drift.T @ drift.conj() + len(rows) * (level - gain @ level)
        step = expected / len(scaled)
        done = abs(step - level).max() < tolerance * abs(level).max()
        level = step
        if done:
            break
    return level
