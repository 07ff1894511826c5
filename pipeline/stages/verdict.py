"""Can the answer be trusted? One verdict for every coefficient, bearing and machine, with its reason and next step."""

from __future__ import annotations

from typing import Any

from pipeline.data.tables import write_table
from pipeline.files import read_json, write_json
from pipeline.reporting.console import warn
from pipeline.reporting.fit_tables import print_verdicts, tabulate_verdicts
from pipeline.stages.analysis import Analysis, made_once
from pipeline.stages.measurement import AGAIN, ANSWER, restore
from pipeline.tracking import StageRecord
from pipeline.trust.judgement import judge_answer


def run(analysis: Analysis) -> StageRecord:
    """``verdicts.json`` and ``verdicts.csv``; no modelled coefficient is read."""
    config, judged = analysis.config, make_judgement(analysis)
    written = [
        write_json(analysis.folder / "verdicts.json", judged),
        write_table(analysis.folder / "verdicts.csv", tabulate_verdicts(judged)),
    ]
    print_verdicts(config.name, judged)
    given = [entry["verdict"] for entry in judged["verdicts"]]
    return StageRecord(
        {"verdicts": {name.replace(" ", "_"): float(given.count(name)) for name in ("good", "with care", "no")}},
        restore(analysis).tags | {"verdict": judged["machine"]["verdict"]},
        written,
    )


@made_once(*ANSWER)
def make_judgement(analysis: Analysis) -> dict[str, Any]:
    """The record of the Judgement on what was identified, training first where that is missing."""
    return judge_answer(analysis.config, restore(analysis), read_json(analysis.training, AGAIN))


def load_judgement(analysis: Analysis) -> dict[str, Any]:
    """The record of the Judgement on the fit at hand: what ``verdicts.json`` has, made anew where it is of another."""
    if (path := analysis.folder / "verdicts.json").exists():
        judged = read_json(path, "make it again with stage=verdict")
        if judged.get("model") == read_json(analysis.training, AGAIN)["model"]:
            return judged
    return make_judgement(analysis)


def say_reservation(analysis: Analysis) -> str:
    """What is to be said beside everything that follows from a rejected model, and a warning; empty for others."""
    reservation: str = load_judgement(analysis)["machine"]["reservation"]
    if reservation:
        warn(f"{analysis.config.name}: {reservation}")
    return reservation
