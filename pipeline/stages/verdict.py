"""Can the answer be trusted? One verdict for every coefficient, bearing and machine, with its reason and next step."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np

from pipeline.config.schema import Config
from pipeline.data.tables import write_table
from pipeline.evaluation.contradiction import find_contradiction
from pipeline.files import read_json, write_json
from pipeline.identification.held_out import held_out_conditions, held_out_range, held_out_runs
from pipeline.identification.identified import IdentifiedModel
from pipeline.identification.losses import loss_of
from pipeline.identification.quality import MISMATCH
from pipeline.identification.training import held_out_speeds
from pipeline.identification.uncertainty import Uncertainty, load_uncertainty
from pipeline.problem.measurement import Measurement
from pipeline.reporting.console import say, table, warn
from pipeline.stages.execution import StageOutput
from pipeline.stages.measurement import load_identified, load_measurement, update_measurement
from pipeline.stages.planned_runs import list_candidates
from pipeline.stages.workspace import locate_files
from pipeline.trust.evidence import Evidence, gather
from pipeline.trust.judgement import AS_FELT, judge, refuse_without_deviations
from pipeline.trust.mistakes import WORTH_TRYING, Found, Probe, find_mistakes
from pipeline.trust.next_run import weigh_candidates
from pipeline.trust.verdict import find_contradicted, judge_contradiction, judge_mistakes


def run(config: Config) -> StageOutput:
    """``verdicts.json`` and ``verdicts.csv``; no modelled coefficient is read."""
    work, measurement = locate_files(config), load_measurement(config)
    judged = judge_measurement(config, measurement)
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
        {"data_fingerprint": measurement.dataset.fingerprint, "verdict": judged["machine"]["verdict"]},
        written,
    )


def load_judgement(config: Config, measurement: Measurement) -> dict[str, Any]:
    """The record of the Judgement on the fit at hand: what ``verdicts.json`` has, made anew where it is of another."""
    work = locate_files(config)
    if (path := work.folder / "verdicts.json").exists():
        judged = read_json(path, "make it again with stage=verdict")
        if judged.get("model") == read_json(work.training, "train again with stage=train")["model"]:
            return judged
    return judge_measurement(config, measurement)


def say_reservation(config: Config, measurement: Measurement) -> str:
    """What is to be said beside everything that follows from a rejected model, and a warning; empty for others."""
    reservation: str = load_judgement(config, measurement)["machine"]["reservation"]
    if reservation:
        warn(f"{config.name}: {reservation}")
    return reservation


def judge_measurement(config: Config, measurement: Measurement) -> dict[str, Any]:
    """The record of the Judgement on what was identified, training first where that is missing."""
    identified = load_identified(config, measurement)
    work = locate_files(config)
    uncertainty = load_uncertainty(work.folder, identified)
    about = read_json(work.training, "train again with stage=train")
    if uncertainty is None:
        nodes, felt = measurement.rotor.bearing_nodes, _may_have_supports(config)
        judged = refuse_without_deviations(nodes, identified.unknowns.by_bearing, felt).record()
    else:
        judged = assess(config, measurement, identified, uncertainty, about)[0]
    return judged | {"model": about["model"]}


def _may_have_supports(config: Config) -> bool:
    """Whether a support may be part of what is identified: anywhere but in a simulation of the machine as modelled."""
    simulated = locate_files(config).own and config.machine.recordings.format == "none"
    return not simulated or config.machine.as_built is not None


def assess(
    config: Config,
    measurement: Measurement,
    identified: IdentifiedModel,
    uncertainty: Uncertainty,
    about: Mapping[str, Any],
) -> tuple[dict[str, Any], Evidence]:
    """The Judgement on a fit, and what it rests on; ``about`` has ``fit`` and ``outcome`` of ``training.json``."""
    updated = update_measurement(measurement, uncertainty)
    fitted = mark_fitted(config, measurement)
    evidence, linear = gather(updated, identified, uncertainty, about["fit"], fitted, about["outcome"])
    gains = weigh_candidates(updated, identified, uncertainty, linear, list_candidates(config.machine.candidates))
    mistakes: list[Found] = []
    wanders = (about["fit"]["whiteness"].get("probability") or 0.0) < MISMATCH
    if wanders and evidence.misfit_of_stated_noise > WORTH_TRYING:
        values = measurement.unknowns.leading(evidence.answer.values)
        probes = _list_probes(config) if locate_files(config).own else ()
        mistakes = find_mistakes(updated.as_stated(), values, config.model.kind == "constant", probes)
    against = judge_mistakes(mistakes, list(find_contradicted(evidence)))
    against += judge_contradiction(find_contradiction(about, config.model.kind))
    return judge(evidence, gains, against, _may_have_supports(config)).record(), evidence


def _list_probes(config: Config) -> tuple[Probe, ...]:
    """The probes that x and y were made of; none where the channels are the probes."""
    return tuple(
        Probe(name, probe.node, round(float(np.degrees(probe.angle)), 9) % 360.0)
        for name, probe in config.machine.recordings.probes.items()
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
    lines = [f"{config.name}: {whole['verdict']}. {whole['reason']}"]
    lines += [f"next: {whole['next']}"] if whole["next"] else []
    lines += [f"what is identified: {whole['identified']}"] if whole["identified"] == AS_FELT else []
    say("\n".join(lines))
    if whole["reservation"]:
        warn(f"{config.name}: {whole['reservation']}")
