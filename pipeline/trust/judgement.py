"""The Judgement: what an answer is worth, for each coefficient, bearing and the whole, made once: what speaks for it
and against it, and which run or mistake is worth trying.

``verdicts.json`` holds it; every page and line on trust after a fit reads it.
"""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import Any

import numpy as np

from pipeline.coefficients import COEFFICIENTS
from pipeline.config.schema import Config
from pipeline.data.dataset import Excitation
from pipeline.data.excitation_files import list_candidates
from pipeline.data.sensors import name_channel
from pipeline.evaluation.errors import find_contradiction
from pipeline.identification.fit import loss_of
from pipeline.identification.held_out import held_out_points, held_out_runs
from pipeline.identification.identified import Answer
from pipeline.identification.quality import MISMATCH
from pipeline.ingest.plausibility import measure_backward
from pipeline.problem.determination import Determined, Verdict, describe_determined, judge_determined
from pipeline.problem.ranking import rank_indices
from pipeline.trust.evidence import Evidence, gather
from pipeline.trust.linearised import Gains, weigh_candidates
from pipeline.trust.misfit import describe_held_out
from pipeline.trust.mistake import Mistake
from pipeline.trust.mistakes import WORTH_TRYING, find_mistakes
from pipeline.trust.verdict import (
    ORDER,
    CoefficientVerdict,
    Reason,
    find_contradicted,
    gravest,
    judge_coefficient,
    judge_contradiction,
    judge_lacking,
    judge_machine,
    judge_mistakes,
    judge_whirl,
    worst,
)
from pipeline.write_numbers import write_number, write_rough

AS_FELT = "the bearings as the shaft feels them (film and support)"
NO_RUN = "No single further run helps much: use larger weights, more speeds, or probes elsewhere."


def _record(
    nodes: Sequence[int],
    verdicts: Sequence[CoefficientVerdict],
    common: Sequence[Reason],
    as_felt: bool,
    rejected: bool = False,
    held_out: Sequence[str] = (),
) -> dict[str, Any]:
    """The Judgement for JSON: ``verdicts``, ``bearings`` and ``machine``; numbers that are not finite are null.

    Where no coefficient can be used the machine has a reservation, which is said beside everything that follows.

    Args:
        nodes: of the bearings.
        common: what speaks against all coefficients.
        as_felt: whether a support may be part of the coefficients.
        rejected: whether readings speak against the model, whatever they determine.
        held_out: how readings that the fit did not see are predicted, in words.
    """
    reservation = ""
    if _join(verdicts) is Verdict.NO:
        why = gravest([*common, *(reason for judged in verdicts for reason in judged.reasons)])
        unseen = f" ({'; '.join(held_out)})" if held_out else ""
        what = "THE MODEL IS REJECTED" if rejected else "NO COEFFICIENT CAN BE USED"
        reservation = f"{what}, claim nothing from this{unseen}: {why[0].sentence if why else ''}"
    return {
        "verdicts": [
            {
                "bearing": judged.bearing,
                "node": judged.node,
                "coefficient": judged.coefficient,
                "verdict": judged.verdict.value,
                "reasons": [reason.sentence for reason in judged.reasons] or [judged.praise],
                "next": judged.next,
                "checks": json.loads(json.dumps(judged.checks, default=float), parse_constant=lambda _: None),
            }
            for judged in verdicts
        ],
        "bearings": [
            {"node": node} | _sum_up([judged for judged in verdicts if judged.node == node]) for node in nodes
        ],
        "machine": _sum_up(verdicts, common)
        | {"reservation": reservation, "identified": AS_FELT if as_felt else "the bearings"},
    }


def judge_answer(config: Config, answer: Answer, about: Mapping[str, Any]) -> dict[str, Any]:
    """The record of the Judgement, with the mark of the model that it is of; ``about`` is ``training.json``."""
    if answer.uncertainty is None:
        reason = Reason(
            Verdict.WITH_CARE,
            "This fit weighs no noise, so nobody knows how far its answer may be off.",
            "Train with loss=response, which states deviations, and ask again.",
        )
        nodes = answer.table.nodes
        verdicts = [
            CoefficientVerdict(b + 1, node, name, (reason,)) for b, node in enumerate(nodes) for name in answer.names[b]
        ]
        judged = _record(nodes, verdicts, [reason], _may_have_supports(config))
    else:
        judged = assess(config, answer, about)[0]
    supports = describe_supports(about.get("model_parameters", {}))
    return judged | {"model": about["model"]} | ({"supports": supports} if supports else {})


def describe_supports(fitted: Mapping[str, Mapping[str, float]]) -> str:
    """Which numbers of supports, or of a base, are determined, in the words of coefficients; empty without any.

    ``fitted`` are the ``model_parameters`` of ``training.json``.
    """
    held = [
        (name.replace("_", " "), n["number_deviation"] / n["number"]) for name, n in fitted.items() if "number" in n
    ]
    return describe_determined([Determined(0, name, deviation) for name, deviation in held], len(held))


def _may_have_supports(config: Config) -> bool:
    """Whether a support may be part of what is identified: anywhere but in a simulation of the machine as modelled, and
    where supports are stated beside the bearings."""
    simulated = not (config.data.vibration or config.data.excitation) and config.machine.recordings.format == "none"
    return not config.machine.rotor.n_casings and (not simulated or config.machine.as_built is not None)


def assess(
    config: Config, answer: Answer, about: Mapping[str, Any], clearly: float = 10.0
) -> tuple[dict[str, Any], Evidence]:
    """The Judgement on a fit that states deviations, and what it rests on; ``about`` has ``fit`` and ``outcome`` of
    ``training.json``. Where the readings show a mode that the model lacks, a mistake is named if its correction leaves
    less than one part in ``clearly`` of the misfit."""
    updated, uncertainty = answer.measurement, answer.uncertainty
    assert uncertainty is not None
    data, training = updated.dataset, config.training
    fitted = data.present[:, None] & ~held_out_points(data.speeds, data.operating, training)[:, None, None]
    fitted = np.broadcast_to(fitted, data.displacement.shape).copy()
    if loss_of(config.loss).weighs_noise:
        fitted[..., held_out_runs(updated, training)] = False
    # Nothing holds an exponential at speeds that were held out as a range: there is nothing to judge.
    keep = answer.model.table(updated.updated_known).bounded
    updated, fitted = (updated, fitted) if keep.all() else (updated.select(keep), fitted[keep])
    evidence, linear = gather(updated, uncertainty, about["fit"], fitted, about["outcome"])
    gains = weigh_candidates(updated, uncertainty, linear, list_candidates(config.machine.candidates))
    mistakes: list[Mistake] = []
    wanders = (about["fit"]["whiteness"].get("probability") or 0.0) < MISMATCH
    if wanders and evidence.misfit.of_stated > WORTH_TRYING:
        values = updated.unknowns.leading(evidence.answer.values)
        # The probes that x and y were made of.
        made_of = {} if config.data.vibration or config.data.excitation else config.machine.recordings.probes
        probes = {name: name_channel(probe.node, probe.angle) for name, probe in made_of.items()}
        mistakes = find_mistakes(updated.as_stated(), values, config.model.kind == "constant", probes)
        # What a mode that the model lacks leaves over, other mistakes seem to explain in part.
        mistakes = [mistake for mistake in mistakes if not evidence.lacking or mistake.falls_by > clearly]
    against = [
        *judge_whirl(measure_backward(data)),
        *judge_mistakes(mistakes, list(find_contradicted(evidence))),
        *judge_contradiction(find_contradiction(about, config.model.kind)),
    ]
    return judge(evidence, gains, against, _may_have_supports(config)), evidence


def judge(
    evidence: Evidence,
    gains: Gains,
    mistakes: Sequence[Reason] = (),
    as_felt: bool = False,
    unexplained: float = 4.0,
) -> dict[str, Any]:
    """The record of the Judgement of a fit that states deviations.

    Args:
        gains: what candidate runs would add.
        mistakes: what else speaks against the whole, such as single mistakes that would explain the readings.
        as_felt: whether a support may be part of the coefficients.
        unexplained: mean square over the noise, of readings that the fit did not see, which rejects a model.
    """
    from pipeline.data.vibration_files import to_rpm

    common = [*mistakes, *judge_lacking(evidence), *judge_machine(evidence)]
    nodes, fit = evidence.answer.nodes, evidence.fit
    unseen = {kind: fit[kind] for kind in ("held_out_speeds", "held_out_runs") if kind in fit}
    rpm = to_rpm(evidence.answer.speeds)
    most_moved = max(evidence.priors.items(), key=lambda item: abs(item[1]), default=None)
    shared = {
        "mismatch": {
            "chi_square_over_expected": fit["chi_square"]["value"] / max(fit["chi_square"]["expected"], 1.0),
            "probability": evidence.misfit.probability,
            "ljung_box_probability": fit["whiteness"].get("probability"),
        },
        "held_out": {f"{kind}_over_noise": entry["mean_square_over_noise"] for kind, entry in unseen.items()},
        "predicted_from_other_runs_over_noise": dict(evidence.predicted),
        "superposition_over_noise": dict(evidence.superposed),
        "model_parameters": most_moved and dict(zip(("most_moved", "prior_deviations"), most_moved, strict=True)),
        "stability": evidence.growth._asdict(),
        "speeds": {"first_rpm": float(rpm[0]), "last_rpm": float(rpm[-1])},
    }
    verdicts = []
    places = np.argwhere(~np.isnan(evidence.answer.spread).all(axis=1)).tolist()
    for (b, c), determined in zip(places, judge_determined(evidence.answer), strict=True):
        reasons, checks = judge_coefficient(evidence, determined, b, c)
        reasons = gravest([*common, *(_add_step(reason, gains, b, c, nodes[b]) for reason in reasons)])
        verdicts.append(CoefficientVerdict(b + 1, nodes[b], COEFFICIENTS[c], tuple(reasons), checks | shared))
    held_out = tuple(describe_held_out(kind, entry) for kind, entry in unseen.items())
    off = [entry["mean_square_over_noise"] or np.inf for entry in unseen.values()]
    rejected = not evidence.misfit.explained() or max(off, default=0.0) > unexplained
    return _record(nodes, verdicts, common, as_felt, rejected, held_out)


def _add_step(reason: Reason, gains: Gains, b: int, c: int, node: int, worth: float = 1.3) -> Reason:
    """The run that would help most, where the reason has no step; one that helps less than ``worth`` is none."""
    if reason.next:
        return reason
    factors, step = [float(factor[b, c]) for _, factor in gains], NO_RUN
    best = next(iter(rank_indices(factor if np.isfinite(factor) else np.nan for factor in factors)), 0)
    if factors and factors[best] >= worth:
        run, gain = gains[best][0], factors[best]
        step = (
            f"Add a run with {describe_run(run)}: the deviation of {COEFFICIENTS[c]} at node {node} falls "
            f"{write_rough(gain)} times."
        )
    return replace(reason, next=step)


def _join(verdicts: Sequence[CoefficientVerdict]) -> Verdict:
    """The verdict on several: no where none of them can be used."""
    every = [judged.verdict for judged in verdicts]
    usable = any(verdict is not Verdict.NO for verdict in every)
    return Verdict.WITH_CARE if usable and worst(every) is Verdict.NO else worst(every)


def _sum_up(verdicts: Sequence[CoefficientVerdict], common: Sequence[Reason] = ()) -> dict[str, Any]:
    """Verdict, reason and next step of a bearing or the whole; reasons that are ``common`` come first.

    Where no run helps the worst coefficient, one that helps another is the next step.
    """
    good = sum(judged.verdict is Verdict.GOOD for judged in verdicts)
    bad = sorted(verdicts, key=lambda judged: -ORDER.index(judged.verdict))[:1]
    reasons = [*gravest(common), *(reason for judged in bad for reason in gravest(judged.reasons))]
    steps = [step for step in (*(reason.next for reason in reasons), *(judged.next for judged in verdicts)) if step]
    return {
        "verdict": _join(verdicts).value,
        "reason": " ".join([f"{good} of {len(verdicts)} coefficients are good.", *(r.sentence for r in reasons[:1])]),
        "next": next((step for step in steps if step != NO_RUN), steps[0] if steps else None),
    }


def describe_run(acting: Sequence[Excitation]) -> str:
    """In words: weights and forces with their nodes and angles."""
    phrases = []
    for weight in acting:
        if weight.kind == "unbalance":
            what = f"a weight of {write_number(1e6 * weight.magnitude, digits=3)} g mm at node {weight.node}"
        else:
            what = (
                f"a {weight.whirl} rotating force of {write_number(weight.magnitude, digits=3)} N at node {weight.node}"
            )
        if len(acting) > 1:
            what += f" at {np.degrees(weight.phase):.0f} deg"
        phrases.append(what)
    return " and ".join(phrases)
