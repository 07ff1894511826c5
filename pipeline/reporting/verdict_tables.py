"""The verdicts of a Judgement as a table, and on screen."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np

from pipeline.reporting.console import say, table, warn
from pipeline.trust.judgement import AS_FELT
from pipeline.write_numbers import write_percent


def tabulate_verdicts(judged: Mapping[str, Any]) -> dict[str, list[Any]]:
    """A row a coefficient."""
    every = judged["verdicts"]
    columns: dict[str, list[Any]] = {key: [entry[key] for entry in every] for key in ("bearing", "node", "coefficient")}
    return columns | {
        "verdict": [entry["verdict"] for entry in every],
        "band_percent": [_read_band(entry) for entry in every],
        "reason": [" ".join(entry["reasons"]) for entry in every],
        "next": [entry["next"] or "" for entry in every],
    }


def _read_band(entry: Mapping[str, Any]) -> float:
    """Half of the 95 % band of a coefficient in percent; NaN where it was not checked."""
    percent = entry["checks"].get("band", {}).get("percent")
    return np.nan if percent is None else float(percent)


def print_verdicts(name: str, judged: Mapping[str, Any]) -> None:
    """Every coefficient, bearing and the whole, with reasons and the next step."""
    rows = [
        [
            f"node {entry['node']} {entry['coefficient']}",
            entry["verdict"],
            "" if np.isnan(band := _read_band(entry)) else write_percent(band / 100),
            entry["reasons"][0],
        ]
        for entry in judged["verdicts"]
    ]
    table(f"{name}: can it be trusted?", ["coefficient", "verdict", "+- (95 %)", "why"], rows)
    for entry in judged["bearings"]:
        say(f"{name}: bearing at node {entry['node']}: {entry['verdict']}. {entry['reason']}")
    whole = judged["machine"]
    say(
        f"{name}: {whole['verdict']}. {whole['reason']}"
        + (f"\nnext: {whole['next']}" if whole["next"] else "")
        + (f"\nwhat is identified: {whole['identified']}" if whole["identified"] == AS_FELT else "")
    )
    if whole["reservation"]:
        warn(f"{name}: {whole['reservation']}")
