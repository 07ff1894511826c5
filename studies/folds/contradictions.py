"""What a condition that contradicts its label reads like: other weights, one that is missing, a shifted baseline.

In words and numbers of the labels: g mm, and angles as the machine's file counts them.

Legend: N planes, S speeds, P channels.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np

from pipeline.balance.influence import Influence
from pipeline.balance.unbalance import Unbalance, estimate_unbalance
from pipeline.config.schema import Config
from pipeline.data.conditions import Conditions
from pipeline.data.dataset import name_direction
from pipeline.data.vibration_files import to_rpm

_GRAM_MM = 1e-6
"""kg m."""


@dataclass(frozen=True, eq=False, kw_only=True)
class Contradiction:
    """A condition that contradicts its label, and what would explain it."""

    name: str
    chance: float  # that consistent conditions have one as far off, in all of them together
    label: np.ndarray  # (N,) complex, kg m
    reading: Unbalance  # what the vibration would mean
    missing: tuple[int, ...]  # planes (nodes) whose weight seems to be missing
    shifted: tuple[int, float] | None  # the channel whose baseline has shifted (most), where no weights explain it
    explained: bool  # whether that shift alone, or the weights, leave nothing that is out of the ordinary
    seen: np.ndarray  # (S, P) bool: where it lies outside its interval


def explain(conditions: Conditions, model: Influence, chance: float, likely: float = 0.01) -> Contradiction:
    """What the model of the others makes of the one condition; ``likely`` is the chance above which an explanation
    leaves nothing that calls for another."""
    label, vector, count = conditions.unbalance[0], conditions.vectors[0], int(conditions.counts[0])
    mean, noise = model.predict(label[None])
    total = noise[0] + model.noise.covariance(np.array([count]))[0]
    residual = vector - mean[0]
    reading = estimate_unbalance(model, vector, count)
    n_speeds, n_channels = conditions.displacement.shape[1:]
    free = {}
    for p in range(n_channels):
        rest = np.setdiff1d(np.arange(len(vector)), np.arange(n_speeds) * n_channels + p)
        free[p] = _squared(residual[rest], total[np.ix_(rest, rest)])
    best = min(free, key=lambda p: free[p])
    by_shift = _chance(free[best], len(vector) - n_speeds, model)
    by_weights = _chance(reading.unexplained, len(vector) - len(label), model)
    explained = max(by_shift, by_weights) > likely
    if not explained:
        best = int(np.argmax((abs(residual.reshape(n_speeds, n_channels)) ** 2).sum(0)))
    shift = not explained or by_shift > by_weights
    without = [np.where(np.arange(len(label)) == n, 0, label) for n in np.flatnonzero(label)]
    missing = [
        conditions.planes[n]
        for n, u in zip(np.flatnonzero(label), without, strict=True)
        if _judge(conditions, model, u) > likely
    ]
    width = model.noise.half_width(np.diag(total).real)
    outside = (abs(residual.real) > width) | (abs(residual.imag) > width)
    return Contradiction(
        name=conditions.names[0],
        chance=chance,
        label=label,
        reading=reading,
        missing=tuple(missing),
        shifted=conditions.channels[best] if shift else None,
        explained=explained,
        seen=outside.reshape(n_speeds, n_channels),
    )


def _judge(conditions: Conditions, model: Influence, unbalance: np.ndarray) -> float:
    """The chance that a condition with these weights reads like that."""
    mean, noise = model.predict(unbalance[None])
    total = noise[0] + model.noise.covariance(conditions.counts)[0]
    return _chance(_squared(conditions.vectors[0] - mean[0], total), len(total), model)


def _squared(residual: np.ndarray, covariance: np.ndarray) -> float:
    return float((residual.conj() @ np.linalg.solve(covariance, residual)).real)


def _chance(squared: float, size: int, model: Influence) -> float:
    """That a consistent condition leaves as much in ``size`` entries."""
    from scipy import stats

    noise = model.noise
    tail = noise.tail or max(noise.freedom - size + 1, 1.0)
    return float(stats.f.sf(squared / (noise.stretch * size), 2 * size, 2 * tail))


def to_labels(config: Config, unbalance: np.ndarray) -> np.ndarray:
    """Weights in g mm, their angles counted as the machine's file counts those of weights; from kg m."""
    recordings = config.machine.recordings
    sense = getattr(recordings, "shaft_angle", None) or "from_x"
    tacho = getattr(getattr(recordings, "tacho", None), "angle", None) or 0.0
    turned = unbalance * np.exp(-1j * tacho) if sense != "from_x" else unbalance
    return np.asarray(turned.conj() if sense == "against_rotation" else turned) / _GRAM_MM


def describe_contradiction(config: Config, conditions: Conditions, contradiction: Contradiction) -> str:
    """One sentence: the condition, and what its vibration reads like."""
    label, reading = (
        " and ".join(_weight(node, u) for node, u in zip(conditions.planes, to_labels(config, weights), strict=True))
        for weights in (contradiction.label, contradiction.reading.value)
    )
    text = f"condition {contradiction.name} contradicts its label ({label}; chance {contradiction.chance:.1g}): "
    if contradiction.shifted is not None:
        node, angle = contradiction.shifted
        probe = f"the probe at node {node} ({name_direction(angle)})"
        if contradiction.explained:
            return f"{text}it reads as if the baseline of {probe} alone had shifted"
        return f"{text}no weights explain it; its baseline has shifted, most at {probe}"
    if contradiction.missing:
        nodes = " or ".join(map(str, contradiction.missing))
        return f"{text}it reads as if the weight at node {nodes} were missing, like {reading}"
    return f"{text}it reads like {reading}"


def _weight(node: int, value: complex, nothing: float = 0.01) -> str:
    """In g mm; a plane with less than ``nothing`` carries none."""
    size = f"{abs(value):.3g} g mm"
    if abs(value) < nothing:
        return f"none at node {node}"
    return f"{size} at {np.degrees(np.angle(value)) % 360:.0f} deg at node {node}"


def tell_contradiction(config: Config, conditions: Conditions, contradiction: Contradiction) -> dict[str, Any]:
    """The same for a file: g mm and degrees as the labels count them."""
    reading, label = to_labels(config, contradiction.reading.value), to_labels(config, contradiction.label)
    outside = [
        f"node {conditions.channels[p][0]} {name_direction(conditions.channels[p][1])} at "
        f"{to_rpm(conditions.speeds[s]):.0f} rpm"
        for s, p in np.argwhere(contradiction.seen)
    ]
    return {
        "condition": contradiction.name,
        "sentence": describe_contradiction(config, conditions, contradiction),
        "chance": contradiction.chance,
        "label_g_mm": abs(label).tolist(),
        "label_deg": np.degrees(np.angle(label)).tolist(),
        "reads_like_g_mm": abs(reading).tolist(),
        "reads_like_deg": np.degrees(np.angle(reading)).tolist(),
        "within_g_mm": (contradiction.reading.half_width() / _GRAM_MM).tolist(),
        "missing_at_nodes": list(contradiction.missing),
        "shifted": None
        if contradiction.shifted is None
        else f"node {contradiction.shifted[0]} {name_direction(contradiction.shifted[1])}",
        "outside_interval": outside,
    }
