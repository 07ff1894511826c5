"""One verdict for every coefficient, bearing and machine, with its reason and the next step, from the evidence.

``good``: known to 20 % with what was not fitted taken in, and nothing speaks against it. ``with care``: use it with its
band, or after the next step. ``no``: do not use it.

Legend: S speeds, B bearings.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from enum import StrEnum
from typing import Any

import numpy as np

from pipeline.coefficients import COEFFICIENTS
from pipeline.identification.quality import SMALL_MISFIT
from pipeline.problem.determination import WEAKLY_BELOW, WELL_BELOW
from pipeline.problem.ranking import rank
from pipeline.trust.evidence import Evidence
from pipeline.trust.mistakes import Found

GOOD_BAND = 0.20
"""Half the 95 % interval over the coefficient: a critical speed, which goes with the root of a stiffness, is then known
to 10 % at worst, within the separation margins that API 617 asks for (15 % and more)."""
USABLE_BAND = 0.60
"""Zero is then more than three deviations away."""
SIGNIFICANT = 0.05
CONTRADICTION = 3.0
"""Mean square over the noise of a run that the others predict; of right runs one in a thousand with few readings."""
MOVE_EXPLAINED = 3.5
"""Deviations by which a coefficient may move without a run or a probe: of sixteen and ten such, one in a hundred."""
NOISE_FACTOR = 3.0
"""Estimated noise over the stated one, beyond which something other than noise is in it."""
MOST_LOST = 0.2
"""Share of the speeds at which a coefficient may be unknown and still be called good, or have the wrong sign."""


class Verdict(StrEnum):
    """Can it be used?"""

    GOOD = "good"
    WITH_CARE = "with care"
    NO = "no"


_ORDER = (Verdict.GOOD, Verdict.WITH_CARE, Verdict.NO)


def worst(verdicts: Sequence[Verdict]) -> Verdict:
    """The least favourable of them; good where there is none."""
    return max(verdicts, key=_ORDER.index, default=Verdict.GOOD)


@dataclass(frozen=True)
class Reason:
    """What speaks against a good verdict, the worst that it allows, and what to do."""

    verdict: Verdict
    sentence: str
    next: str | None = None


@dataclass(frozen=True)
class CoefficientVerdict:
    """One coefficient of one bearing."""

    bearing: int  # from 1
    node: int
    coefficient: str
    reasons: tuple[Reason, ...]
    checks: dict[str, Any] = field(default_factory=dict)

    @property
    def verdict(self) -> Verdict:
        """The worst that its reasons allow."""
        return worst([reason.verdict for reason in self.reasons])

    @property
    def next(self) -> str | None:
        """What to do, by the worst reason that says it."""
        told = [reason for reason in self.reasons if reason.next is not None]
        return max(told, key=lambda reason: _ORDER.index(reason.verdict)).next if told else None


def judge_mistakes(mistakes: Sequence[Found]) -> list[Reason]:
    """A mistake that explains the readings: the answer is that of wrong data, however narrow its bands are."""
    if not mistakes:
        return []
    best = mistakes[0]
    text = "; or ".join(mistake.sentence for mistake in mistakes)
    checks = ", or ".join(dict.fromkeys(mistake.check for mistake in mistakes))
    return [
        Reason(
            Verdict.NO if best.gross else Verdict.WITH_CARE,
            f"The readings fit {np.sqrt(best.falls_by):.2g} times better if this is so: {text}.",
            f"Check {checks}; correct it and identify again.",
        )
    ]


def judge_law(contradiction: tuple[str, str] | None) -> list[Reason]:
    """What contradicts the bearing law of the fit, and the next step; nothing for None."""
    return [] if contradiction is None else [Reason(Verdict.WITH_CARE, *contradiction)]


def judge_machine(evidence: Evidence) -> list[Reason]:
    """What speaks against all coefficients together."""
    reasons = []
    if evidence.outcome != "converged":
        reasons.append(
            Reason(
                Verdict.NO if evidence.outcome == "diverged" else Verdict.WITH_CARE,
                f"The fit has not reached its minimum: {evidence.outcome.replace('_', ' ')}.",
                "Train again with more steps (optimizer.levenberg_marquardt.steps=1000).",
            )
        )
    if evidence.growth > 0:
        reasons.append(
            Reason(
                Verdict.WITH_CARE,
                f"The identified machine is unstable from {evidence.unstable_rpm:.0f} rpm (growth "
                f"{evidence.growth:.2g} 1/s), where a steady vibration cannot be measured.",
                "Check that the machine ran there without subsynchronous vibration; leave out speeds where it did not.",
            )
        )
    reasons += [*_judge_misfit(evidence), *_judge_runs(evidence), *_judge_priors(evidence)]
    return reasons


def _judge_misfit(evidence: Evidence) -> list[Reason]:
    """Whether model and noise explain the readings."""
    fit = evidence.fit
    if evidence.estimated_noise:
        factor, white = evidence.noise_factor, evidence.ljung_box
        if factor < NOISE_FACTOR or white is None or white > SIGNIFICANT:
            return []
        return [
            Reason(
                Verdict.WITH_CARE,
                f"The readings lie {factor:.2g} times as far from the fit as the stated noise, and their distance "
                "wanders over the speed.",
                "State the noise as it is (stated_noise), or find what else is in the readings: runout, a wrong "
                "weight, a wrong probe.",
            )
        ]
    probability = fit["mismatch"]["probability"]
    misfit, white = evidence.misfit, evidence.ljung_box
    least = min(p for p in (probability, white, 1.0) if p is not None)
    if least >= SIGNIFICANT or misfit < SMALL_MISFIT:
        return []
    return [
        Reason(
            Verdict.WITH_CARE,
            f"Model and stated noise do not explain the readings: they lie {np.sqrt(misfit):.2g} times as far from the "
            "fit as their noise.",
            "Check units, angles, weights, probes and rotor; state what may be a little wrong as "
            "identify.model_parameters; use model=b_spline for coefficients with kinks.",
        )
    ]


def _judge_runs(evidence: Evidence) -> list[Reason]:
    """Whether the runs agree with each other."""
    reasons = []
    for what, squares in (
        ("the sum of other runs", evidence.superposed),
        ("the fit of the other runs", evidence.predicted),
    ):
        bad = {run: size for run, size in squares.items() if size / max(1.0, evidence.misfit) > CONTRADICTION}
        if bad:
            run = rank(bad)[0]
            reasons.append(
                Reason(
                    Verdict.WITH_CARE,
                    f"Run '{run}' contradicts {what}: it lies {np.sqrt(bad[run]):.2g} times its noise away.",
                    f"Check the weight, its angle and its plane in run '{run}', or measure this run again.",
                )
            )
            break
    return reasons


def _judge_priors(evidence: Evidence) -> list[Reason]:
    """Whether a number of the model moved further than its tolerance allows (two deviations, by Bonferroni)."""
    from scipy.stats import norm

    if not evidence.priors:
        return []
    limit = max(2.0, float(norm.isf(0.025 / len(evidence.priors))))
    shifted = {name: value for name, (value, _) in evidence.priors.items() if abs(value) > limit}
    if not shifted:
        return []
    name = rank({other: abs(value) for other, value in shifted.items()})[0]
    return [
        Reason(
            Verdict.WITH_CARE,
            f"The data ask for a {name.replace('_', ' ')} that is {abs(shifted[name]):.1f} tolerances away from the "
            "stated one.",
            f"Measure {name.replace('_', ' ')} again, or state a wider tolerance if it was a guess.",
        )
    ]


def judge_coefficient(evidence: Evidence, b: int, c: int) -> tuple[list[Reason], dict[str, Any]]:
    """What speaks against one coefficient by itself, and the figures of its checks."""
    name, node = COEFFICIENTS[c], evidence.answer.nodes[b]
    value = evidence.answer.values[b, :, c]
    size = np.where(value != 0, np.abs(value), np.nan)
    fit = _median(evidence.by_fit[b, :, c] / size)
    band = _median(evidence.band[b, :, c] / size)
    lost = float(np.mean(~(evidence.by_fit[b, :, c] / size < WEAKLY_BELOW)))
    tolerances = {kind: _median(tolerance[b, :, c] / size) for kind, tolerance in evidence.tolerances.items()}
    reasons = _judge_band(f"{name} at node {node}", fit, band, lost, tolerances)
    if name in _DIRECT and (wrong := float(np.mean(value <= 0))) > 0.0:
        reasons.append(
            Reason(
                Verdict.NO if wrong > MOST_LOST else Verdict.WITH_CARE,
                f"{name} at node {node} is negative at {100 * wrong:.0f} % of the speeds, which a bearing's "
                "direct coefficient hardly is.",
                "Check the phases of readings and weights, and the rotor's masses.",
            )
        )
    left_out, share, explained = _find_move(evidence, b, c)
    if left_out and explained > MOVE_EXPLAINED and share > 1.0:
        reasons.append(
            Reason(
                Verdict.WITH_CARE,
                f"Without {left_out}, {name} at node {node} would be another by {share:.2g} times its band.",
                f"Check {left_out}, or measure it again.",
            )
        )
    checks = {
        "determination": {"deviation_percent": 100 * fit, "not_determined_at_percent_of_speeds": 100 * lost},
        "band": {"percent": 100 * band},
        "tolerances": {f"{kind}_percent": 100 * tolerance for kind, tolerance in tolerances.items()},
        "left_out": {"what": left_out, "move_over_band": share, "move_over_deviation": explained},
    }
    return reasons, checks


_DIRECT = ("kxx", "kyy", "cxx", "cyy")


def _judge_band(which: str, fit: float, band: float, lost: float, tolerances: dict[str, float]) -> list[Reason]:
    if not fit < WEAKLY_BELOW:
        return [Reason(Verdict.NO, f"The data do not determine {which}: {_percent(fit)} is one standard deviation.")]
    if not band < USABLE_BAND or not band < GOOD_BAND:
        verdict = Verdict.WITH_CARE if band < USABLE_BAND else Verdict.NO
        kind = rank(tolerances)[0] if tolerances else None
        if kind is not None and tolerances[kind] > fit:
            sentence = (
                f"A usual tolerance of {kind.replace('_', ' ')}, which no fit corrects here, moves {which} by "
                f"{_percent(tolerances[kind])}."
            )
            cure = (
                f"Measure {kind.replace('_', ' ')} well, and state its tolerance as identify.model_parameters.{kind}."
            )
            return [Reason(verdict, sentence, cure)]
        return [Reason(verdict, f"{which} is known to {_percent(band)} only (95 %).")]
    if not fit < WELL_BELOW:
        return [Reason(Verdict.WITH_CARE, f"{which} is known to {_percent(fit)} (one standard deviation).")]
    if lost > MOST_LOST:
        return [Reason(Verdict.WITH_CARE, f"{which} is not determined at {_percent(lost)} of the speeds.")]
    return []


def _find_move(evidence: Evidence, b: int, c: int) -> tuple[str | None, float, float]:
    """The run or probe without which a coefficient would move most: its name, the move over the band, over noise."""
    largest: tuple[str | None, float, float] = (None, 0.0, 0.0)
    for name, (move, spread) in evidence.moves.items():
        with np.errstate(divide="ignore", invalid="ignore"):
            share = _median(np.abs(move[b, :, c]) / evidence.band[b, :, c])
            explained = _median(np.abs(move[b, :, c]) / spread[b, :, c])
        # A band that is wider by a misfit explains a larger move.
        explained /= np.sqrt(max(1.0, evidence.misfit))
        if np.isfinite(share) and explained > MOVE_EXPLAINED and share > largest[1]:
            largest = (name, share, explained)
    return largest


def _median(values: np.ndarray) -> float:
    """Not a number where it is undefined."""
    with np.errstate(invalid="ignore"):
        median = np.median(np.where(np.isnan(values), np.inf, values))
    return float(median)


def _percent(share: float) -> str:
    return f"{100 * share:.2g} %" if np.isfinite(share) else "no limit"
