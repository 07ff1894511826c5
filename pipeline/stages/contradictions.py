"""Contradictions in words and numbers of the labels: g mm, and angles as the machine's file counts them."""

from __future__ import annotations

from typing import Any

import numpy as np

from pipeline.balance.consistency import Contradiction
from pipeline.config.schema import Config
from pipeline.data.conditions import Conditions
from pipeline.data.dataset import name_direction
from pipeline.data.vibration_files import to_rpm

_GRAM_MM = 1e-6
"""kg m."""
_NOTHING = 0.01
"""g mm below which a plane carries no weight."""


def to_labels(config: Config, unbalance: np.ndarray) -> np.ndarray:
    """Weights in g mm, their angles counted as the machine's file counts those of weights; from kg m."""
    recordings = config.machine.recordings
    sense = getattr(recordings, "shaft_angle", None) or "from_x"
    tacho = getattr(getattr(recordings, "tacho", None), "angle", None) or 0.0
    turned = unbalance * np.exp(-1j * tacho) if sense != "from_x" else unbalance
    return np.asarray(turned.conj() if sense == "against_rotation" else turned) / _GRAM_MM


def describe_contradiction(config: Config, conditions: Conditions, one: Contradiction) -> str:
    """One sentence: the condition, and what its vibration reads like."""
    label, reading = (
        " and ".join(_weight(node, u) for node, u in zip(conditions.planes, to_labels(config, of), strict=True))
        for of in (one.label, one.reading.value)
    )
    text = f"condition {one.name} contradicts its label ({label}; chance {one.chance:.1g}): "
    if one.shifted is not None:
        node, angle = one.shifted
        probe = f"the probe at node {node} ({name_direction(angle)})"
        if one.explained:
            return f"{text}it reads as if the baseline of {probe} alone had shifted"
        return f"{text}no weights explain it; its baseline has shifted, most at {probe}"
    if one.missing:
        nodes = " or ".join(map(str, one.missing))
        return f"{text}it reads as if the weight at node {nodes} were missing, like {reading}"
    return f"{text}it reads like {reading}"


def _weight(node: int, value: complex) -> str:
    size = f"{abs(value):.3g} g mm"
    if abs(value) < _NOTHING:
        return f"none at node {node}"
    return f"{size} at {np.degrees(np.angle(value)) % 360:.0f} deg at node {node}"


def tell_contradiction(config: Config, conditions: Conditions, one: Contradiction) -> dict[str, Any]:
    """The same for a file: g mm and degrees as the labels count them."""
    reading, label = to_labels(config, one.reading.value), to_labels(config, one.label)
    outside = [
        f"node {conditions.channels[p][0]} {name_direction(conditions.channels[p][1])} at "
        f"{to_rpm(conditions.speeds[s]):.0f} rpm"
        for s, p in np.argwhere(one.seen)
    ]
    return {
        "condition": one.name,
        "sentence": describe_contradiction(config, conditions, one),
        "chance": one.chance,
        "label_g_mm": abs(label).tolist(),
        "label_deg": np.degrees(np.angle(label)).tolist(),
        "reads_like_g_mm": abs(reading).tolist(),
        "reads_like_deg": np.degrees(np.angle(reading)).tolist(),
        "within_g_mm": (one.reading.half_width() / _GRAM_MM).tolist(),
        "missing_at_nodes": list(one.missing),
        "shifted": None if one.shifted is None else f"node {one.shifted[0]} {name_direction(one.shifted[1])}",
        "outside_interval": outside,
    }
