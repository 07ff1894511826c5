"""The balance sheet: which weights go into which holes, what unbalance and vibration are expected, what may remain.

A machine shows y and has the weights w on it. The weights c change that by ``predict(w + c) - predict(w)``, whatever
the machine's own unbalance, bow and runout are. The unbalance that a vibration v means is ``G v``, with the generalised
inverse ``G = (J^H S^-1 J)^-1 J^H S^-1`` of the influence coefficients J, S the covariance of what one record shows.

What may remain follows ISO 21940-11. The permissible residual unbalance of the whole rotor is shared by its bearings as
the centre of mass lies between them, at least 30 and at most 70 % each. What remains in the planes acts on the bearings
by the lever. The standard is for rotors that stay stiff up to the service speed. The formulas are written from
knowledge of it, no edition was at hand.

Legend: N planes, D = S P (speed slowest), M entries of D that were read.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal

import numpy as np

from pipeline.balance.correction import Holes, Weight, choose_weights
from pipeline.balance.linear_vibration import LinearVibration, bound_size, circle_radius, invert_influence
from pipeline.config.balance import BalanceConfig
from pipeline.data.conditions import Conditions
from pipeline.errors import ConfigError, nearest
from pipeline.rotor.model import DOF_PER_NODE, RotorModel


@dataclass(frozen=True, eq=False, kw_only=True)
class State:
    """What is to be corrected: the vibration that the machine shows, the part to be removed, the weights on it."""

    shown: np.ndarray  # (D,) complex m; NaN where nothing was read
    remove: np.ndarray  # (D,) complex m, NaN likewise
    weights: np.ndarray  # (N,) complex kg m, known weights on the machine; zero for the machine as it is


def require_state(readings: Conditions, asked: BalanceConfig, subtracted: str | None) -> None:
    """Raise ConfigError for a condition that was not read, and for the machine's own unbalance where its vibration was
    ``subtracted`` from the data.
    """
    if asked.remove != "condition" and subtracted is not None:
        raise ConfigError(
            f"the machine's own unbalance must be in the data, but its vibration (data.baseline={subtracted})"
            " was subtracted: name a condition to correct (balance.condition, balance.remove=condition)"
        )
    if asked.remove != "residual" and asked.condition not in readings.names:
        raise ConfigError(
            f"balance.condition must be a condition of the records, but got '{asked.condition}': "
            f"{nearest(str(asked.condition), readings.names)}"
        )


def find_state(vibration: LinearVibration, readings: Conditions, asked: BalanceConfig) -> State:
    """What the machine shows, and which part of it is to be taken away, as :func:`require_state` has seen to."""
    nothing = np.zeros(len(vibration.planes), dtype=complex)
    bare = predict_one(vibration, nothing)
    if asked.remove == "residual":
        return State(shown=bare, remove=bare, weights=nothing)
    c = readings.names.index(str(asked.condition))
    shown, known = readings.vectors[c], readings.unbalance[c]
    remove = shown - bare if asked.remove == "condition" else shown
    return State(shown=shown, remove=remove, weights=nothing if np.isnan(known).any() else known)


@dataclass(frozen=True, eq=False, kw_only=True)
class BalanceSheet:
    """The chosen weights and what they leave."""

    weights: tuple[tuple[Weight, ...], ...]  # N
    correction: np.ndarray  # (N,) complex kg m, of these weights
    unbalance: np.ndarray  # (N,) complex kg m, that was to be removed
    remaining: np.ndarray  # (N,) complex kg m
    covariance: np.ndarray  # (N, N) complex kg^2 m^2, of both
    circle: np.ndarray  # (N,) kg m, radius about each vector that holds 95 %
    before: np.ndarray  # (D,) complex m
    after: np.ndarray  # (D,) complex m
    half_width: np.ndarray  # (D,) m, half of the 95 % band of the real and of the imaginary part of one record after

    def at_most(self) -> np.ndarray:
        """(N,) kg m, what the size of each remaining vector exceeds with 5 % chance."""
        return bound_size(self.remaining, self.circle)


def propose_weights(
    vibration: LinearVibration,
    state: State,
    holes: Sequence[Holes | None],
    minimise: Literal["unbalance", "vibration"] = "unbalance",
    speeds: Sequence[int] = (),
    passes: int = 5,
) -> BalanceSheet:
    """The weights that leave least of what is to be removed.

    Least unbalance is that in root mean square over the planes, least vibration that over the probes at the ``speeds``
    (indices; none stands for all). ``holes`` (N) are None in a plane that can take no weights. The search is repeated,
    at most ``passes`` times, with the influence coefficients at the weights chosen before; they hardly change.

    Raises ConfigError where there are too many choices, or the vibration does not tell the planes apart.
    """
    speed_index = np.repeat(np.arange(len(vibration.speeds)), len(vibration.channels))
    read = ~np.isnan(state.shown) & (np.isin(speed_index, speeds) if len(speeds) else True)
    means, spreads = vibration.predict(state.weights[None])
    noise, record = vibration.noise, vibration.noise.covariance(np.ones(1))[0]
    start, inside = means[0], (spreads[0] + record)[np.ix_(read, read)]  # of a record with these weights
    correction = np.zeros(len(vibration.planes), dtype=complex)
    active, given = [n for n, hole in enumerate(holes) if hole], [hole for hole in holes if hole]
    weights: tuple[tuple[Weight, ...], ...] = ()
    for _ in range(passes):
        influence = vibration.influence_at(state.weights + correction)[0][read]
        change = (predict_one(vibration, state.weights + correction) - start)[read]
        remaining = state.remove[read] + change - influence @ correction
        inverse, spread = invert_influence(influence, inside)
        acting, left = (np.eye(len(holes)), inverse @ remaining) if minimise == "unbalance" else (influence, remaining)
        chosen, unbalance = choose_weights(acting[:, active], left, given)
        if chosen == weights:
            break
        weights, correction[active] = chosen, unbalance
    by_plane = dict(zip(active, weights, strict=True))
    means, spreads = vibration.predict((state.weights + correction)[None])
    after = means[0] - start
    return BalanceSheet(
        weights=tuple(by_plane.get(n, ()) for n in range(len(holes))),
        correction=correction,
        unbalance=inverse @ state.remove[read],
        remaining=inverse @ (state.remove + after)[read],
        covariance=spread,
        circle=circle_radius(noise.stretch * np.diag(spread).real, noise.tail or noise.freedom),
        before=state.shown,
        after=state.shown + after,
        half_width=noise.half_width(np.diag(spreads[0] + record).real),
    )


def predict_one(vibration: LinearVibration, weights: np.ndarray) -> np.ndarray:
    """(D,) complex m, the mean vector with the ``weights`` (N,) kg m."""
    return vibration.predict(weights[None])[0][0]


# --- tolerance ---------------------------------------------------------------------------------------


@dataclass(frozen=True, eq=False, kw_only=True)
class Tolerance:
    """At each of the two bearings: what may remain, and by how much each plane acts there."""

    nodes: tuple[int, int]
    permissible: np.ndarray  # (2,) kg m
    levers: np.ndarray  # (2, N)

    def remaining(self, unbalance: np.ndarray) -> np.ndarray:
        """(2,) complex kg m at the bearings, of (N,) in the planes."""
        return self.levers @ unbalance

    def circle(self, covariance: np.ndarray, circle: np.ndarray) -> np.ndarray:
        """(2,) kg m, 95 % circles at the bearings, of ``covariance`` (N, N) and ``circle`` (N,) kg m in the planes."""
        variance = np.einsum("bn,nm,bm->b", self.levers, covariance, self.levers).real
        return np.sqrt(variance * circle[0] ** 2 / covariance[0, 0].real)


def share_tolerance(
    rotor: RotorModel, planes: Sequence[int], permissible: float, least: float = 0.3, most: float = 0.7
) -> Tolerance:
    """``permissible`` (kg m) of the whole rotor at its bearings, to each a share from ``least`` to ``most``.

    Raises ConfigError where there are not two of them.
    """
    if len(rotor.bearing_nodes) != 2:
        raise ConfigError(
            "machine.balance.tolerance must be that of a rotor on two bearings (ISO 21940-11 shares it between them), "
            f"but this one has {len(rotor.bearing_nodes)}: leave tolerance out"
        )
    first, second = sorted(rotor.bearing_nodes, key=lambda node: rotor.positions[node])
    begin, span = rotor.positions[first], rotor.positions[second] - rotor.positions[first]
    beyond = (rotor.positions[list(planes)] - begin) / span  # 0 at the first bearing, 1 at the second
    share = float(np.clip((find_centre(rotor) - begin) / span, least, most))
    return Tolerance(
        nodes=(first, second),
        permissible=permissible * np.array([1 - share, share]),
        levers=np.array([1 - beyond, beyond]),
    )


def find_centre(rotor: RotorModel) -> float:
    """m along the shaft, the centre of mass: the first moment that the mass matrix has of a rigid tilt."""
    shifted, tilted = np.zeros(rotor.n_dof), np.zeros(rotor.n_dof)
    shifted[::DOF_PER_NODE] = 1.0
    tilted[::DOF_PER_NODE] = rotor.positions
    tilted[3::DOF_PER_NODE] = 1.0  # beta = dx/dz
    return float(shifted @ rotor.mass @ tilted / (shifted @ rotor.mass @ shifted))
