"""The same machine under other noise (``robustness.over=noise``): errors against their bound, intervals' coverage."""

from __future__ import annotations

from collections.abc import Mapping
from typing import TYPE_CHECKING, Any

import numpy as np

from pipeline.config.schema import Config
from pipeline.data.tables import write_table
from pipeline.errors import ConfigError
from pipeline.evaluation.errors import measure_coverage
from pipeline.files import write_json
from pipeline.identification.losses import loss_of
from pipeline.identification.monte_carlo import MonteCarlo, monte_carlo
from pipeline.identification.outcome import Outcome
from pipeline.identification.output_error_fit import OutputErrorFit, fit_output_error, unknown_deviation
from pipeline.identification.output_error_start import start_at
from pipeline.identification.training import setup_of
from pipeline.reporting.console import table, training_progress
from pipeline.reporting.figures import draw_noise_study
from pipeline.rotor.bearing_table import BearingTable
from pipeline.stages.diagnose import say_diagnosis
from pipeline.stages.execution import StageOutput, use_threads
from pipeline.stages.measurement import load_measurement, load_modelled
from pipeline.stages.workspace import locate_files

if TYPE_CHECKING:
    import pandas as pd


def run(config: Config) -> StageOutput:
    """``robustness.json``, ``robustness.csv`` (a row a data set, bearing and coefficient) and a figure.

    Raises ConfigError where the loss is another, or where there is no truth to make other noise for.
    """
    measurement, setup = load_measurement(config), setup_of(config)
    use_threads(config)
    modelled = load_modelled(config, measurement)
    if not loss_of(config.loss).weighs_noise or modelled is None:
        raise ConfigError(
            "robustness over noise must have loss=response and modelled data, but "
            + ("the data are measured" if modelled is None else f"the loss is {config.loss.kind}")
            + ": use robustness=seeds loss=residual"
        )
    if config.loss.hidden == "trained":
        raise ConfigError(
            "robustness over noise must have loss.hidden=drawn, whose fits are repeated in one batch, but got trained: "
            "use robustness=refits"
        )
    say_diagnosis(config, measurement)
    with training_progress(config.name) as progress:
        fit = fit_output_error(measurement, setup, progress)
    generator = np.random.default_rng([config.machine.probes.seed, 1])
    clean = measurement.response.predict(modelled)
    study = monte_carlo(
        fit, clean, config.robustness.count, generator, setup.optimizer.levenberg_marquardt, config.device
    )
    rows, summary = _judge(fit, study, modelled)
    _print(config, rows, summary)
    work = locate_files(config)
    written = [
        write_json(work.folder / "robustness.json", summary),
        write_table(work.folder / "robustness.csv", rows),
        draw_noise_study(work.figure("robustness"), rows),
    ]
    interrupted = fit.minimum.outcomes[0] is Outcome.INTERRUPTED
    return StageOutput(
        summary,
        {"data_fingerprint": measurement.dataset.fingerprint},
        written,
        exit_code=130 * interrupted,
    )


def _judge(fit: OutputErrorFit, study: MonteCarlo, modelled: BearingTable) -> tuple[pd.DataFrame, dict[str, object]]:
    """The bound is that of the modelled coefficients, as the network comes nearest to them."""
    import pandas as pd

    unknowns, nodes = fit.start.measurement.unknowns, fit.start.measurement.rotor.bearing_nodes
    truth = unknowns.leading(modelled.values[:, fit.start.keep])  # (M, S, U)
    bound = unknown_deviation(fit.problem, start_at(fit.problem, truth))[0]  # (S, A)
    found, stated = study.unknowns(), study.deviations()  # (G, S, A)
    rows: list[dict[str, object]] = []
    coefficients: dict[str, dict[str, dict[str, float]]] = {}
    for a, (m, u) in enumerate(fit.problem.active):
        name, node = unknowns.names[u], nodes[m]
        error = found[..., a] - truth[m, :, u]
        relative = 100.0 * np.abs(error / truth[m, :, u])
        held = measure_coverage(error, stated[..., a])  # (G,)
        for g in range(len(found)):
            rows.append(
                {
                    "data_set": g,
                    "bearing_node": node,
                    "coefficient": name,
                    "median_error_percent": float(np.median(relative[g])),
                    "within_95_percent_interval": float(held[g]),
                }
            )
        # Each speed has a bound of its own: the mean of the squared ratio over speeds and data sets.
        coefficients.setdefault(str(node), {})[name] = {
            "rmse_over_bound": float(np.sqrt(((error / bound[:, a]) ** 2).mean())),
            "bias_over_bound": float(np.sqrt(((error.mean(axis=0) / bound[:, a]) ** 2).mean())),
            "within_95_percent_interval": float(held.mean()),
            "median_error_percent": float(np.median(relative)),
            "median_bound_percent": float(100 * np.median(bound[:, a] / np.abs(truth[m, :, u]))),
        }
    return pd.DataFrame(rows), {"data_sets": len(found), "coefficients": coefficients}


def _print(config: Config, rows: pd.DataFrame, summary: Mapping[str, Any]) -> None:
    worst = rows.groupby(["bearing_node", "coefficient"])["median_error_percent"].max()
    shown = [
        [
            f"node {node} {name}",
            f"{of['median_error_percent']:.3g}",
            f"{worst[int(node), name]:.3g}",
            f"{of['median_bound_percent']:.3g}",
            f"{of['rmse_over_bound']:.2f}",
            f"{of['within_95_percent_interval']:.1f}",
        ]
        for node, coefficients in summary["coefficients"].items()
        for name, of in coefficients.items()
    ]
    errors = ["median error %, typical", "worst data set", "bound, median %", "error over bound"]
    header = ["bearing and coefficient", *errors, "inside the 95 % interval, %"]
    table(f"{config.name}: {summary['data_sets']} data sets with other noise", header, shown)
