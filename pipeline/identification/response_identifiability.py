"""What sensors that are too few for the forces at the bearings still determine, from the response's own derivative.

All bearings speak through the same sensors, so the account is one of all of them. Neighbouring speeds help each
other as far as the network is smooth; the deviation that the stated noise implies for all speeds tells how far.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from pipeline.equations.identifiability import DEPENDENT, Identifiability, Verdict
from pipeline.identification.response_fit import unknown_deviation
from pipeline.identification.response_preparation import PreparedResponse, start_at

UNEQUAL = np.array([1.0, 0.2, -0.3, 0.7])
"""xx, xy, yx, yy of the bearing that the account is made at, over the guess: one alike in all directions would show
circular orbits, from which less follows than from those of real bearings."""
_LEARNT = 1.0
"""A coefficient that is known to no better than itself was not determined."""


@dataclass(frozen=True, eq=False)
class ResponseAccount:
    """An account, and the deviation of the whole parametrisation that belongs to it."""

    account: Identifiability
    values: np.ndarray  # (M, S, U) the unknowns that it was made at, N/m and N s/m
    deviation: np.ndarray  # (M, S, U) N/m and N s/m; zero where a member lacks an unknown


def response_account(prepared: PreparedResponse, guess: np.ndarray) -> ResponseAccount:
    """The account near a bearing of the size of ``guess`` (M, U): its direct coefficients serve for all."""
    problem = prepared.problem
    names = prepared.training.unknowns.names
    shape = np.array([UNEQUAL[2 * (name[1] == "y") + (name[2] == "y")] for name in names])
    given = list(zip(np.abs(guess[0]), names, strict=True))
    sizes = {kind: max((size for size, name in given if name[0] == kind), default=1.0) for kind in "kc"}
    values = np.array([sizes[name[0]] for name in names]) * shape
    n_speeds = problem.features.shape[1]
    values = np.broadcast_to(values, (len(problem.scale), n_speeds, len(names)))
    free = start_at(problem, values)
    rows = problem.sensitivity(free)  # (S, rows, A), by the outputs, whitened
    length = np.linalg.norm(rows, axis=1, keepdims=True)
    columns = rows / np.where(length > 0, length, 1.0)
    _, singular, right = np.linalg.svd(columns, full_matrices=True)
    padded = np.zeros((n_speeds, rows.shape[2]))
    padded[:, : singular.shape[1]] = singular
    rank = (padded > DEPENDENT * padded[:, :1]).sum(axis=1)
    # With all features of the network, each of a size up to a thousand.
    relative = unknown_deviation(problem, free, _WIDE)[0] / problem.unknowns(free)[0][0].abs().numpy()  # (S, A)
    deviation = np.zeros_like(values)
    for a, (m, u) in enumerate(problem.active):
        deviation[m, :, u] = relative[:, a] * np.abs(values[m, :, u])
    labels = tuple(_label(prepared, m, u) for m, u in problem.active)
    verdict, reason = _verdict(labels, rank, np.median(relative, axis=0), prepared)
    with np.errstate(divide="ignore", invalid="ignore"):
        condition = padded[:, 0] / padded[:, -1]
    nodes = prepared.training.bearing_nodes
    speeds = prepared.data.equations.speeds[prepared.keep]
    none = np.full(n_speeds, np.nan)
    account = Identifiability(
        nodes,
        labels,
        speeds,
        padded,
        rank,
        condition,
        none,
        none,
        right[:, -1],
        verdict,
        reason,
        together="alike" if prepared.training.unknowns.names == labels else "seen by the same sensors",
    )
    return ResponseAccount(account, values, deviation)


def _label(prepared: PreparedResponse, m: int, u: int) -> str:
    name = prepared.training.unknowns.names[u]
    return name if len(prepared.problem.scale) == 1 else f"{name} at node {prepared.training.bearing_nodes[m]}"


_WIDE = 1e-6
"""Precision of the free numbers, so that what the sensors leave open has a finite deviation, far above 1."""


def _verdict(
    labels: tuple[str, ...], rank: np.ndarray, relative: np.ndarray, prepared: PreparedResponse
) -> tuple[Verdict, str]:
    wanted = len(labels)
    n_channels = prepared.data.displacement.shape[1]
    if (rank == wanted).all():
        return Verdict.IDENTIFIABLE, ""
    sensors = "the only sensor does" if n_channels == 1 else f"the {n_channels} sensors do"
    missing = int((rank < wanted).sum())
    unknown = [label for label, deviation in zip(labels, relative, strict=True) if deviation > _LEARNT]
    if not unknown:
        return (
            Verdict.ACROSS_SPEEDS,
            f"at {missing} of {len(rank)} speeds by themselves {sensors} not determine all {wanted} unknowns, but as "
            "smooth functions of the speed they are determined",
        )
    return (
        Verdict.NOT_IDENTIFIABLE,
        f"{sensors} not determine more than {int(rank.max())} of {wanted} unknowns at a speed, and over all speeds "
        f"not {'one of them' if len(unknown) == wanted else ', '.join(unknown)}; add sensors, a run of another whirl "
        "or frequency, or a structure (identify.structure)",
    )
