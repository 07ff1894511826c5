"""Can the answer be trusted? One verdict for every coefficient, bearing and machine, with its reason and next step."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np

from pipeline.config.schema import Config
from pipeline.data.tables import write_table
from pipeline.files import read_json, write_json
from pipeline.reporting.console import say, table, warn
from pipeline.stages.analysis import Analysis, made_once
from pipeline.stages.execution import StageOutput
from pipeline.stages.measurement import AGAIN, ANSWER, restore
from pipeline.trust.assessment import judge_answer
from pipeline.trust.judgement import AS_FELT


def run(analysis: Analysis) -> StageOutput:
    """``verdicts.json`` and ``verdicts.csv``; no modelled coefficient is read."""
    config, work, judged = analysis.config, analysis.files, make_judgement(analysis)
    written = [
        write_json(work.folder / "verdicts.json", judged),
        write_table(work.folder / "verdicts.csv", _tabulate(judged)),
    ]
    _print(config, judged)
    counts = {
        name: sum(entry["verdict"] == name for entry in judged["verdicts"]) for name in ("good", "with care", "no")
    }
    return StageOutput(
        {"verdicts": {name.replace(" ", "_"): float(count) for name, count in counts.items()}},
        restore(analysis).tags | {"verdict": judged["machine"]["verdict"]},
        written,
    )


@made_once(*ANSWER)
def make_judgement(analysis: Analysis) -> dict[str, Any]:
    """The record of the Judgement on what was identified, training first where that is missing."""
    return judge_answer(analysis.config, restore(analysis), read_json(analysis.files.training, AGAIN))


def load_judgement(analysis: Analysis) -> dict[str, Any]:
    """The record of the Judgement on the fit at hand: what ``verdicts.json`` has, made anew where it is of another."""
    if (path := analysis.files.folder / "verdicts.json").exists():
        judged = read_json(path, "make it again with stage=verdict")
        if judged.get("model") == read_json(analysis.files.training, AGAIN)["model"]:
            return judged
    return make_judgement(analysis)


def say_reservation(analysis: Analysis) -> str:
    """What is to be said beside everything that follows from a rejected model, and a warning; empty for others."""
    reservation: str = load_judgement(analysis)["machine"]["reservation"]
    if reservation:
        warn(f"{analysis.config.name}: {reservation}")
    return reservation


def _tabulate(judged: Mapping[str, Any]) -> dict[str, list[Any]]:
    """A row a coefficient."""
    every = judged["verdicts"]
    columns: dict[str, list[Any]] = {key: [entry[key] for entry in every] for key in ("bearing", "node", "coefficient")}
    bands = [entry["checks"].get("band", {}).get("percent") for entry in every]
    return columns | {
        "verdict": [entry["verdict"] for entry in every],
        "band_percent": [np.nan if band is None else band for band in bands],
        "reason": [" ".join(entry["reasons"]) for entry in every],
        "next": [entry["next"] or "" for entry in every],
    }


def _print(config: Config, judged: Mapping[str, Any]) -> None:
    rows = []
    for entry in judged["verdicts"]:
        band = entry["checks"].get("band", {}).get("percent")
        shown = "" if band is None else f"{band:.2g}"
        rows.append([f"node {entry['node']} {entry['coefficient']}", entry["verdict"], shown, entry["reasons"][0]])
    table(f"{config.name}: can it be trusted?", ["coefficient", "verdict", "+- % (95 %)", "why"], rows)
    for entry in judged["bearings"]:
        say(f"{config.name}: bearing at node {entry['node']}: {entry['verdict']}. {entry['reason']}")
    whole = judged["machine"]
    lines = [f"{config.name}: {whole['verdict']}. {whole['reason']}"]
    lines += [f"next: {whole['next']}"] if whole["next"] else []
    lines += [f"what is identified: {whole['identified']}"] if whole["identified"] == AS_FELT else []
    say("\n".join(lines))
    if whole["reservation"]:
        warn(f"{config.name}: {whole['reservation']}")
