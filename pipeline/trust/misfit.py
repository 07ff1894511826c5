"""Whether model and noise explain the readings: the one place that says so, from ``fit`` of ``training.json``."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np

from pipeline.data.sensors import FLOORS
from pipeline.identification.quality import FAR_FROM_EXPECTED, MISMATCH
from pipeline.write_numbers import write_number, write_percent, write_rough


@dataclass(frozen=True)
class Misfit:
    """What a fit leaves over, beside what its noise would."""

    size: float  # mean square over the noise, as far as it is known by itself; 1 where all is well
    probability: float | None  # of such deviations, or larger ones, if model and noise are right
    estimated: bool  # the noise was found from the readings
    noise_factor: float  # noise that was found over the stated one, median over the channels; 1 where it is stated
    of_stated: float  # mean square over the stated noise
    wanders: bool  # what is left over depends on the speed as no white noise does

    @property
    def distance(self) -> float:
        """How many times their noise the readings lie from the fit, root mean square."""
        return math.sqrt(self.size)

    @property
    def unlikely(self) -> bool:
        """Whether right models hardly ever leave such deviations."""
        return self.probability is not None and self.probability < MISMATCH

    def explained(self, small: float = 1.5, wide: float = 3.0) -> bool:
        """Whether model and noise explain the readings, or leave over no more than the bands are wider by.

        What is left over beyond a noise that was found, and lies within the stated one all the same, is no more.

        Args:
            small: mean square over the noise, up to which what is left over is below the noise.
            wide: estimated noise over the stated one, beyond which something other than noise is in it, if it wanders.
        """
        if self.estimated and self.of_stated < 1.0:
            return True
        if self.size >= FAR_FROM_EXPECTED or math.isnan(self.size):
            return False
        return not (self.unlikely and (self.size >= small or self.noise_factor >= wide))

    def is_gross(self, many: float = 10.0) -> bool:
        """Whether the model leaves so ``many`` times the noise that its answer is that of another machine: a wrong
        statement of the noise makes no deviations that depend on the speed.
        """
        return not self.explained() and self.wanders and max(self.distance, self.noise_factor) >= many

    @property
    def sentence(self) -> str:
        """In words, for every page and line that says whether the readings are explained."""
        noise = "the noise that was found" if self.estimated else "the stated noise"
        chance = (
            ""
            if self.probability is None
            else " (chance of such deviations, or larger ones: "
            + (f"{self.probability:.2g})" if self.probability >= 1e-6 else "below 1e-6)")
        )
        if not self.explained():
            return f"the model and {noise} do not explain the readings{chance}"
        if self.unlikely or self.size >= FAR_FROM_EXPECTED:
            return (
                f"the model and {noise} nearly explain the readings{chance}: what is left over is below the stated "
                "noise, and the bands are wider by it"
            )
        return f"the model and {noise} explain the readings{chance}"

    @property
    def contradiction(self) -> tuple[str, str] | None:
        """What speaks against the fit, and the next step; None where it explains the readings."""
        if self.explained():
            return None
        if self.noise_factor > self.distance:
            return (
                f"The readings lie {write_rough(self.noise_factor)} times as far from the fit as the stated noise, and "
                "their distance wanders over the speed.",
                "State the noise as it is (stated_noise), or find what else is in the readings: runout, a support, a "
                "wrong weight, a wrong probe.",
            )
        noise = "the noise that was found" if self.estimated else "stated noise"
        return (
            f"Model and {noise} do not explain the readings: they lie {write_rough(self.distance)} times as far from "
            f"the fit as {'noise alone would have it at neighbouring speeds' if self.estimated else 'their noise'}.",
            "Check units, angles, weights, probes and rotor; state what may be a little wrong as "
            "identify.model_parameters; use model=bearings_network for coefficients with kinks.",
        )


def measure_misfit(fit: Mapping[str, Any]) -> Misfit:
    """The Misfit by ``fit`` in ``training.json`` or ``metrics.json``.

    The probability is the smallest of three tests (chi-square, neighbours, all lags), times three (Bonferroni): also
    where one of them can't be made, which errs on the side of the model.

    Where the noise was estimated from what the fit leaves over, its size says nothing by itself. Then it is compared
    with what differs between neighbouring speeds, which a smooth error of the model leaves out: the mean square of the
    differences is ``2 (1 - r)`` times that of the values, with the correlation r of neighbours (von Neumann 1941).
    """
    square, whiteness, mismatch = fit["chi_square"], fit["whiteness"], fit["mismatch"]
    estimated = "noise_factor" in fit
    size = total = square["value"] / max(square["expected"], 1.0)
    if estimated:
        wandering = 1.0 / (1.0 - min(max(whiteness["autocorrelation"], 0.0), 0.99))
        size = wandering if mismatch["chi_square"] is None else max(size, wandering)
    tests = (mismatch["chi_square"], mismatch["whiteness"], whiteness.get("probability"))
    made = [min(1.0, len(tests) * p) for p in tests if p is not None]
    factor = float(np.median(list(fit["noise_factor"].values()))) if estimated else 1.0
    wanders = whiteness["autocorrelation"] > 0.5 or (whiteness.get("probability") or 0.0) < 1e-3
    return Misfit(float(size), min(made, default=None), estimated, factor, float(total * factor**2), wanders)


def describe_readings(training: Mapping[str, Any]) -> dict[str, str]:
    """How the fit of ``training.json`` or ``metrics.json`` follows its readings, for every line and page that says so.

    The ``distance`` at which they lie, whether ``neighbours`` correlate, whether model and noise ``explain`` them, and
    how many, or which runs, lie ``far_off``. A loss that weighs no noise has the distance alone, the residual.
    """
    if "fit" not in training:
        if training.get("loss", 0.0) is None:
            return {"distance": "the loss overflowed"}
        share = write_number(training["residual"]["mean_over_bearing_force"], digits=3)
        losses = (("loss", "loss"), ("held_out_loss", "at held-out speeds"))
        told = [f"{text} {write_number(training[key], digits=3)}" for key, text in losses if key in training]
        return {"distance": ", ".join([f"residual {share} of the bearing force (mean)", *told])}
    fit = training["fit"]
    square, white = fit["chi_square"], fit["whiteness"]
    drift, runs = "inconsistent_runs" in fit, ", ".join(fit.get("inconsistent_runs", ()))
    levels = "noise and what the model may be off by" if drift else "noise"
    if "noise" in fit:
        parts = [(fit["noise"].get(key, 0.0), unit) for key, unit, _ in FLOORS]
        parts += [(100 * fit["noise"]["multiplicative"], "% of a reading")]
        levels += f" ({' and '.join(f'{write_number(size, digits=2)} {unit}' for size, unit in parts if size)})"
    searched = describe_search(fit)
    return {
        "distance": f"chi-square {square['value']:.0f}, where {square['expected']:.0f} is expected: the readings lie "
        f"{math.sqrt(square['value'] / square['expected']):.2f} times as far off as their {levels}",
        "neighbours": f"neighbouring speeds correlate by {write_number(white['autocorrelation'], digits=2)} "
        f"({write_number(white['over_its_deviation'], digits=2)} deviations from none)",
        "explain": measure_misfit(fit).sentence,
        "far_off": f"runs that do not agree with the others, and weigh less: {runs or 'none'}"
        if drift
        else f"readings beyond 4 deviations: {fit['bad_points'] or 'none'} of {square['readings']}",
        **({"searched": searched} if searched else {}),
    }


def describe_search(fit: Mapping[str, Any], named: float = 0.05) -> str:
    """Among how many starts, or of which kinds of bearings, the answer was chosen; empty where there is one way.

    Kinds whose share of the evidence is at least ``named`` are told, and the likeliest.
    """
    if "starts" in fit:
        return f"{fit['starts']['at_this_answer']} of {fit['starts']['fitted']} starts ended at this answer"
    told = [
        f"{' and '.join(f'{kind} at node {node}' for node, kind in entry['of'].items())} "
        f"({write_percent(entry['share'])})".replace("_", " ")
        for i, entry in enumerate(fit.get("kinds", ()))
        if not i or entry["share"] >= named
    ]
    return f"bearings like these explain the readings: {', or '.join(told)}" if told else ""


def describe_held_out(kind: str, held_out: Mapping[str, Any], digits: int = 2) -> str:
    """What the fit makes of readings that it did not see; ``kind`` is ``held_out_speeds`` or ``held_out_runs``."""
    name, error = kind.replace("held_out_", "held-out "), held_out["error_percent"]
    if error is None:
        return f"{name} have no prediction: coefficients leave all bounds where nothing was fitted"
    return f"{name} predicted to {write_number(error, digits=digits)} %"
