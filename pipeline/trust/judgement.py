"""The Judgement: what an answer is worth, for each coefficient, bearing and the whole, made once.

``verdicts.json`` holds it; every page and line on trust after a fit reads it.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from pipeline.coefficients import COEFFICIENTS
from pipeline.trust.evidence import Evidence
from pipeline.trust.misfit import describe_held_out
from pipeline.trust.next_run import Gains, describe_run
from pipeline.trust.verdict import (
    ORDER,
    CoefficientVerdict,
    Reason,
    Verdict,
    gravest,
    judge_coefficient,
    judge_machine,
    worst,
)

AS_FELT = "the bearings as the shaft feels them (film and support)"
NO_RUN = "No single further run helps much: use larger weights, more speeds, or probes elsewhere."


@dataclass(frozen=True)
class Judgement:
    """Verdicts on the coefficients, and what speaks against all of them."""

    nodes: tuple[int, ...]  # of the bearings
    verdicts: tuple[CoefficientVerdict, ...]
    common: tuple[Reason, ...] = ()
    held_out: tuple[str, ...] = ()  # how readings that the fit did not see are predicted, in words
    as_felt: bool = False  # a support may be part of the coefficients
    rejected: bool = False  # readings speak against the model, whatever they determine

    @property
    def verdict(self) -> Verdict:
        """On the whole."""
        return _join(self.verdicts)

    @property
    def reservation(self) -> str:
        """What is said beside everything that follows from a rejected model; empty for others."""
        if self.verdict is not Verdict.NO:
            return ""
        why = gravest([*self.common, *(reason for judged in self.verdicts for reason in judged.reasons)])
        held_out = f" ({'; '.join(self.held_out)})" if self.held_out else ""
        what = "THE MODEL IS REJECTED" if self.rejected else "NO COEFFICIENT CAN BE USED"
        return f"{what}, claim nothing from this{held_out}: {why[0].sentence if why else ''}"

    def record(self) -> dict[str, Any]:
        """For JSON: ``verdicts``, ``bearings`` and ``machine``; numbers that are not finite are null."""
        return {
            "verdicts": [_record(judged) for judged in self.verdicts],
            "bearings": [
                {"node": node} | _sum_up([judged for judged in self.verdicts if judged.node == node])
                for node in self.nodes
            ],
            "machine": _sum_up(self.verdicts, self.common)
            | {"reservation": self.reservation, "identified": AS_FELT if self.as_felt else "the bearings"},
        }


def judge(
    evidence: Evidence,
    gains: Gains,
    mistakes: Sequence[Reason] = (),
    as_felt: bool = False,
    unexplained: float = 4.0,
) -> Judgement:
    """The Judgement of a fit that states deviations.

    Args:
        gains: what candidate runs would add.
        mistakes: what else speaks against the whole, such as single mistakes that would explain the readings.
        as_felt: whether a support may be part of the coefficients.
        unexplained: mean square over the noise, of readings that the fit did not see, which rejects a model.
    """
    common, nodes, shared = [*mistakes, *judge_machine(evidence)], evidence.answer.nodes, _list_common(evidence)
    verdicts = []
    places = np.argwhere(~np.isnan(evidence.deviations.values).all(axis=1)).tolist()
    for (b, c), determined in zip(places, evidence.deviations.judge(), strict=True):
        reasons, checks = judge_coefficient(evidence, determined, b, c)
        reasons = gravest([*common, *(_add_step(reason, gains, b, c, nodes[b]) for reason in reasons)])
        verdicts.append(CoefficientVerdict(b + 1, nodes[b], COEFFICIENTS[c], tuple(reasons), checks | shared))
    unseen = _pick_held_out(evidence)
    held_out = tuple(describe_held_out(kind, entry) for kind, entry in unseen.items())
    off = [entry["mean_square_over_noise"] or np.inf for entry in unseen.values()]
    rejected = not evidence.misfit.explained() or max(off, default=0.0) > unexplained
    return Judgement(nodes, tuple(verdicts), tuple(common), held_out, as_felt, rejected)


def _pick_held_out(evidence: Evidence) -> dict[str, Mapping[str, Any]]:
    """What the fit says of readings that it did not see, by kind."""
    return {kind: evidence.fit[kind] for kind in ("held_out_speeds", "held_out_runs") if kind in evidence.fit}


def refuse_without_deviations(
    nodes: Sequence[int], coefficients: Sequence[Sequence[str]], as_felt: bool = False
) -> Judgement:
    """The Judgement of a fit by a residual, which weighs no noise and states no deviations."""
    reason = Reason(
        Verdict.WITH_CARE,
        "This loss weighs no noise, so nobody knows how far its answer may be off.",
        "Train with loss=response, which states deviations, and ask again.",
    )
    verdicts = [
        CoefficientVerdict(b + 1, node, name, (reason,)) for b, node in enumerate(nodes) for name in coefficients[b]
    ]
    return Judgement(tuple(nodes), tuple(verdicts), (reason,), as_felt=as_felt)


def _add_step(reason: Reason, gains: Gains, b: int, c: int, node: int, worth: float = 1.3) -> Reason:
    """The run that would help most, where the reason has no step; one that helps less than ``worth`` is none."""
    if reason.next:
        return reason
    run, gain = gains.best(b, c)
    step = NO_RUN
    if gain >= worth:
        step = (
            f"Add a run with {describe_run(run)}: the deviation of {COEFFICIENTS[c]} at node {node} falls {gain:.2g} "
            "times."
        )
    return replace(reason, next=step)


def _list_common(evidence: Evidence) -> dict[str, Any]:
    """The figures that all coefficients share."""
    from pipeline.data.vibration_files import to_rpm

    square, rpm = evidence.fit["chi_square"], to_rpm(evidence.answer.speeds)
    most_moved = max(evidence.priors.items(), key=lambda item: abs(item[1]), default=None)
    return {
        "mismatch": {
            "chi_square_over_expected": square["value"] / max(square["expected"], 1.0),
            "probability": evidence.misfit.probability,
            "ljung_box_probability": evidence.fit["whiteness"].get("probability"),
        },
        "held_out": {
            f"{kind}_over_noise": entry["mean_square_over_noise"] for kind, entry in _pick_held_out(evidence).items()
        },
        "predicted_from_other_runs_over_noise": dict(evidence.predicted),
        "superposition_over_noise": dict(evidence.superposed),
        "model_parameters": most_moved and dict(zip(("most_moved", "prior_deviations"), most_moved, strict=True)),
        "stability": {
            "largest_growth": evidence.growth.largest,
            "largest_growth_std": evidence.growth.deviation,
            "unstable_from_rpm": evidence.growth.unstable_rpm,
        },
        "speeds": {"first_rpm": float(rpm[0]), "last_rpm": float(rpm[-1])},
    }


def _record(judged: CoefficientVerdict) -> dict[str, Any]:
    return {
        "bearing": judged.bearing,
        "node": judged.node,
        "coefficient": judged.coefficient,
        "verdict": judged.verdict.value,
        "reasons": [reason.sentence for reason in judged.reasons] or [judged.praise],
        "next": judged.next,
        "checks": _finite(judged.checks),
    }


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


def _finite(value: Any) -> Any:
    """JSON has no infinity."""
    if isinstance(value, dict):
        return {key: _finite(entry) for key, entry in value.items()}
    if isinstance(value, float | np.floating):
        return float(value) if np.isfinite(value) else None
    return value
