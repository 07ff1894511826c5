"""A measurement trained many times, from guesses or seeds; a machine measured and identified many times.

The bound of the second is that of the noise: the deviation at the true coefficients, as the functions that the fit
chose come nearest to them.

Legend: G starts, S training speeds, A active unknowns.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import KW_ONLY, dataclass
from typing import TYPE_CHECKING, Any

import numpy as np

from pipeline.config.identification import RobustnessConfig
from pipeline.config.machine import MachineConfig
from pipeline.evaluation.errors import (
    CoefficientErrors,
    measure_coverage,
    measure_errors,
    measure_numbers,
    measure_unmeasured,
)
from pipeline.identification.answer import conclude
from pipeline.identification.identified import answer_of
from pipeline.identification.linear_start import start_at
from pipeline.identification.output_error_fit import fit_output_error
from pipeline.identification.quality import MISMATCH
from pipeline.identification.training import FitSetup, Minimum
from pipeline.problem.measurement import Measurement
from pipeline.rotor.bearing_table import BearingTable

if TYPE_CHECKING:
    import pandas as pd


_KINDS = ("mean_error_percent", "median_error_percent", "p95_error_percent")


def choose_starts(spec: RobustnessConfig) -> np.ndarray:
    """(G,) initial stiffnesses in N/m, log-spaced, or seeds."""
    if spec.over == "seed":
        return np.array(spec.seeds)
    return np.geomspace(spec.lowest_stiffness, spec.highest_stiffness, spec.count)


def tabulate_starts(
    over: str,
    starts: np.ndarray,
    minimum: Minimum,
    answers: Sequence[BearingTable],
    modelled: BearingTable | None,
    names: Sequence[Sequence[str]],
) -> pd.DataFrame:
    """A row a start (G,), bearing and coefficient; the error is NaN where there is no truth."""
    import pandas as pd

    errors = [{} if modelled is None else measure_errors(answer, modelled, names) for answer in answers]
    return pd.DataFrame(
        {
            over: start,
            "bearing_node": node,
            "coefficient": name,
            "mean_value": float(answer.coefficient(name)[b].mean()),
            **{kind: errors[g].get(str(node), {}).get(name, {}).get(kind, np.nan) for kind in _KINDS},
            "loss": float(minimum.loss[g]),
            "outcome": minimum.outcomes[g].label,
        }
        for g, (start, answer) in enumerate(zip(starts, answers, strict=True))
        for b, node in enumerate(answer.nodes)
        for name in names[b]
    )


def summarize_starts(minimum: Minimum, rows: pd.DataFrame) -> dict[str, Any]:
    """Outcomes, and the worst and median errors over the starts."""
    labels = [outcome.label for outcome in minimum.outcomes]
    coefficients: dict[str, dict[str, dict[str, float]]] = {}
    for (node, name), group in rows.groupby(["bearing_node", "coefficient"], sort=False):
        errors = group["mean_error_percent"]
        if errors.notna().all():
            values = {
                "worst_mean_error_percent": float(errors.max()),
                "median_mean_error_percent": float(errors.median()),
                "worst_median_error_percent": float(group["median_error_percent"].max()),
                "worst_p95_error_percent": float(group["p95_error_percent"].max()),
            }
            coefficients.setdefault(str(node), {})[str(name)] = values
    return {
        "starts": len(labels),
        "outcomes": {label: labels.count(label) for label in sorted(set(labels))},
        "worst_loss": float(minimum.loss.max()),
        "coefficients": coefficients,
    }


@dataclass(frozen=True, eq=False)
class Refit:
    """One data set: per active unknown A, and of the whole fit."""

    names: tuple[tuple[int, str], ...]  # A of (bearing node, coefficient)
    error: np.ndarray  # (A,) median over speed, percent
    within: np.ndarray  # (A,) percent of the speeds inside the 95 % interval
    over_bound: np.ndarray  # (S, A) error over its Cramer-Rao bound
    bound: np.ndarray  # (A,) median over speed, percent
    probability: float | None  # of such deviations, or larger ones, if the model is right
    misfit: float  # chi-square over what is expected
    _: KW_ONLY
    unmeasured: Mapping[str, CoefficientErrors]  # at conditions that no run has, by their words
    numbers: Mapping[str, Mapping[str, float]]  # of the bearing laws, with their errors


def refit(
    measurement: Measurement,
    setup: FitSetup,
    truth: BearingTable,
    elsewhere: BearingTable | None,
    machine: MachineConfig,
) -> Refit:
    """Identify a measurement of the modelled ``machine``, whose coefficients are the ``truth``, and ``elsewhere`` at
    conditions that no run has."""
    sensors = fit_output_error(measurement, setup)
    fitted, unknowns = conclude(sensors), measurement.unknowns
    answer = answer_of(measurement, fitted.model, fitted.uncertainty)
    tables = (truth.values, np.nan_to_num(answer.state(truth).spread), answer.table.values)
    real, spread, answered = (unknowns.to_active(unknowns.leading(values)) for values in tables)
    error = answered - real
    keep = sensors.start.keep
    # Laws have no weights that give any coefficients: their bound is that of the answer.
    by_laws = bool(sensors.problem.measurement.laws)
    at_truth = sensors.weights if by_laws else start_at(sensors.problem, unknowns.leading(truth.values[:, keep]))
    bound = sensors.problem.unknown_deviation(at_truth)[0]  # (S, A)
    assert fitted.quality.misfit is not None
    return Refit(
        names=tuple((truth.nodes[m], unknowns.names[u]) for m, u in unknowns.active),
        error=100 * np.median(np.abs(error / real), axis=0),
        within=measure_coverage(error.T, spread.T),
        over_bound=error[keep] / bound,
        bound=100 * np.median(bound / np.abs(real[keep]), axis=0),
        probability=fitted.quality.summary["fit"]["mismatch"]["probability"],
        misfit=fitted.quality.misfit,
        unmeasured={}
        if elsewhere is None
        else measure_unmeasured(fitted.table(elsewhere), elsewhere, unknowns.by_bearing),
        numbers=measure_numbers(fitted.quality.summary.get("physical_numbers", {}), machine),
    )


def tabulate_refits(refits: Sequence[Refit]) -> pd.DataFrame:
    """A row a data set, bearing and coefficient."""
    import pandas as pd

    return pd.DataFrame(
        {
            "data_set": g,
            "bearing_node": node,
            "coefficient": name,
            "median_error_percent": refitted.error[a],
            "within_95_percent_interval": refitted.within[a],
            "probability": refitted.probability,
            "chi_square_over_expected": refitted.misfit,
        }
        for g, refitted in enumerate(refits)
        for a, (node, name) in enumerate(refitted.names)
    )


def summarize_refits(refits: Sequence[Refit]) -> dict[str, object]:
    """Typical and worst errors, coverage, and how often the model is rejected."""
    coefficients: dict[str, dict[str, dict[str, float]]] = {}
    error, within = (np.array([getattr(refitted, name) for refitted in refits]) for name in ("error", "within"))
    over_bound = np.array([refitted.over_bound for refitted in refits])  # (data sets, S, A)
    for a, (node, name) in enumerate(refits[0].names):
        coefficients.setdefault(str(node), {})[name] = {
            "median_error_percent": float(np.median(error[:, a])),
            "worst_median_error_percent": float(error[:, a].max()),
            "within_95_percent_interval": float(within[:, a].mean()),
            # Each speed has a bound of its own: the mean of the squared ratio over speeds and data sets.
            "rmse_over_bound": float(np.sqrt((over_bound[..., a] ** 2).mean())),
            "bias_over_bound": float(np.sqrt((over_bound[..., a].mean(axis=0) ** 2).mean())),
            "median_bound_percent": float(np.median([refitted.bound[a] for refitted in refits])),
        }
    rejected = [refitted.probability is not None and refitted.probability < MISMATCH for refitted in refits]
    return {
        "data_sets": len(refits),
        "median_error_percent": float(np.median(error)),
        "within_95_percent_interval": float(within.mean()),
        "rejected_percent": 100.0 * float(np.mean(rejected)),
        "chi_square_over_expected": float(np.median([refitted.misfit for refitted in refits])),
        "coefficients": coefficients,
        **_summarize_physics(refits),
    }


def _summarize_physics(refits: Sequence[Refit]) -> dict[str, object]:
    """Errors at conditions that no run has, and of the numbers of the bearing laws; nothing where there are none."""
    unmeasured = {
        state: {
            node: {
                name: {
                    "median_error_percent": float(np.median(errors)),
                    "worst_median_error_percent": float(np.max(errors)),
                }
                for name in names
                for errors in [[refitted.unmeasured[state][node][name]["median_error_percent"] for refitted in refits]]
            }
            for node, names in bearings.items()
        }
        for state, bearings in refits[0].unmeasured.items()
    }
    together = {
        state: {
            "median_error_percent": float(
                np.median([e["median_error_percent"] for names in bearings.values() for e in names.values()])
            )
        }
        for state, bearings in unmeasured.items()
    }
    numbers = {}
    for name in refits[0].numbers:
        every = [refitted.numbers[name] for refitted in refits]
        numbers[name] = {
            "true": every[0]["true"],
            "median_error_percent": float(np.median([number["error_percent"] for number in every])),
            "worst_error_percent": float(np.max([number["error_percent"] for number in every])),
            "median_deviation_percent": float(np.median([100.0 * n["deviation"] / n["value"] for n in every])),
            "within_95_percent_interval": 100.0 * float(np.mean([number["within"] for number in every])),
        }
    elsewhere = {"unmeasured": unmeasured, "all_unmeasured": together} if unmeasured else {}
    return elsewhere | ({"numbers": numbers} if numbers else {})
