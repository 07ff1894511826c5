"""The same machine measured again and again (``robustness.over=refit``): each time from the data to the bands.

Every data set has its own noise and, as ``machine.as_built`` says, its own errors of weights and probes. Every fit is
complete: its start, its choice of features and its weights are its own. So error and coverage are those of one who
measures once. The bound is that of the noise: the deviation at the true coefficients, as the functions that the fit
chose come nearest to them.

Legend: S training speeds, A active unknowns.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import KW_ONLY, dataclass, replace
from functools import partial
from typing import TYPE_CHECKING, Any

import numpy as np

from pipeline.config.schema import Config
from pipeline.data.tables import write_table
from pipeline.errors import ConfigError
from pipeline.evaluation.errors import CoefficientErrors, measure_coverage
from pipeline.evaluation.physical_numbers import NumberError, measure_numbers
from pipeline.files import write_json
from pipeline.identification.answer import conclude
from pipeline.identification.fit import fit_sensors, loss_of
from pipeline.identification.linear_start import start_at
from pipeline.identification.quality import MISMATCH
from pipeline.identification.training import setup_of
from pipeline.processes import open_pool
from pipeline.reporting.console import count_progress, say, table
from pipeline.reporting.figures import draw_refits
from pipeline.stages.execution import StageOutput, use_threads
from pipeline.stages.generate import model_machine, read_probes
from pipeline.stages.measurement import build_measurement, update_measurement
from pipeline.stages.unmeasured import measure_unmeasured, model_unmeasured
from pipeline.stages.workspace import locate_files

if TYPE_CHECKING:
    import pandas as pd


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
    numbers: Mapping[str, NumberError]  # of the bearing laws


def refit(config: Config, seed: int) -> Refit:
    """Measure the modelled machine once and identify it."""
    use_threads(config)
    rotor, truth, complete = model_machine(config, seed)
    asked = config.identify.unknowns_of(rotor.bearing_nodes).identified[:, None]
    known = replace(truth, values=np.where(asked, 0.0, truth.values))  # the fit sees nothing of what it is to find
    measurement = build_measurement(config, rotor, read_probes(config, rotor, complete, seed), known)
    sensors = fit_sensors(measurement, setup_of(config))
    fitted, unknowns = conclude(sensors), measurement.unknowns
    quality, identified, uncertainty = fitted.quality, fitted.model, fitted.uncertainty
    assert uncertainty is not None
    answer = identified.table(update_measurement(measurement, uncertainty).updated_known)
    deviation = np.nan_to_num(uncertainty.deviation(identified, truth.speeds, truth.operating))
    elsewhere = model_unmeasured(config, truth.speeds)

    def list_active(values: np.ndarray) -> np.ndarray:
        """(.., A) of values (B, .., 8)."""
        leading = unknowns.leading(values)
        return np.stack([leading[m, :, u] for m, u in unknowns.active], axis=-1)

    real, spread = list_active(truth.values), list_active(deviation)
    error = list_active(answer.values) - real
    keep = sensors.start.keep
    # Laws have no weights that give any coefficients: their bound is that of the answer.
    by_laws = bool(sensors.problem.measurement.laws)
    at_truth = sensors.weights if by_laws else start_at(sensors.problem, unknowns.leading(truth.values[:, keep]))
    bound = sensors.problem.unknown_deviation(at_truth)[0]  # (S, A)
    assert quality.misfit is not None
    return Refit(
        names=tuple((rotor.bearing_nodes[m], unknowns.names[u]) for m, u in unknowns.active),
        error=100 * np.median(np.abs(error / real), axis=0),
        within=measure_coverage(error.T, spread.T),
        over_bound=error[keep] / bound,
        bound=100 * np.median(bound / np.abs(real[keep]), axis=0),
        probability=quality.summary["fit"]["mismatch"]["probability"],
        misfit=quality.misfit,
        unmeasured={}
        if elsewhere is None
        else measure_unmeasured(identified.table(elsewhere), elsewhere, unknowns.by_bearing),
        numbers=measure_numbers(
            {number.name: (number.value, number.deviation) for number in fitted.numbers}, config.machine
        ),
    )


def run(config: Config) -> StageOutput:
    """``robustness.json``, ``robustness.csv`` (a row a data set, bearing and coefficient) and a figure.

    Raises ConfigError where the loss is another, or where there is no machine to measure again.
    """
    if not loss_of(config.loss).weighs_noise or config.machine.recordings.format != "none":
        raise ConfigError(
            "robustness over refits must have loss=response and a modelled machine, but "
            + (f"the loss is {config.loss.kind}" if config.machine.recordings.format == "none" else "data are measured")
            + ": use robustness=seeds loss=residual"
        )
    refits = list(_refit_all(config))
    rows, summary = _tabulate(refits), _summarize(refits)
    _print(config, summary)
    work = locate_files(config)
    written = [
        write_json(work.folder / "robustness.json", summary),
        write_table(work.folder / "robustness.csv", rows),
        draw_refits(work.figure("robustness"), rows),
    ]
    return StageOutput(summary, {}, written)


def _refit_all(config: Config) -> Iterator[Refit]:
    """In the order of the seeds, whatever the number of processes."""
    count = config.robustness.count
    with (
        count_progress(config.name, count, "data sets") as progress,
        open_pool(config.robustness.workers, config.threads) as each,
    ):
        for done, refitted in enumerate(each(partial(refit, config), range(count)), start=1):
            progress(done)
            yield refitted


def _tabulate(refits: list[Refit]) -> pd.DataFrame:
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


def _summarize(refits: list[Refit]) -> dict[str, object]:
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


def _summarize_physics(refits: list[Refit]) -> dict[str, object]:
    """Errors at conditions that no run has, and of the numbers of the bearing laws; nothing where there are none."""
    unmeasured: dict[str, dict[str, dict[str, dict[str, float]]]] = {}
    together = {}
    for state, bearings in refits[0].unmeasured.items():
        for node, names in bearings.items():
            for name in names:
                median = [refitted.unmeasured[state][node][name].median_error_percent for refitted in refits]
                unmeasured.setdefault(state, {}).setdefault(str(node), {})[name] = {
                    "median_error_percent": float(np.median(median)),
                    "worst_median_error_percent": float(np.max(median)),
                }
        medians = [error["median_error_percent"] for names in unmeasured[state].values() for error in names.values()]
        together[state] = {"median_error_percent": float(np.median(medians))}
    numbers = {}
    for name in refits[0].numbers:
        every = [refitted.numbers[name] for refitted in refits]
        numbers[name] = {
            "true": every[0].true,
            "median_error_percent": float(np.median([number.error_percent for number in every])),
            "worst_error_percent": float(np.max([number.error_percent for number in every])),
            "median_deviation_percent": float(np.median([100.0 * number.deviation / number.value for number in every])),
            "within_95_percent_interval": 100.0 * float(np.mean([number.within for number in every])),
        }
    elsewhere = {"unmeasured": unmeasured, "all_unmeasured": together} if unmeasured else {}
    return elsewhere | ({"numbers": numbers} if numbers else {})


def _print(config: Config, summary: Mapping[str, Any]) -> None:
    shown = [
        [
            f"node {node} {name}",
            f"{coefficient['median_error_percent']:.3g}",
            f"{coefficient['worst_median_error_percent']:.3g}",
            f"{coefficient['median_bound_percent']:.3g}",
            f"{coefficient['rmse_over_bound']:.2f}",
            f"{coefficient['within_95_percent_interval']:.1f}",
        ]
        for node, coefficients in summary["coefficients"].items()
        for name, coefficient in coefficients.items()
    ]
    errors = ["median error %, typical", "worst data set", "standard deviation by the bound, %", "error over bound"]
    header = ["bearing and coefficient", *errors, "inside the 95 % interval, %"]
    table(
        f"{config.name}: {summary['data_sets']} measurements of the machine, each identified by itself", header, shown
    )
    say(
        f"all coefficients: median error {summary['median_error_percent']:.3g} %, "
        f"{summary['within_95_percent_interval']:.1f} % inside the 95 % interval; the model is rejected in "
        f"{summary['rejected_percent']:.0f} % of the data sets"
    )
    for state, bearings in summary.get("unmeasured", {}).items():
        worst = max(entry["median_error_percent"] for names in bearings.values() for entry in names.values())
        typical = summary["all_unmeasured"][state]["median_error_percent"]
        say(f"at {state}, which no run has: median error {typical:.3g} %, of the worst coefficient {worst:.3g} %")
    for name, error in summary.get("numbers", {}).items():
        say(
            f"{name}: error {error['median_error_percent']:.3g} %, typically, "
            f"{error['worst_error_percent']:.3g} % at worst; "
            f"{error['within_95_percent_interval']:.0f} % inside the 95 % interval"
        )
