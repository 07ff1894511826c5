"""The rules: what speaks against an answer, with the worst verdict that it allows and the next step.

``good``: well determined, with what was not fitted taken in, and nothing speaks against it. ``with care``: use it with
its band, or after the next step. ``no``: do not use it. What deviations allow is said by
:mod:`pipeline.problem.determination`, as before the fit and after it.

Legend: S speeds, B bearings.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from pipeline.coefficients import COEFFICIENTS, is_direct
from pipeline.data.sensors import NOMINAL_95
from pipeline.problem.determination import Determined, Verdict, measure_sizes
from pipeline.problem.ranking import rank
from pipeline.trust.evidence import Evidence
from pipeline.trust.mistake import Mistake
from pipeline.write_numbers import write_number, write_percent, write_rough

ORDER = tuple(Verdict)
"""From the most to the least favourable."""


def worst(verdicts: Sequence[Verdict]) -> Verdict:
    """The least favourable of them; good where there is none."""
    return max(verdicts, key=ORDER.index, default=Verdict.GOOD)


@dataclass(frozen=True)
class Reason:
    """What speaks against a good verdict, the worst that it allows, and what to do."""

    verdict: Verdict
    sentence: str
    next: str | None = None


def gravest(reasons: Sequence[Reason]) -> list[Reason]:
    """The gravest first; those alike in their order."""
    return sorted(reasons, key=lambda reason: -ORDER.index(reason.verdict))


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
        return next((reason.next for reason in gravest(self.reasons) if reason.next), None)

    @property
    def praise(self) -> str:
        """What is said of it where nothing speaks against it."""
        band = self.checks["band"]
        known = write_percent(band["percent"] / 100)
        if "of_direct_percent" in band:
            direct = write_percent(band["of_direct_percent"] / 100)
            known = f"{direct} of the direct coefficients, beside which it is small,"
        return f"{self.coefficient} at node {self.node} is known to {known} (95 %), and no check speaks against it."


def judge_contradiction(contradiction: tuple[str, str] | None, gross: bool = False) -> list[Reason]:
    """What contradicts the fit or its bearing law, and the next step; nothing for None. A ``gross`` one leaves none."""
    return [Reason(Verdict.NO if gross else Verdict.WITH_CARE, *contradiction)] if contradiction else []


def judge_mistakes(mistakes: Sequence[Mistake], contradicted: Sequence[str] = ()) -> list[Reason]:
    """A mistake that explains the readings: the answer is that of wrong data, however narrow its bands are.

    A single run, weight or probe is blamed only where the runs contradict each other without a model (``contradicted``
    are those that do); else the model may be at fault, too.
    """
    if not mistakes:
        return []
    best = mistakes[0]
    text = "; or ".join(mistake.sentence for mistake in mistakes)
    checks = ", or ".join(dict.fromkeys(mistake.check for mistake in mistakes))
    doubt = "" if contradicted or not best.single else MODEL_MAY
    return [
        Reason(
            Verdict.NO if best.gross else Verdict.WITH_CARE,
            f"The readings fit {write_rough(np.sqrt(best.falls_by))} times better if this is so: {text}.{doubt}",
            f"Check {checks}; correct it and identify again.",
        )
    ]


def judge_whirl(backward: Mapping[str, float], most: float = 0.75) -> Iterator[Reason]:
    """Unbalance runs whose orbits turn ``backward`` (run -> share of speeds and nodes) in the mean of all of them.

    Eight coefficients at each speed follow mirrored readings, too. Of 110 drawn machines, between whose critical speeds
    orbits turn backward, the largest mean share is a half.
    """
    share = float(np.mean([*backward.values()])) if backward else 0.0
    if share > most:
        yield Reason(
            Verdict.WITH_CARE,
            f"The orbits of unbalance runs turn backward at {100 * share:.0f} % of speeds and nodes, and an unbalance "
            "turns the shaft forward, except between two critical speeds.",
            "Check the sense of the phases (lag or lead), that of the rotation and the probes' angles; correct it and "
            "identify again.",
        )


MODEL_MAY = (
    " No sum of runs speaks against it without a model, so the model may be at fault instead: a support, a coupling or "
    "an anisotropic shaft that it lacks."
)


def find_contradicted(evidence: Evidence, by: str = "superposed", most: float = 3.0) -> dict[str, float]:
    """Runs that contradict the sums of the others, without any model, or what is ``predicted`` from the others: mean
    square over the noise, where it is more than ``most``, and than that of the fit by as much.

    It is at most 1 of right runs; among these, one in a thousand with few readings comes above 3.
    """
    every = getattr(evidence, by).items()
    return {run: size for run, size in every if size > most * max(1.0, evidence.misfit.size)}


def judge_lacking(evidence: Evidence) -> Iterator[Reason]:
    """A mode that the readings show and the model lacks."""
    if evidence.lacking:
        frequency, probes = evidence.lacking
        yield Reason(
            Verdict.NO if evidence.misfit.is_gross() else Verdict.WITH_CARE,
            f"The readings show a mode at {write_number(frequency / (2 * np.pi), digits=2)} Hz in {probes} that the "
            "model lacks.",
            "Look for what has that natural frequency (a support, a base, a coupling), and state it: rotor.supports or "
            "rotor.base in the machine file; or leave out the speeds about it.",
        )


def judge_machine(evidence: Evidence) -> Iterator[Reason]:
    """What speaks against all coefficients together."""
    if evidence.outcome != "converged":
        yield Reason(
            Verdict.NO if evidence.outcome == "diverged" else Verdict.WITH_CARE,
            f"The fit has not reached its minimum: {evidence.outcome.replace('_', ' ')}.",
            "Train again with more steps (optimizer.levenberg_marquardt.steps=1000).",
        )
    starts = evidence.fit.get("starts", {"fitted": 0, "at_this_answer": 0})
    if starts["at_this_answer"] < 2 < starts["fitted"]:
        yield Reason(
            Verdict.WITH_CARE,
            f"{starts['at_this_answer'] or 'None'} of {starts['fitted']} starts ended at this answer: it may not "
            "be the global minimum.",
            "Train from other starts (model.initial_stiffness, seed), and see whether the answer stays.",
        )
    largest, deviation, unstable_rpm = evidence.growth
    if unstable_rpm is not None:
        yield Reason(
            Verdict.WITH_CARE,
            f"The identified machine is unstable from {unstable_rpm:.0f} rpm (growth "
            f"{write_number(largest, deviation)} 1/s), where a steady vibration cannot be measured.",
            "Check that the machine ran there without subsynchronous vibration; leave out speeds where it did not.",
        )
    yield from judge_contradiction(evidence.misfit.contradiction, evidence.misfit.is_gross())
    yield from (*_judge_runs(evidence), *_judge_priors(evidence), *_judge_known(evidence))


def _judge_runs(evidence: Evidence) -> list[Reason]:
    """Whether the runs agree with each other: by their sums, else by the model (see :func:`find_contradicted`)."""
    for what, by, doubt in (
        ("the sum of other runs", "superposed", ""),
        ("the fit of the other runs", "predicted", MODEL_MAY),
    ):
        if bad := find_contradicted(evidence, by):
            run = rank(bad)[0]
            model = "the model, and " if doubt else ""
            return [
                Reason(
                    Verdict.WITH_CARE,
                    f"Run '{run}' contradicts {what}: it lies {write_rough(np.sqrt(bad[run]))} times its noise "
                    f"away.{doubt}",
                    f"Check {model}the weight, its angle and its plane in run '{run}', or measure this run again.",
                )
            ]
    return []


def _judge_priors(evidence: Evidence, never: float = 1e-6) -> list[Reason]:
    """Whether a number of the model moved further than its tolerance allows (two deviations, by Bonferroni).

    Where all of them together moved as right tolerances ``never`` do, by chi-square, they stand for what the model
    lacks, and so may the coefficients.
    """
    from scipy.special import chdtrc, ndtri

    moves = {name: abs(value) for name, value in evidence.priors.items()}
    limit = max(2.0, -float(ndtri(0.025 / max(len(moves), 1))))
    shifted = {name: move for name, move in moves.items() if move > limit}
    if not shifted:
        return []
    name, square = rank(shifted)[0], sum(move**2 for move in moves.values())
    number = name.replace("_", " ")
    asked = f"The data ask for another {number}, {shifted[name]:.1f} tolerances away from the stated one"
    if chdtrc(len(moves), square) >= never:
        cure = f"Measure {number} again, or state a wider tolerance if it was a guess."
        return [Reason(Verdict.WITH_CARE, f"{asked}.", cure)]
    together = (
        f"{asked}, and for all numbers of rotor, weights and probes {write_rough(np.sqrt(square / len(moves)))} times "
        "as far away as tolerances allow: the model lacks something."
    )
    cure = "Look for what differs between the runs or is not in the model: bearings that drift, a support, a coupling."
    return [Reason(Verdict.NO, together, cure)]


def _judge_known(evidence: Evidence, most: float = 4.0) -> list[Reason]:
    """Whether the readings pull a coefficient ``most`` deviations from what was stated of its size: what was stated
    then bends the others, with bands as if it were right.
    """
    far = {name: abs(off) for name, off in evidence.departures.items() if abs(off) > most}
    if not far:
        return []
    name = rank(far)[0]
    reason = f"{name} came {far[name]:.0f} times as far from known_stiffness or known_damping as known_within allows"
    cure = "State a size that may be right in identify.known_stiffness and known_damping, or a larger known_within."
    return [Reason(Verdict.NO, f"{reason}, which bends the fit.", cure)]


def judge_coefficient(
    evidence: Evidence, determined: Determined, b: int, c: int, most_lost: float = 0.2
) -> tuple[list[Reason], dict[str, Any]]:
    """What speaks against one coefficient by itself, and the figures of its checks.

    ``most_lost`` is the share of the speeds at which a coefficient may be unknown and still be called good, or have
    the wrong sign.
    """
    name, node, values = COEFFICIENTS[c], evidence.answer.nodes[b], evidence.answer.values[b]
    sizes = measure_sizes(values)
    size = np.where(sizes[:, c] > 0, sizes[:, c], np.nan)
    fit = _median(evidence.by_fit[b, :, c] / size)
    tolerances = {kind: _median(tolerance[b, :, c] / size) for kind, tolerance in evidence.tolerances.items()}
    reasons = _judge_band(f"{name} at node {node}", determined, fit, tolerances)
    if not reasons and determined.lost > most_lost:
        lost = f"{name} at node {node} is not determined {determined.where}."
        reasons.append(Reason(Verdict.WITH_CARE, lost))
    if is_direct(name) and (wrong := float(np.mean(values[:, c] <= 0))) > 0.0:
        reasons.append(
            Reason(
                Verdict.NO if wrong > most_lost else Verdict.WITH_CARE,
                f"{name} at node {node} is negative at {100 * wrong:.0f} % of the speeds, which a bearing's "
                "direct coefficient hardly is.",
                "Check the phases of readings and weights, and the rotor's masses.",
            )
        )
    left_out, share, explained = _find_move(evidence, b, c)
    if left_out and share > 1.0:
        blamed = left_out.removeprefix("run ") in find_contradicted(evidence)
        reasons.append(
            Reason(
                Verdict.WITH_CARE,
                f"Without {left_out}, {name} at node {node} would be another by {write_rough(share)} times its band."
                + ("" if blamed else MODEL_MAY),
                f"Check {left_out}, or measure it again." if blamed else f"Check the model, and {left_out}.",
            )
        )
    band = {"percent": 100 * NOMINAL_95 * determined.deviation}
    if np.median(np.abs(values[:, c]) / size) < 1.0:  # it is judged beside the direct ones
        first = 4 * (c // 4)
        direct = np.sqrt(np.abs(values[:, first] * values[:, first + 3]))
        band["of_direct_percent"] = 100 * _median(evidence.band[b, :, c] / direct)
    checks = {
        "determination": {
            "deviation_percent": 100 * fit,
            "not_determined_at_percent_of_speeds": 100 * determined.lost,
            "not_determined": determined.where,
        },
        "band": band,
        "tolerances": {f"{kind}_percent": 100 * tolerance for kind, tolerance in tolerances.items()},
        "left_out": {"what": left_out, "move_over_band": share, "move_over_deviation": explained},
    }
    return reasons, checks


def _judge_band(which: str, determined: Determined, fit: float, tolerances: dict[str, float]) -> list[Reason]:
    """By the deviation with everything in it; ``fit`` is its share without tolerances."""
    verdict = determined.verdict
    if verdict is Verdict.GOOD:
        return []
    for kind in rank({name: tolerance for name, tolerance in tolerances.items() if tolerance > fit})[:1]:
        number = kind.replace("_", " ")
        return [
            Reason(
                verdict,
                f"A usual tolerance of {number}, which no fit corrects here, moves {which} by "
                f"{write_percent(tolerances[kind])}.",
                f"Measure {number} well, and state its tolerance as identify.model_parameters.{kind}.",
            )
        ]
    if verdict is Verdict.NO:
        deviation = write_percent(determined.deviation)
        return [Reason(verdict, f"The data do not determine {which}: {deviation} is one standard deviation.")]
    lost = f", and not determined {determined.where}" if determined.lost else ""
    known = write_percent(NOMINAL_95 * determined.deviation)
    return [Reason(verdict, f"{which} is known to {known} only (95 %){lost}.")]


def _find_move(evidence: Evidence, b: int, c: int, expected: float = 3.5) -> tuple[str | None, float, float]:
    """The run or probe without which a coefficient would move most: its name, the move over the band, over noise.

    Moves of ``expected`` deviations are no surprise: of sixteen coefficients and ten moves, one in a hundred.
    """
    largest: tuple[str | None, float, float] = (None, 0.0, 0.0)
    for name, (move, spread) in evidence.moves.items():
        with np.errstate(divide="ignore", invalid="ignore"):
            share = _median(np.abs(move[b, :, c]) / evidence.band[b, :, c])
            explained = _median(np.abs(move[b, :, c]) / spread[b, :, c])
        # A band that is wider by a misfit explains a larger move.
        explained /= np.sqrt(max(1.0, evidence.misfit.size))
        if np.isfinite(share) and explained > expected and share > largest[1]:
            largest = (name, share, explained)
    return largest


def _median(values: np.ndarray) -> float:
    """Infinite where it is undefined."""
    with np.errstate(invalid="ignore"):
        return float(np.median(np.where(np.isnan(values), np.inf, values)))
