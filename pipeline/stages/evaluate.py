"""Identified against modelled coefficients; per-speed least squares and the residual beside them."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from pipeline.coefficients import COEFFICIENTS
from pipeline.config.schema import Config
from pipeline.data.coefficient_files import read_coefficients, write_coefficients
from pipeline.data.tables import fingerprint_of, write_table
from pipeline.equations.least_squares import per_speed_least_squares
from pipeline.equations.unknown_system import unknown_system
from pipeline.errors import DataError
from pipeline.evaluation.errors import CoefficientErrors, as_metrics, coefficient_errors, worst_mean_error
from pipeline.evaluation.fit_quality import within
from pipeline.files import read_json, write_json
from pipeline.identification.identified import IdentifiedModel
from pipeline.identification.storage import ARCHITECTURE, WEIGHTS, load_model
from pipeline.identification.uncertainty import UNCERTAINTY, load_uncertainty
from pipeline.reporting.console import say, table
from pipeline.reporting.figures import coefficient_figure, history_figure
from pipeline.rotor.bearing_table import BearingTable
from pipeline.stages.diagnosis import diagnose
from pipeline.stages.inputs import Inputs, load_inputs
from pipeline.stages.run import StageOutput, flat_metrics, input_files, make_missing, workspace
from pipeline.unknowns import unknown_set

if TYPE_CHECKING:
    import pandas as pd


def load_identified(config: Config, inputs: Inputs) -> IdentifiedModel:
    """The trained model, training first where it is missing. Raises DataError where other data trained it."""
    work = workspace(config)
    model_files = [work.folder / name for name in (WEIGHTS, ARCHITECTURE, UNCERTAINTY)]
    make_missing(config, "train", *model_files, work.training, work.history)
    account = read_json(work.training)
    identified = load_model(work.folder)
    laws = {
        "the data at hand": account.get("data_fingerprint") == inputs.dataset.fingerprint,
        "the model beside it": account.get("model") == " ".join(fingerprint_of(path) for path in model_files),
        f"the bearings at nodes {list(inputs.rotor.bearing_nodes)}": identified.bearing_nodes
        == inputs.rotor.bearing_nodes,
        f"the unknowns {', '.join(config.identify.named())}": _same_unknowns(config, identified),
    }
    for law, holds in laws.items():
        if not holds:
            raise DataError(
                f"'{work.training}' must belong to {law}, but it does not: run stage=train with the same overrides"
            )
    return identified


def _finite(value: float) -> float | None:
    """JSON has no infinity."""
    return float(value) if np.isfinite(value) else None


def _same_unknowns(config: Config, identified: IdentifiedModel) -> bool:
    wanted = unknown_set({node: config.identify.at(node) for node in identified.bearing_nodes})
    found = identified.unknowns
    order = [found.names.index(name) for name in wanted.names] if set(wanted.names) == set(found.names) else []
    return bool(order) and np.array_equal(wanted.expansion, found.expansion[..., order])


def load_modelled(config: Config, inputs: Inputs) -> BearingTable | None:
    """The truth of modelled data; None where there is none, as with measured data."""
    path = workspace(config).modelled
    if not input_files(config).own or not path.exists():
        return None
    return read_coefficients(path, inputs.rotor.bearing_nodes, inputs.dataset.speeds)


def run(config: Config) -> StageOutput:
    """Errors, their summary (worst bearing, parts per million), least-squares coefficients, Figures 3 and 4."""
    work, inputs = workspace(config), load_inputs(config)
    identified = load_identified(config, inputs)
    uncertainty = load_uncertainty(work.folder, identified)
    deviation = None if uncertainty is None else uncertainty.deviation(identified, inputs.dataset.speeds)
    names = identified.unknowns.by_bearing
    answer = identified.table(inputs.known)
    modelled = load_modelled(config, inputs)
    left_over = (_of_response if config.loss.kind == "response" else _of_residual)(config, inputs, identified)
    conventional, summary = left_over.conventional, dict(left_over.summary)
    metrics: dict[str, object] = {"coefficients": {}, **left_over.metrics}
    written: list[Path] = []
    if conventional is not None:
        written.append(write_coefficients(work.folder / "least_squares_coefficients.csv", conventional))
    errors: CoefficientErrors | None = None
    beside: CoefficientErrors | None = None
    if modelled is not None:
        errors = coefficient_errors(answer, modelled, names)
        beside = None if conventional is None else coefficient_errors(conventional, modelled, names)
        summary["mean_error_ppm"] = {name: 1e4 * worst_mean_error(errors, name) for name in config.identify.named()}
        metrics["coefficients"] = as_metrics(errors)
        if beside is not None:
            metrics["least_squares"] = as_metrics(beside)
        if deviation is not None:
            metrics["within_95_percent_interval"] = _within(answer, modelled, deviation, names)
    error_table = _error_table(answer, names, modelled, errors, beside, deviation)
    written.append(write_table(work.folder / "coefficient_errors.csv", error_table))
    _print_table(config.name, error_table)
    if modelled is None or config.loss.kind == "response":
        say(f"{config.name}: {left_over.words}")
    written += [
        history_figure(work.figure("training"), work.history, config.loss),
        coefficient_figure(work.figure("stiffness"), "k", answer, modelled, names, deviation),
        coefficient_figure(work.figure("damping"), "c", answer, modelled, names, deviation),
        write_json(work.metrics, metrics),
        write_json(work.folder / "summary.json", summary),
    ]
    return StageOutput(
        flat_metrics(metrics), {"data_fingerprint": inputs.dataset.fingerprint}, [*written, work.identified]
    )


def _within(
    answer: BearingTable, modelled: BearingTable, deviation: np.ndarray, names: Sequence[Sequence[str]]
) -> dict[str, dict[str, float]]:
    """Percent of the speeds at which the modelled coefficient lies in the nominal 95 % interval."""
    result: dict[str, dict[str, float]] = {}
    for b, node in enumerate(answer.nodes):
        for name in names[b]:
            c = COEFFICIENTS.index(name)
            share = within(answer.values[b, :, c] - modelled.values[b, :, c], deviation[b, :, c])
            result.setdefault(str(node), {})[name] = float(share)
    return result


@dataclass(frozen=True, eq=False)
class _LeftOver:
    """What the fit leaves over by its own loss, be there a truth or not."""

    metrics: Mapping[str, object]
    summary: Mapping[str, object]
    conventional: BearingTable | None  # per-speed least squares, where the sensors suffice for it
    words: str


def _of_response(config: Config, inputs: Inputs, identified: IdentifiedModel) -> _LeftOver:
    fit, diagnosis = _fit_account(workspace(config).training), diagnose(config, inputs)
    conventional = diagnosis.answer if diagnosis.by_least_squares else None
    return _LeftOver({"fit": fit}, {}, conventional, _fit_words(fit))


def _of_residual(config: Config, inputs: Inputs, identified: IdentifiedModel) -> _LeftOver:
    conventional, condition = _least_squares(config, inputs, identified)
    impedance = identified.table(inputs.known).impedance(inputs.dataset.frequencies)
    size = np.abs(inputs.equations.free_residual).mean()
    residual = float(np.abs(inputs.equations.residual(impedance)).mean() / size)
    metrics = {
        "residual": {"mean_over_bearing_force": residual},
        "condition_number": {
            str(node): {"median": _finite(np.median(c)), "max": _finite(c.max())}
            for node, c in zip(conventional.nodes, condition, strict=True)
        },
    }
    words = f"no modelled coefficients, so no errors; residual {residual:.3g} of the bearing force"
    return _LeftOver(metrics, {"residual_ppm": 1e6 * residual}, conventional, words)


def _fit_account(path: Path) -> Mapping[str, Any]:
    """What the response fit left over. Raises DataError where the model was trained by another loss."""
    account = read_json(path, "train again with stage=train")
    if "fit" not in account:
        raise DataError(f"'{path}' must be of a training with loss=response, but it is of another: train again")
    return dict(account["fit"])


def _fit_words(fit: Mapping[str, Any]) -> str:
    """What is known of a fit without a truth."""
    square, white = fit["chi_square"], fit["whiteness"]
    lines = [
        f"chi-square {square['value']:.0f} of {square['readings']} readings, {square['expected']:.0f} expected "
        f"({100 * square['value'] / square['expected'] - 100:+.1f} %)",
        f"whiteness: neighbouring speeds correlate by {white['autocorrelation']:.3f} "
        f"({white['over_its_deviation']:+.1f} standard deviations from none); {fit['bad_points']} readings far off",
    ]
    for kind in ("held_out_speeds", "held_out_runs"):
        if kind in fit:
            held = fit[kind]
            lines.append(
                f"{kind.replace('held_out_', 'held-out ')}: predicted to {held['error_percent']:.3g} % (root mean "
                f"square), mean square over the noise {held['mean_square_over_noise']:.3f}, where 1 is expected"
            )
    return "\n".join(lines)


def _least_squares(config: Config, inputs: Inputs, identified: IdentifiedModel) -> tuple[BearingTable, np.ndarray]:
    """Coefficients and condition numbers (B, S) of least squares at each speed by itself."""
    known, unknowns = inputs.known, identified.unknowns
    system = unknown_system(inputs.equations, unknowns, known)
    values, condition = per_speed_least_squares(system.alike() if config.identify.tie_bearings else system)
    return known.with_unknowns(unknowns, values), np.broadcast_to(condition, known.values.shape[:2])


def _error_table(
    answer: BearingTable,
    names: Sequence[Sequence[str]],
    modelled: BearingTable | None,
    errors: CoefficientErrors | None,
    beside: CoefficientErrors | None,
    deviation: np.ndarray | None,
) -> pd.DataFrame:
    """Paper, Table 1: one row a bearing and coefficient, values as means over the speeds, errors in percent.

    Measured data have no modelled coefficients, and so neither these columns nor errors.
    """
    import pandas as pd

    rows = []
    for b, node in enumerate(answer.nodes):
        for name in names[b]:
            if errors is not None and name not in errors[node]:
                continue  # a modelled coefficient of zero has no relative error
            row: dict[str, object] = {"bearing_node": node, "coefficient": name}
            if modelled is not None:
                row["modelled"] = modelled.coefficient(name)[b].mean()
            row["identified"] = answer.coefficient(name)[b].mean()
            if errors is not None:
                row |= asdict(errors[node][name])
            if beside is not None:
                row["least_squares_mean_error_percent"] = beside[node][name].mean_error_percent
            if deviation is not None:
                c = COEFFICIENTS.index(name)
                row["median_std_percent"] = float(100 * np.median(deviation[b, :, c] / np.abs(answer.values[b, :, c])))
            rows.append(row)
    return pd.DataFrame(rows)


def _print_table(name: str, errors: pd.DataFrame) -> None:
    columns = [column for column in _SHOWN if column in errors]
    rows = [
        [f"node {row['bearing_node']} {row['coefficient']}", *(_shown(column, row[column]) for column in columns)]
        for _, row in errors.iterrows()
    ]
    what = "identified against modelled" if "modelled" in errors else "identified"
    table(f"{name}: {what}", ["bearing and coefficient", *(_SHOWN[column] for column in columns)], rows)


_SHOWN = {
    "modelled": "modelled (mean)",
    "identified": "identified (mean)",
    "mean_error_percent": "mean error %",
    "median_error_percent": "median",
    "p95_error_percent": "95 %",
    "max_error_percent": "max",
    "l2_error_percent": "L2",
    "least_squares_mean_error_percent": "least squares mean error %",
    "median_std_percent": "median std %",
}


def _shown(column: str, value: float) -> str:
    return f"{value / 1e5:.5f}e5" if column in ("modelled", "identified") else f"{value:.2g}"
