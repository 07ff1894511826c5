"""Whether readings contradict the bearing laws of a fit, from ``training.json`` or ``metrics.json``."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from pipeline.identification.quality import MISMATCH


def find_contradiction(about: Mapping[str, Any], kind: str, least: float = 1e-4) -> tuple[str, str] | None:
    """A sentence and the next step where the laws of a fit of the model ``kind`` cannot be it; None otherwise.

    A probability below ``least`` is not said in digits.
    """
    probability = about["fit"]["mismatch"]["probability"] if kind == "law" else None
    if probability is None or probability >= MISMATCH:
        return None
    chance = f"{probability:.2g}" if probability >= least else f"below {least:g}"
    return (
        f"The readings contradict this bearing law (probability {chance}).",
        "Fit model=hybrid or model=network_operating, or take another table in machine.laws.",
    )


def list_contradicted(correction: Mapping[str, Mapping[str, float]], deviations: float = 2.0) -> list[str]:
    """The coefficients of a bearing whose ``correction`` by a network stands out of its own deviation.

    Beyond so many ``deviations`` of it the law without the correction is contradicted.
    """
    return [name for name, entry in correction.items() if entry["percent"] > deviations * entry["deviation_percent"]]
