"""What the data determine, before any fit: rank, condition, the combination left free, and a verdict in words.

At one speed a bearing has up to eight real unknowns, and each run gives two complex equations: two runs with
independent orbits determine all eight, one leaves four free. On an axisymmetric rotor unbalance excites forward whirl
alone, and backward whirl comes from anisotropic bearings. Where one bearing alone is anisotropic, its own backward
whirl is in a fixed ratio to its forward whirl: its orbits are multiples of each other, whatever the planes and phases.

Legend: S speeds, R runs, B bearings, U unknowns, M members (see :mod:`pipeline.problem.residual`).
"""

from __future__ import annotations

from dataclasses import dataclass
from enum import Enum

import numpy as np

from pipeline.errors import IdentifiabilityError
from pipeline.problem.noise import DEPENDENT
from pipeline.problem.ranking import list_leading
from pipeline.problem.residual import BearingEquations, LinearResidual


class Solvability(Enum):
    """What can be said of a bearing."""

    IDENTIFIABLE = "identifiable"
    ACROSS_SPEEDS = "identifiable only across speeds"
    NOT_IDENTIFIABLE = "not identifiable"


@dataclass(frozen=True, eq=False, kw_only=True)
class Identifiability:
    """What the data determine of one bearing, or of all together."""

    nodes: tuple[int, ...]
    unknowns: tuple[str, ...]  # U of this bearing
    speeds: np.ndarray  # (S,) rad/s
    singular_values: np.ndarray  # (S, U), of A with columns of unit length
    free: np.ndarray  # (S, U) the combination that the data determine least, in shares of the bearing force
    verdict: Solvability
    reason: str  # why not, and what to add; empty where identifiable
    orbit_rank: np.ndarray  # (S,) how many orbits of the runs are independent, of 2; NaN where no motion is known
    orbit_condition: np.ndarray  # (S,) condition number of the orbits; NaN likewise
    together: str = "which share their coefficients"  # why several bearings are judged together

    @property
    def rank(self) -> np.ndarray:
        """(S,) how many combinations of the unknowns each speed determines."""
        return count_determined(self.singular_values)

    @property
    def condition(self) -> np.ndarray:
        """(S,) condition number of the unknowns."""
        return condition_number(self.singular_values)

    @property
    def where(self) -> str:
        """The bearing in words."""
        if len(self.nodes) == 1:
            return f"bearing at node {self.nodes[0]}"
        return f"bearings at nodes {', '.join(map(str, self.nodes))}, {self.together}"

    @property
    def sentence(self) -> str:
        """The verdict in words. Rank knows of no noise; :mod:`pipeline.problem.determination` does."""
        without_noise = " without noise" if self.verdict is Solvability.IDENTIFIABLE else ""
        return f"{self.where}: {self.verdict.value}{without_noise}" + (
            f", because {self.reason}" if self.reason else ""
        )

    def free_combination(self, least: float = 0.1) -> str:
        """The least determined combination at the speed of the median condition, such as ``0.71 kxx - 0.70 kxy``.

        Shares below ``least`` are left out.
        """
        vector = self.free[int(np.argsort(self.condition)[len(self.condition) // 2])]
        shown = list_leading(dict(zip(self.unknowns, vector, strict=True)), least)
        phrases = [f"{'-' if share < 0 else '+'} {abs(share):.2f} {name}" for name, share in shown.items()]
        return " ".join(phrases).removeprefix("+ ")


def judge_identifiability(
    equations: BearingEquations, residual: LinearResidual, constant: bool
) -> tuple[Identifiability, ...]:
    """One judgement a member; ``constant`` where the unknowns are the same at every speed."""
    members, every = residual.by_member(), tuple(range(len(equations.bearing_nodes)))
    groups = [every] if residual.unknowns.shared else [(b,) for b in every]
    return tuple(
        _judge(equations, members, m, bearings, constant)
        for m, bearings in enumerate(groups)
        if members.unknowns.present[m].any()
    )


def _judge(
    equations: BearingEquations, members: LinearResidual, m: int, bearings: tuple[int, ...], constant: bool
) -> Identifiability:
    present = members.unknowns.present[m]
    names = tuple(name for name, identified in zip(members.unknowns.names, present, strict=True) if identified)
    matrix = members.matrix[m][..., present]
    singular, free = decompose(unit_columns(matrix))
    rank = count_determined(singular)
    somewhere = (rank == len(names)).any()
    if constant and not somewhere:  # all speeds together tell unknowns that are the same at every speed
        every = (matrix / np.abs(matrix).max(axis=(1, 2), keepdims=True)).reshape(-1, matrix.shape[-1])
        somewhere = np.linalg.matrix_rank(unit_columns(every), tol=DEPENDENT) == len(names)
    # The orbits (x, y) of the runs have unit size each; the best bearing counts.
    orbits = [decompose(unit_columns(equations.displacement[b]).conj().swapaxes(1, 2))[0] for b in bearings]
    orbit_rank = np.max([count_determined(each) for each in orbits], axis=0)
    alone, never = f"the runs do not determine {', '.join(names)}", _reason(names, rank, orbit_rank, equations)
    verdict, reason = judge_rank(rank, len(names), bool(somewhere), alone, never)
    return Identifiability(
        nodes=tuple(equations.bearing_nodes[b] for b in bearings),
        unknowns=names,
        speeds=equations.speeds,
        singular_values=singular,
        free=free,
        verdict=verdict,
        reason=reason,
        orbit_rank=orbit_rank,
        orbit_condition=np.min([condition_number(each) for each in orbits], axis=0),
    )


def judge_rank(rank: np.ndarray, wanted: int, across: bool, alone: str, never: str) -> tuple[Solvability, str]:
    """The verdict on ``wanted`` unknowns of which each speed determines ``rank`` (S,), and why.

    Args:
        across: whether the speeds together determine them all.
        alone: what a speed by itself lacks, in words, where they do.
        never: why they are not determined and what to add, where they do not.
    """
    if (rank == wanted).all():
        return Solvability.IDENTIFIABLE, ""
    if not across:
        return Solvability.NOT_IDENTIFIABLE, never
    return Solvability.ACROSS_SPEEDS, f"at {(rank < wanted).sum()} of {len(rank)} speeds by themselves {alone}"


def unit_columns(matrix: np.ndarray) -> np.ndarray:
    """Columns of unit length: stiffness and damping differ by orders of magnitude, and orbits are judged, not units."""
    length = np.linalg.norm(matrix, axis=-2, keepdims=True)
    return matrix / np.where(length > 0, length, 1.0)


def decompose(columns: np.ndarray, alike: float = 1e-6) -> tuple[np.ndarray, np.ndarray]:
    """(S, U) singular values, zero where there are fewer rows than unknowns; (S, U) the direction of the smallest.

    Where smallest ones tie, it is what of the first unknown that lies most in their plane: no matter of rounding.
    """
    _, singular, right = np.linalg.svd(columns, full_matrices=True)
    padded = np.zeros(columns.shape[::2])
    padded[:, : singular.shape[1]] = singular
    tied = padded <= (1 + alike) * padded[:, -1:] + DEPENDENT * padded[:, :1]
    plane = right.conj().swapaxes(1, 2) @ (right * tied[..., None])
    shares = plane.diagonal(axis1=1, axis2=2).real
    most = np.argmax(shares > (1 - alike) * shares.max(axis=1, keepdims=True), axis=1)[:, None]
    least = np.take_along_axis(plane, most[..., None], axis=1)[:, 0]
    return padded, least / np.sqrt(np.take_along_axis(shares, most, axis=1))


def count_determined(singular: np.ndarray) -> np.ndarray:
    """(S,) how many of the singular values (S, U) data in double precision can tell from zero."""
    return np.asarray((singular > DEPENDENT * singular[:, :1]).sum(axis=1))


def condition_number(singular: np.ndarray) -> np.ndarray:
    """(S,) ratio of the largest to the smallest singular value (S, U); infinite where that is zero."""
    with np.errstate(divide="ignore", invalid="ignore"):
        return np.asarray(singular[:, 0] / singular[:, -1])


def _reason(names: tuple[str, ...], rank: np.ndarray, orbit_rank: np.ndarray, equations: BearingEquations) -> str:
    n_runs, best = equations.displacement.shape[-1], int(rank.max())
    determined = f"at every speed the {n_runs} run{'s' * (n_runs > 1)} determine {best} of {len(names)} unknowns"
    cures = "a run of another whirl (backward) or frequency, fewer unknowns, or a structure (identify.structure)"
    if orbit_rank.max() < 2 and n_runs > 1:
        return (
            f"{determined}: their orbits are multiples of each other (rank 1 of 2), as those of all unbalances are "
            f"where the other bearings are isotropic; add {cures}"
        )
    if n_runs == 1:
        return f"{determined}: a run gives 2 real equations for the force in x and 2 in y; add {cures}"
    return f"{determined}; add {cures}"


def require_identifiable(reports: tuple[Identifiability, ...]) -> None:
    """Raise IdentifiabilityError for a bearing whose unknowns the runs determine at no speed."""
    for report in reports:
        if report.verdict is Solvability.NOT_IDENTIFIABLE:
            raise IdentifiabilityError(f"{report.sentence}. force=true trains all the same")
