"""The same machine measured again and again (``robustness.over=refit``): each time from the data to the bands.

Every data set has its own noise and, as ``machine.as_built`` says, its own errors of weights and probes. Every fit is
complete: its start, its choice of features and its weights are its own. So the coverage is that of one who measures
once.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace
from functools import partial
from typing import TYPE_CHECKING

import numpy as np

from pipeline.config.schema import Config
from pipeline.data.tables import write_table
from pipeline.errors import ConfigError
from pipeline.evaluation.errors import measure_coverage
from pipeline.files import write_json
from pipeline.identification.fit import fit
from pipeline.identification.losses import loss_of
from pipeline.identification.training import setup_of
from pipeline.processes import open_pool
from pipeline.reporting.console import count_progress, say, table
from pipeline.reporting.error_table import MISMATCH
from pipeline.stages.execution import StageOutput, use_threads
from pipeline.stages.generate import model_machine, read_probes
from pipeline.stages.measurement import build_measurement, update_measurement
from pipeline.stages.workspace import locate_files

if TYPE_CHECKING:
    import pandas as pd


@dataclass(frozen=True, eq=False)
class Refit:
    """One data set: per active unknown A, and of the whole fit."""

    names: tuple[tuple[int, str], ...]  # A of (bearing node, coefficient)
    error: np.ndarray  # (A,) median over speed, percent
    within: np.ndarray  # (A,) percent of the speeds inside the 95 % interval
    probability: float | None  # of such deviations, or larger ones, if the model is right
    misfit: float  # chi-square over what is expected


def refit(config: Config, seed: int) -> Refit:
    """Measure the modelled machine once and identify it."""
    use_threads(config)
    rotor, truth, complete = model_machine(config, seed)
    asked = config.identify.unknowns_of(rotor.bearing_nodes).identified[:, None]
    known = replace(truth, values=np.where(asked, 0.0, truth.values))  # the fit sees nothing of what it is to find
    measurement = build_measurement(config, rotor, read_probes(config, rotor, complete, seed), known)
    setup = setup_of(config)
    found = fit(measurement, setup)
    answer = found.table(update_measurement(measurement, found.uncertainty).updated_known)
    deviation = found.deviation(truth.speeds)
    assert deviation is not None
    assert found.quality.misfit is not None
    unknowns = measurement.unknowns
    reached, real = unknowns.leading(answer.values), unknowns.leading(truth.values)
    error, spread = reached - real, unknowns.leading(np.nan_to_num(deviation))
    return Refit(
        names=tuple((rotor.bearing_nodes[m], unknowns.names[u]) for m, u in unknowns.active),
        error=np.array([100 * np.median(np.abs(error[m, :, u] / real[m, :, u])) for m, u in unknowns.active]),
        within=np.array([measure_coverage(error[m, :, u], spread[m, :, u]) for m, u in unknowns.active]),
        probability=found.quality.summary["fit"]["mismatch"]["probability"],
        misfit=found.quality.misfit,
    )


def run(config: Config) -> StageOutput:
    """``robustness.json`` and ``robustness.csv``, a row a data set, bearing and coefficient.

    Raises ConfigError where the loss is another, or where there is no machine to measure again.
    """
    if not loss_of(config.loss).weighs_noise or config.machine.recordings.format != "none":
        raise ConfigError(
            "robustness over refits must have loss=response and a modelled machine, but "
            + (f"the loss is {config.loss.kind}" if config.machine.recordings.format == "none" else "data are measured")
            + ": use robustness=seeds loss=residual"
        )
    found = list(_refit_all(config))
    rows, summary = _tabulate(found), _summarize(found)
    _print(config, rows, summary)
    work = locate_files(config)
    written = [write_json(work.folder / "robustness.json", summary), write_table(work.folder / "robustness.csv", rows)]
    return StageOutput(summary, {}, written)


def _refit_all(config: Config) -> Iterator[Refit]:
    """In the order of the seeds, whatever the number of processes."""
    count = config.robustness.count
    with (
        count_progress(config.name, count, "data sets") as progress,
        open_pool(config.robustness.workers, config.threads) as each,
    ):
        for done, found in enumerate(each(partial(refit, config), range(count)), start=1):
            progress(done)
            yield found


def _tabulate(found: list[Refit]) -> pd.DataFrame:
    import pandas as pd

    return pd.DataFrame(
        {
            "data_set": g,
            "bearing_node": node,
            "coefficient": name,
            "median_error_percent": of.error[a],
            "within_95_percent_interval": of.within[a],
            "probability": of.probability,
            "chi_square_over_expected": of.misfit,
        }
        for g, of in enumerate(found)
        for a, (node, name) in enumerate(of.names)
    )


def _summarize(found: list[Refit]) -> dict[str, object]:
    coefficients: dict[str, dict[str, dict[str, float]]] = {}
    error, within = (np.array([getattr(of, name) for of in found]) for name in ("error", "within"))
    for a, (node, name) in enumerate(found[0].names):
        coefficients.setdefault(str(node), {})[name] = {
            "median_error_percent": float(np.median(error[:, a])),
            "worst_median_error_percent": float(error[:, a].max()),
            "within_95_percent_interval": float(within[:, a].mean()),
        }
    rejected = [of.probability is not None and of.probability < MISMATCH for of in found]
    return {
        "data_sets": len(found),
        "median_error_percent": float(np.median(error)),
        "within_95_percent_interval": float(within.mean()),
        "rejected_percent": 100.0 * float(np.mean(rejected)),
        "chi_square_over_expected": float(np.median([of.misfit for of in found])),
        "coefficients": coefficients,
    }


def _print(config: Config, rows: pd.DataFrame, summary: dict[str, object]) -> None:
    every = rows.groupby(["bearing_node", "coefficient"], sort=False)
    shown = [
        [
            f"node {node} {name}",
            f"{of['median_error_percent'].median():.3g}",
            f"{of['median_error_percent'].max():.3g}",
            f"{of['within_95_percent_interval'].mean():.1f}",
        ]
        for (node, name), of in every
    ]
    header = ["bearing and coefficient", "median error %, typical", "worst data set", "inside the 95 % interval, %"]
    table(
        f"{config.name}: {summary['data_sets']} measurements of the machine, each identified by itself", header, shown
    )
    say(
        f"all coefficients: median error {summary['median_error_percent']:.3g} %, "
        f"{summary['within_95_percent_interval']:.1f} % inside the 95 % interval; the model is rejected in "
        f"{summary['rejected_percent']:.0f} % of the data sets"
    )
