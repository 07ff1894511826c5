"""The same machine under other noise (``robustness.over=noise``): errors against their bound, intervals' coverage."""

from __future__ import annotations

from collections.abc import Mapping
from typing import TYPE_CHECKING, Any

import numpy as np

from pipeline.coefficients import COEFFICIENTS
from pipeline.config.schema import Config
from pipeline.data.tables import write_table
from pipeline.errors import ConfigError
from pipeline.evaluation.fit_quality import within
from pipeline.files import write_json
from pipeline.identification.monte_carlo import MonteCarlo, monte_carlo
from pipeline.identification.outcome import Outcome
from pipeline.identification.response_fit import ResponseFit, unknown_deviation
from pipeline.identification.response_preparation import start_at
from pipeline.identification.training import setup_of
from pipeline.reporting.console import table, training_progress
from pipeline.reporting.noise_figures import noise_figure
from pipeline.rotor.bearing_table import BearingTable
from pipeline.stages.diagnosis import say_diagnosis
from pipeline.stages.evaluate import load_modelled
from pipeline.stages.inputs import Inputs, load_inputs
from pipeline.stages.response import fitted, prepared_response
from pipeline.stages.run import StageOutput, flat_metrics, use_threads, workspace

if TYPE_CHECKING:
    import pandas as pd


def run(config: Config) -> StageOutput:
    """``robustness.json``, ``robustness.csv`` (a row a data set, bearing and coefficient) and a figure.

    Raises ConfigError where the loss is another, or where there is no truth to make other noise for.
    """
    inputs, setup = load_inputs(config), setup_of(config)
    use_threads(config)
    modelled = load_modelled(config, inputs)
    if config.loss.kind != "response" or modelled is None:
        raise ConfigError(
            "robustness over noise must have loss=response and modelled data, but "
            + ("the data are measured" if modelled is None else f"the loss is {config.loss.kind}")
            + ": use robustness=seeds loss=residual"
        )
    say_diagnosis(config, inputs)
    prepared = prepared_response(config, inputs, setup)
    with training_progress(config.name) as progress:
        fit = fitted(config, prepared, setup, progress)
    generator = np.random.default_rng([config.machine.probes.seed, 1])
    clean = prepared.data.equations.predict(modelled)
    study = monte_carlo(
        fit, clean, config.robustness.count, generator, setup.optimizer.levenberg_marquardt, config.device
    )
    rows, summary = _judged(inputs, fit, study, modelled)
    _print(config, rows, summary)
    work = workspace(config)
    written = [
        write_json(work.folder / "robustness.json", summary),
        write_table(work.folder / "robustness.csv", rows),
        noise_figure(work.figure("robustness"), rows),
    ]
    interrupted = fit.outcome is Outcome.INTERRUPTED
    return StageOutput(
        flat_metrics(summary), {"data_fingerprint": inputs.dataset.fingerprint}, written, exit_code=130 * interrupted
    )


def _truth(fit: ResponseFit, modelled: BearingTable) -> np.ndarray:
    """(M, S, U) the modelled unknowns at the training speeds."""
    unknowns = fit.prepared.training.unknowns
    members = len(fit.problem.scale)
    values = modelled.values[:members, fit.prepared.keep]
    leaders = [COEFFICIENTS.index(name) for name in unknowns.names]
    return np.asarray(values[..., leaders])


def _judged(
    inputs: Inputs, fit: ResponseFit, study: MonteCarlo, modelled: BearingTable
) -> tuple[pd.DataFrame, dict[str, object]]:
    """The bound is that of the modelled coefficients, as the network comes nearest to them."""
    import pandas as pd

    truth = _truth(fit, modelled)
    bound = unknown_deviation(fit.problem, start_at(fit.problem, truth))[0]  # (S, A)
    found, stated = study.unknowns(), study.deviations()  # (G, S, A)
    rows: list[dict[str, object]] = []
    coefficients: dict[str, dict[str, dict[str, float]]] = {}
    for a, (m, u) in enumerate(fit.problem.active):
        name, node = fit.prepared.training.unknowns.names[u], fit.prepared.training.bearing_nodes[m]
        error = found[..., a] - truth[m, :, u]
        relative = 100.0 * np.abs(error / truth[m, :, u])
        held = within(error, stated[..., a])  # (G,)
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
