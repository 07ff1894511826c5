"""What a method made of a case: an answer with its errors, or the name of what it can't do."""

from __future__ import annotations

import time
from dataclasses import asdict

import numpy as np
from pydantic import BaseModel, ConfigDict

from pipeline.coefficients import COEFFICIENTS
from pipeline.comparison.cases import Case, Machine
from pipeline.config.comparison import MethodName, SensorSet
from pipeline.evaluation.errors import measure_coverage, measure_relative_errors
from pipeline.methods.catalogue import METHODS
from pipeline.methods.method import REQUIREMENTS, Estimate, MethodOptions, Refusal
from pipeline.problem.measurement import Measurement


class CoefficientResult(BaseModel):
    """One coefficient of one bearing; percent."""

    model_config = ConfigDict(extra="forbid", frozen=True)

    median_error: float
    p95_error: float
    median_deviation: float | None = None  # stated, over the modelled coefficient
    within_interval: float | None = None  # of the speeds at which the modelled one is in the nominal 95 % interval


class Result(BaseModel):
    """One row of the comparison."""

    model_config = ConfigDict(extra="forbid", frozen=True)

    method: MethodName
    noise: float
    sensors: SensorSet
    speeds: int
    data_set: int
    outcome: str  # "answered", or a name of REQUIREMENTS
    words: str
    doubt: str
    seconds: float
    used_speeds: int | None = None  # where the method did not look at all of them
    coefficients: dict[str, dict[str, CoefficientResult]]  # node -> name; empty where there is no answer

    @property
    def case(self) -> Case:
        """What was measured."""
        return Case(self.noise, self.sensors, self.speeds, self.data_set)

    @property
    def answered(self) -> bool:
        """Whether there are coefficients."""
        return self.outcome == ANSWERED

    def error(self, name: str) -> float:
        """Median error over speed of a coefficient in percent, mean over the bearings that have it; NaN without one."""
        errors = [coefficient[name].median_error for coefficient in self.coefficients.values() if name in coefficient]
        return float(np.mean(errors)) if errors else float("nan")


ANSWERED = "answered"


def judge_method(machine: Machine, method: MethodName, case: Case) -> Result:
    """Let a method identify a case. The truth is looked at when it has answered."""
    data = machine.measure(case)
    started = time.process_time()
    answer, outcome, reason = _ask(method, data, MethodOptions(machine.settings, machine.seed, machine.laws))
    seconds = time.process_time() - started  # of the processor: what else runs does not count
    errors: dict[str, dict[str, CoefficientResult]] = {}
    if answer and np.isfinite(answer.coefficients.values).all():
        errors = _measure_errors(data, answer, machine, case)
    elif answer:
        outcome = "not_finite"
    # Clean data have no noise that chi-square could be held against.
    doubt = answer.doubt if answer and case.noise else ""
    return Result(
        **asdict(case),
        method=method,
        outcome=outcome,
        words=reason,
        doubt=doubt,
        seconds=seconds,
        used_speeds=(answer and answer.n_speeds) or None,
        coefficients=errors,
    )


def _ask(method: MethodName, data: Measurement, options: MethodOptions) -> tuple[Estimate | None, str, str]:
    try:
        answer = METHODS[method].identify(data, options)
    except Refusal as refusal:
        return None, refusal.reason, str(refusal)
    except np.linalg.LinAlgError as error:
        return None, "singular", f"{REQUIREMENTS['singular']}, but: {error}"
    return answer, ANSWERED, answer.words


def _measure_errors(
    data: Measurement, answer: Estimate, machine: Machine, case: Case
) -> dict[str, dict[str, CoefficientResult]]:
    truth = machine.truth(case)
    errors: dict[str, dict[str, CoefficientResult]] = {}
    for b, c in np.argwhere(data.unknowns.identified):
        relative = measure_relative_errors(answer.coefficients, truth, COEFFICIENTS[c])[b]
        relative = relative[~np.isnan(relative)]
        if not len(relative):
            continue
        deviation, true = answer.deviation[b, :, c], truth.values[b, :, c]
        median, stated = float(100 * np.median(deviation / np.abs(true))), not np.isnan(deviation).all()
        coverage = measure_coverage(answer.coefficients.values[b, :, c] - true, deviation)
        errors.setdefault(str(truth.nodes[b]), {})[COEFFICIENTS[c]] = CoefficientResult(
            median_error=float(np.median(relative)),
            p95_error=float(np.percentile(relative, 95)),
            median_deviation=median if np.isfinite(median) else None,
            within_interval=float(coverage) if stated else None,
        )
    return errors
