"""Identify the unknown coefficients (paper, Algorithm 1)."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from pipeline.config.promotion import get_value, has_value
from pipeline.config.schema import Config
from pipeline.data.coefficient_files import write_coefficients
from pipeline.data.operating_points import list_columns
from pipeline.data.tables import write_table
from pipeline.data.vibration_files import to_rpm
from pipeline.files import hash_file, write_json
from pipeline.identification.fit import fit
from pipeline.identification.identified import Fit
from pipeline.identification.outcome import Outcome
from pipeline.identification.quality import FAR_FROM_EXPECTED, finite
from pipeline.identification.storage import save_model
from pipeline.identification.training import setup_of
from pipeline.identification.uncertainty import Uncertainty, save_uncertainty
from pipeline.problem.determination import Deviations, summarize_determined
from pipeline.problem.measurement import Measurement
from pipeline.reporting.console import say, training_progress, warn
from pipeline.reporting.error_table import describe_verdicts
from pipeline.reporting.model_error import print_parameters
from pipeline.reporting.physical_numbers import describe_law, list_numbers, print_numbers
from pipeline.reporting.write_numbers import write_value
from pipeline.rotor.parameters import UNITS
from pipeline.stages.diagnose import describe_noise, say_diagnosis
from pipeline.stages.execution import StageOutput, use_threads
from pipeline.stages.measurement import load_measurement, update_measurement
from pipeline.stages.workspace import locate_files
from pipeline.trust.misfit import measure_misfit


def say_promoted(config: Config) -> None:
    """Say which values of a study are in force, and which the command line overrode."""
    promoted = config.promoted
    if promoted is None:
        return
    source = f"study '{promoted.study}' (trial {promoted.trial})"
    if not promoted.in_force and not promoted.overridden:
        say(f"{config.name}: configured values, which {source} found no better ones for")
        return
    changed = {key: value for key, value in promoted.in_force.items() if promoted.configured.get(key) != value}
    before = {key: write_value(promoted.configured.get(key, "-")) for key in changed}
    pairs = (f"{key} {before[key]} -> {write_value(value)}" for key, value in changed.items())
    losses = promoted.held_out_loss
    phrases = [
        f"{config.name}: tuned values of {source} in force: {', '.join(pairs) or 'none'}",
        f"on held-out speeds their loss is {write_value(losses.promoted)}, that of the configured values (tuned=false) "
        f"{write_value(losses.configured)}: medians over the seeds of the study",
    ]
    if promoted.overridden:
        now = {key: get_value(config, key) for key in promoted.overridden if has_value(config, key)}
        phrases.append(f"given on the command line instead of tuned: {_format_values(now)}")
    say("\n".join(phrases))


def _format_values(values: Mapping[str, object]) -> str:
    return ", ".join(f"{key}={write_value(value)}" for key, value in values.items()) or "none"


def list_idle(kind: str, measurement: Measurement) -> list[str]:
    """The operating conditions that change in the data, and that a model of this kind does not depend on."""
    changing = [name for name, values in measurement.dataset.operating.items() if np.ptp(values) > 0]
    if kind == "law" and measurement.laws is not None:
        return [name for name in changing if name not in measurement.laws.inputs]
    return changing if kind == "constant" else []


def run(config: Config) -> StageOutput:
    """Fit, keep the best state, and write model, coefficients, history and quality."""
    measurement = load_measurement(config)
    use_threads(config)  # torch is imported when the data have been found sound
    say_promoted(config)
    for name in list_idle(config.model.kind, measurement):
        warn(
            f"{config.name}: {name} changes in the data, and model={config.model.kind} has no input for it: its answer "
            "is the same at all values (model=network_operating has one)"
        )
    diagnosis, expected = say_diagnosis(config, measurement)
    if not diagnosis.by_least_squares:
        warn(
            f"{config.name}: the sensors are too few to tell the force at every bearing, so the fit starts at "
            "several sizes of model.initial_stiffness and model.initial_damping, and may end beside the best answer"
        )
    with training_progress(config.name) as progress:
        fitted = fit(measurement, setup_of(config), progress, diagnosis)
    after = _deviations(config, measurement, fitted) or replace(
        expected, of=f"at {describe_noise(config)}, {expected.of}"
    )
    determined = {"by": after.of, "coefficients": summarize_determined(after.judge())}
    summary = _summarize(fitted) | {"determined": determined}
    files = _write(config, measurement, fitted, summary)
    _report(config, fitted)
    say(f"{config.name}: {describe_verdicts(summary)}")
    return StageOutput(
        metrics={"training": summary | {"seconds": fitted.seconds}},
        tags={"data_fingerprint": measurement.dataset.fingerprint, "outcome": fitted.outcome.label},
        files=files,
        history=[{key: value for key, value in row.items() if not isinstance(value, str)} for row in fitted.history],
        model=locate_files(config).folder,
        exit_code=130 if fitted.outcome is Outcome.INTERRUPTED else 0,
    )


def _deviations(config: Config, measurement: Measurement, fitted: Fit) -> Deviations | None:
    """Posterior ones, of a loss that states them."""
    data = measurement.dataset
    values = fitted.deviation(data.speeds, data.operating)
    if values is None:
        return None
    noise = "the noise that was found" if config.loss.noise == "estimated" else describe_noise(config)
    updated = update_measurement(measurement, fitted.uncertainty)
    return Deviations(fitted.table(updated.updated_known), values, f"by this fit at {noise}")


def _summarize(fitted: Fit) -> dict[str, object]:
    # A loss that overflowed is no JSON number.
    summary: dict[str, object] = {"loss": finite(fitted.loss), "steps": fitted.steps}
    if fitted.held_out_loss is not None:
        summary["held_out_loss"] = finite(fitted.held_out_loss)
    return summary | dict(fitted.quality.summary)


def _write(config: Config, measurement: Measurement, fitted: Fit, summary: Mapping[str, object]) -> list[Path]:
    """Every file of the fit; tables without a row where the loss says nothing of them. Raises StorageError."""
    work, data = locate_files(config), measurement.dataset
    model = [*save_model(work.folder, fitted.model), save_uncertainty(work.folder, fitted.uncertainty)]
    about = {
        "outcome": fitted.outcome.label,
        "data_fingerprint": measurement.dataset.fingerprint,
        "seed": config.seed,
        "model": " ".join(hash_file(path) for path in model),
    }
    updated = update_measurement(measurement, fitted.uncertainty)
    table, deviation = fitted.table(updated.updated_known), fitted.deviation(data.speeds, data.operating)
    return [
        *model,
        write_coefficients(work.identified, table, deviation=deviation),
        write_table(work.folder / "bad_points.csv", _tabulate_bad_points(fitted)),
        write_table(work.folder / "residual_unbalance.csv", _tabulate_unbalance(fitted.uncertainty)),
        write_table(work.folder / "model_parameters.csv", _tabulate_parameters(fitted)),
        write_table(work.history, [{k: v for k, v in row.items() if k != "seconds"} for row in fitted.history]),
        write_json(work.training, about | dict(summary)),
    ]


def _tabulate_bad_points(fitted: Fit) -> dict[str, list[Any]]:
    """Readings, and how many deviations they are off."""
    every = fitted.quality.bad_points
    columns: dict[str, list[Any]] = {
        "run": [point.run for point in every],
        "speed_rpm": to_rpm(np.array([point.speed for point in every])).tolist(),
    }
    conditions = {
        name: np.array([point.operating[name] for point in every]) for name in (every[0].operating if every else ())
    }
    columns |= {name: values.tolist() for name, values in list_columns(conditions).items()}
    return columns | {name: [getattr(point, name) for point in every] for name in ("node", "direction", "deviations")}


def _tabulate_unbalance(uncertainty: Uncertainty | None) -> dict[str, Any]:
    """kg m and degrees."""
    unbalance = np.zeros(0, dtype=complex) if uncertainty is None else uncertainty.residual_unbalance
    return {
        "node": [] if uncertainty is None else uncertainty.planes,
        "magnitude": np.abs(unbalance),
        "phase_deg": np.degrees(np.angle(unbalance)),
        "magnitude_std": [] if uncertainty is None else uncertainty.unbalance_deviation(),
    }


def _tabulate_parameters(fitted: Fit) -> dict[str, list[Any]]:
    """Prior deviation, and what the fit made of it: a share of the stated value, or in the unit."""
    every = fitted.parameters
    return {
        "kind": [number.parameter.kind for number in every],
        "of": [number.parameter.label for number in every],
        "unit": [UNITS[number.parameter.kind] for number in every],
        "prior_std": [number.parameter.deviation for number in every],
        "value": [number.value * number.parameter.deviation for number in every],
        "std": [number.deviation * number.parameter.deviation for number in every],
    }


def _describe_misfit(fitted: Fit) -> str:
    """The loss in words."""
    if fitted.quality.misfit is None:
        held_out = "" if fitted.held_out_loss is None else f", on held-out speeds {fitted.held_out_loss:.3g}"
        return f"residual {fitted.loss:.3g} of the bearing force{held_out}"
    square, bad = fitted.quality.summary["fit"]["chi_square"], len(fitted.quality.bad_points)
    left = (
        f"chi-square {square['value']:.0f}, where {square['expected']:.0f} is expected of {square['readings']} readings"
    )
    return left + (f" ({bad} of them far off, in 'bad_points.csv')" if bad else "")


def _report(config: Config, fitted: Fit) -> None:
    say(
        f"{config.name}: {fitted.outcome.value}\n"
        f"{_describe_misfit(fitted)}, "
        f"{fitted.steps} steps in {fitted.seconds:.1f} s\n"
        f"coefficients in '{locate_files(config).identified}'"
    )
    if fitted.parameters:
        print_parameters(config.name, fitted.parameters)
    summary = fitted.quality.summary
    print_numbers(config.name, list_numbers(summary.get("physical_numbers", {}), config))
    for text in describe_law(summary, config.model.kind):
        say(f"{config.name}: {text}")
    misfit = measure_misfit(summary["fit"]) if "fit" in summary else None
    # NaN compares false.
    if misfit is not None and not misfit.explained() and not misfit.size < FAR_FROM_EXPECTED:
        warn(
            f"{config.name}: the readings lie {misfit.distance:.2g} times as far from "
            "the fit as their noise; state the noise as it is (stated_noise.additive is its floor), or check units, "
            "conventions, rotor and excitation"
        )
    if fitted.outcome in (Outcome.DIVERGED, Outcome.BUDGET_SPENT):
        warn(f"{config.name}: training {fitted.outcome.label}")
