"""Can the answer be trusted? One verdict for every coefficient, bearing and machine, with its reason and next step."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np

from pipeline.config.schema import Config
from pipeline.data.candidates import list_candidates
from pipeline.data.sensors import name_channel
from pipeline.data.tables import write_table
from pipeline.evaluation.contradiction import find_contradiction
from pipeline.files import read_json, write_json
from pipeline.identification.held_out import held_out_conditions, held_out_range, held_out_runs
from pipeline.identification.losses import loss_of
from pipeline.identification.restored import Answer
from pipeline.identification.training import held_out_speeds
from pipeline.problem.measurement import Measurement
from pipeline.reporting.console import say, table
from pipeline.stages.analysis import Analysis, made_once
from pipeline.stages.execution import StageOutput
from pipeline.stages.measurement import AGAIN, ANSWER, restore
from pipeline.stages.workspace import locate_files
from pipeline.trust.evidence import Evidence, gather
from pipeline.trust.mistakes import WORTH_TRYING, Found, Probe, find_mistakes
from pipeline.trust.next_run import weigh_candidates
from pipeline.trust.report import judge, refuse_without_deviations
from pipeline.trust.verdict import SIGNIFICANT, judge_law, judge_mistakes


def run(analysis: Analysis) -> StageOutput:
    """``verdicts.json`` and ``verdicts.csv``; no modelled coefficient is read."""
    config, work, judged = analysis.config, analysis.files, judge_answer(analysis)
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
def judge_answer(analysis: Analysis) -> dict[str, Any]:
    """The verdicts on what was identified, training first where that is missing."""
    answer = restore(analysis)
    if answer.uncertainty is None:
        return refuse_without_deviations(answer.table.nodes, answer.names)
    return assess(analysis.config, answer, read_json(analysis.files.training, AGAIN))[0]


def assess(config: Config, answer: Answer, about: Mapping[str, Any]) -> tuple[dict[str, Any], Evidence]:
    """The verdicts on a fit that states deviations, and what they rest on; ``about`` has ``fit`` and ``outcome`` of
    ``training.json``."""
    updated, identified, uncertainty = answer.measurement, answer.model, answer.uncertainty
    assert uncertainty is not None
    estimated, fitted = config.loss.noise == "estimated", mark_fitted(config, updated)
    evidence, linear = gather(updated, identified, uncertainty, about["fit"], fitted, estimated, about["outcome"])
    candidates = list_candidates(config.machine.candidates)
    gains = weigh_candidates(updated, identified, uncertainty, linear, candidates, None)
    mistakes: list[Found] = []
    if evidence.misfit_of_stated_noise > WORTH_TRYING and (evidence.ljung_box or 0.0) < SIGNIFICANT:
        values = updated.unknowns.leading(evidence.answer.values)
        probes = _list_probes(config) if locate_files(config).own else ()
        mistakes = find_mistakes(updated.as_stated(), values, config.model.kind == "constant", probes)
    return judge(
        evidence, gains, [*judge_mistakes(mistakes), *judge_law(find_contradiction(about, config.model.kind))]
    ), evidence


def _list_probes(config: Config) -> tuple[Probe, ...]:
    """The probes that x and y were made of; none where the channels are the probes."""
    return tuple(
        Probe(name, *name_channel(probe.node, probe.angle)) for name, probe in config.machine.recordings.probes.items()
    )


def mark_fitted(config: Config, measurement: Measurement) -> np.ndarray:
    """(S, P, R) mask of the readings that the fit had."""
    data, training = measurement.dataset, config.training
    keep = ~held_out_speeds(len(data.speeds), training.holdout_every) & ~held_out_range(data.speeds, training)
    keep &= ~held_out_conditions(data.operating, training, len(data.speeds))
    fitted = np.broadcast_to(keep[:, None, None], data.displacement.shape).copy()
    if loss_of(config.loss).weighs_noise:
        fitted[..., held_out_runs(measurement, training)] = False
    return fitted & data.present[:, None]


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
    say(f"{config.name}: {whole['verdict']}. {whole['reason']}" + (f"\nnext: {whole['next']}" if whole["next"] else ""))
