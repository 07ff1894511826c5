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


def describe_contradiction(config: Config, conditions: Conditions, contradiction: Contradiction) -> str:
    """One sentence: the condition, and what its vibration reads like."""
    label, reading = (
        " and ".join(_weight(node, u) for node, u in zip(conditions.planes, to_labels(config, of), strict=True))
        for of in (contradiction.label, contradiction.reading.value)
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


def _weight(node: int, value: complex) -> str:
    size = f"{abs(value):.3g} g mm"
    if abs(value) < _NOTHING:
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
