"""The verdicts of a machine, as verdicts.json holds them."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np

from pipeline.coefficients import COEFFICIENTS
from pipeline.trust.evidence import Evidence
from pipeline.trust.next_run import Gains, describe_run
from pipeline.trust.verdict import CoefficientVerdict, Reason, Verdict, judge_coefficient, judge_machine, worst

_WORTH = 1.3
"""A run that lowers a deviation by less is not worth its time."""


def judge(evidence: Evidence, gains: Gains | None, mistakes: Sequence[Reason] = ()) -> dict[str, Any]:
    """``verdicts``, ``bearings`` and ``machine``; numbers that are not finite are null.

    Args:
        gains: what candidate runs would add; None where there are none.
        mistakes: single mistakes that would explain the readings.
    """
    common, nodes = [*mistakes, *judge_machine(evidence)], evidence.answer.nodes
    verdicts = []
    for b, c in np.argwhere(evidence.identified):
        reasons, checks = judge_coefficient(evidence, int(b), int(c))
        reasons = [_with_next(judged, gains, int(b), int(c)) for judged in reasons]
        verdicts.append(
            CoefficientVerdict(
                int(b) + 1, nodes[b], COEFFICIENTS[c], tuple(_sort([*common, *reasons])), checks | _common(evidence)
            )
        )
    bearings = [_judge_bearing(node, [judged for judged in verdicts if judged.node == node]) for node in nodes]
    return {
        "verdicts": [_to_json(judged) for judged in verdicts],
        "bearings": bearings,
        "machine": _judge_whole(common, verdicts),
    }


def refuse_without_deviations(nodes: Sequence[int], coefficients: Sequence[Sequence[str]]) -> dict[str, Any]:
    """The verdicts on a fit by a residual, which weighs no noise and states no deviations."""
    reason = Reason(
        Verdict.WITH_CARE,
        "This loss weighs no noise, so nobody knows how far its answer may be off.",
        "Train with loss=response, which states deviations, and ask again.",
    )
    verdicts = [
        CoefficientVerdict(b + 1, node, name, (reason,)) for b, node in enumerate(nodes) for name in coefficients[b]
    ]
    bearings = [_judge_bearing(node, [judged for judged in verdicts if judged.node == node]) for node in nodes]
    return {
        "verdicts": [_to_json(judged) for judged in verdicts],
        "bearings": bearings,
        "machine": _judge_whole([reason], verdicts),
    }


def _sort(reasons: Sequence[Reason]) -> list[Reason]:
    """The gravest first; what holds for the whole machine before what is one coefficient's."""
    return sorted(reasons, key=lambda reason: -list(Verdict).index(reason.verdict))


def _with_next(reason: Reason, gains: Gains | None, b: int, c: int) -> Reason:
    """The run that would help most, where the reason has no step of its own."""
    if reason.next is not None:
        return reason
    told = None if gains is None else gains.best(b, c)
    if told is None or told[1] < _WORTH:
        step = "No single run of machine.candidates helps much: use larger weights, more speeds, or probes elsewhere."
    else:
        step = f"Add a run with {describe_run(told[0])}: its deviation falls {told[1]:.2g} times."
    return Reason(reason.verdict, reason.sentence, step)


def _common(evidence: Evidence) -> dict[str, Any]:
    """The figures that all coefficients share."""
    mismatch, square = evidence.fit["mismatch"], evidence.fit["chi_square"]
    held_out = {
        f"{name}_over_noise": evidence.fit[name]["mean_square_over_noise"]
        for name in ("held_out_speeds", "held_out_runs")
        if name in evidence.fit
    }
    prior = max(evidence.priors.items(), key=lambda item: abs(item[1][0]), default=None)
    return {
        "mismatch": {
            "chi_square_over_expected": square["value"] / max(square["expected"], 1.0),
            "probability": mismatch["probability"],
            "ljung_box_probability": evidence.ljung_box,
        },
        "held_out": held_out,
        "predicted_from_other_runs_over_noise": dict(evidence.predicted),
        "superposition_over_noise": dict(evidence.superposed),
        "model_parameters": None if prior is None else {"most_moved": prior[0], "prior_deviations": prior[1][0]},
        "stability": {"largest_growth": evidence.growth, "unstable_from_rpm": evidence.unstable_rpm},
        "speeds": {"first_rpm": _rpm(evidence, 0), "last_rpm": _rpm(evidence, -1)},
    }


def _rpm(evidence: Evidence, s: int) -> float:
    from pipeline.data.vibration_files import to_rpm

    return float(to_rpm(evidence.answer.speeds)[s])


def _to_json(verdict: CoefficientVerdict) -> dict[str, Any]:
    reasons = [reason.sentence for reason in verdict.reasons] or [_praise(verdict)]
    return {
        "bearing": verdict.bearing,
        "node": verdict.node,
        "coefficient": verdict.coefficient,
        "verdict": verdict.verdict.value,
        "reasons": reasons,
        "next": verdict.next,
        "checks": _finite(verdict.checks),
    }


def _praise(verdict: CoefficientVerdict) -> str:
    band = verdict.checks["band"]["percent"]
    return (
        f"{verdict.coefficient} at node {verdict.node} is known to {band:.2g} % (95 %), and no check speaks against it."
    )


def _judge_bearing(node: int, verdicts: Sequence[CoefficientVerdict]) -> dict[str, Any]:
    good = [judged.coefficient for judged in verdicts if judged.verdict is Verdict.GOOD]
    verdict = worst([judged.verdict for judged in verdicts])
    if verdict is Verdict.NO and any(judged.verdict is not Verdict.NO for judged in verdicts):
        verdict = Verdict.WITH_CARE
    bad = max(verdicts, key=lambda judged: list(Verdict).index(judged.verdict), default=None)
    if bad is None or bad.verdict is Verdict.GOOD:
        sentence = f"All {len(verdicts)} coefficients are good."
    else:
        sentence = f"{len(good)} of {len(verdicts)} coefficients are good. {bad.reasons[0].sentence}"
    return {"node": node, "verdict": verdict.value, "reason": sentence, "next": None if bad is None else bad.next}


def _judge_whole(common: Sequence[Reason], verdicts: Sequence[CoefficientVerdict]) -> dict[str, Any]:
    good = sum(judged.verdict is Verdict.GOOD for judged in verdicts)
    verdict = worst([judged.verdict for judged in verdicts])
    if verdict is Verdict.NO and any(judged.verdict is not Verdict.NO for judged in verdicts):
        verdict = Verdict.WITH_CARE
    head = f"{good} of {len(verdicts)} coefficients are good."
    bad = max(verdicts, key=lambda judged: list(Verdict).index(judged.verdict), default=None)
    reasons = list(common) or ([] if bad is None else list(bad.reasons))
    first = max(reasons, key=lambda reason: list(Verdict).index(reason.verdict), default=None)
    return {
        "verdict": verdict.value,
        "reason": head if first is None else f"{head} {first.sentence}",
        "next": None if first is None else first.next or (None if bad is None else bad.next),
    }


def _finite(value: Any) -> Any:
    """JSON has no infinity."""
    if isinstance(value, dict):
        return {key: _finite(entry) for key, entry in value.items()}
    if isinstance(value, float | np.floating):
        return float(value) if np.isfinite(value) else None
    return value
