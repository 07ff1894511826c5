"""Can the answer be trusted? One verdict for every coefficient, bearing and machine, with its reason and next step."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np

from pipeline.config.recordings import NoRecordingsConfig
from pipeline.config.schema import Config
from pipeline.data.tables import write_table
from pipeline.evaluation.contradiction import find_contradiction
from pipeline.files import read_json, write_json
from pipeline.identification.fit import loss_of
from pipeline.identification.held_out import held_out_conditions, held_out_range, held_out_runs, held_out_speeds
from pipeline.identification.identified import IdentifiedModel
from pipeline.identification.uncertainty import Uncertainty, load_uncertainty
from pipeline.problem.measurement import Measurement
from pipeline.reporting.console import say, table
from pipeline.stages.execution import StageOutput
from pipeline.stages.measurement import load_identified, load_measurement, update_measurement
from pipeline.stages.planned_runs import list_candidates
from pipeline.stages.workspace import locate_files
from pipeline.trust.evidence import Evidence, gather
from pipeline.trust.mistakes import WORTH_TRYING, Found, Probe, find_mistakes
from pipeline.trust.next_run import weigh_candidates
from pipeline.trust.report import judge, refuse_without_deviations
from pipeline.trust.verdict import SIGNIFICANT, judge_law, judge_mistakes


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


def judge_measurement(config: Config, measurement: Measurement) -> dict[str, Any]:
    """The verdicts on what was identified from the measurement, training first where that is missing."""
    identified = load_identified(config, measurement)
    work = locate_files(config)
    uncertainty = load_uncertainty(work.folder, identified)
    if uncertainty is None:
        return refuse_without_deviations(measurement.rotor.bearing_nodes, identified.unknowns.by_bearing)
    about = read_json(work.training, "train again with stage=train")
    return assess(config, measurement, identified, uncertainty, about)[0]


def assess(
    config: Config,
    measurement: Measurement,
    identified: IdentifiedModel,
    uncertainty: Uncertainty,
    about: Mapping[str, Any],
) -> tuple[dict[str, Any], Evidence]:
    """The verdicts on a fit, and what they rest on; ``about`` has ``fit`` and ``outcome`` of ``training.json``."""
    updated = update_measurement(measurement, uncertainty)
    estimated = config.loss.noise == "estimated"
    fitted = mark_fitted(config, measurement)
    evidence, linear = gather(updated, identified, uncertainty, about["fit"], fitted, estimated, about["outcome"])
    candidates = list_candidates(config.machine.candidates)
    gains = weigh_candidates(updated, identified, uncertainty, linear, candidates, 1.0)
    mistakes: list[Found] = []
    if evidence.misfit_of_stated_noise > WORTH_TRYING and (evidence.ljung_box or 0.0) < SIGNIFICANT:
        values = measurement.unknowns.leading(evidence.answer.values)
        probes = _list_probes(config) if locate_files(config).own else ()
        mistakes = find_mistakes(updated.as_stated(), values, config.model.kind == "constant", probes)
    return judge(
        evidence, gains, [*judge_mistakes(mistakes), *judge_law(find_contradiction(about, config.model.kind))]
    ), evidence


def _list_probes(config: Config) -> tuple[Probe, ...]:
    """The probes that x and y were made of; none where the channels are the probes."""
    recordings = config.machine.recordings
    if isinstance(recordings, NoRecordingsConfig):
        return ()
    return tuple(
        Probe(name, probe.node, round(float(np.degrees(probe.angle)), 9) % 360.0)
        for name, probe in recordings.probes.items()
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
