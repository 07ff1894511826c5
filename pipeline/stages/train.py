"""Identify the unknown coefficients (paper, Algorithm 1)."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path

import numpy as np

from pipeline.config.promotion import get_value, has_value
from pipeline.config.schema import Config
from pipeline.data.coefficient_files import write_coefficients
from pipeline.data.tables import write_table
from pipeline.files import hash_file, write_json
from pipeline.identification.fit import fit
from pipeline.identification.identified import Fit
from pipeline.identification.quality import FAR_FROM_EXPECTED, finite
from pipeline.identification.restored import Answer, answer_of
from pipeline.identification.storage import save_model
from pipeline.identification.training import Outcome, setup_of
from pipeline.identification.uncertainty import save_uncertainty
from pipeline.problem.determination import Deviations, summarize_determined
from pipeline.problem.measurement import Measurement
from pipeline.reporting.console import say, training_progress, warn
from pipeline.reporting.fit_tables import (
    describe_law,
    describe_verdicts,
    list_numbers,
    print_numbers,
    print_parameters,
    tabulate_bad_points,
    tabulate_parameters,
    tabulate_unbalance,
)
from pipeline.stages.analysis import Analysis
from pipeline.stages.diagnose import describe_noise, say_diagnosis
from pipeline.stages.execution import StageOutput, use_threads
from pipeline.stages.measurement import diagnose, expect, prepare
from pipeline.trust.misfit import measure_misfit
from pipeline.write_numbers import write_value


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
    if kind == "law" and measurement.laws:
        return [name for name in changing if name not in measurement.laws.inputs]
    return changing if kind == "constant" else []


def run(analysis: Analysis) -> StageOutput:
    """Fit, keep the best state, and write model, coefficients, history and quality."""
    config, measurement = analysis.config, prepare(analysis)
    use_threads(config)  # torch is imported when the data have been found sound
    say_promoted(config)
    for name in list_idle(config.model.kind, measurement):
        warn(
            f"{config.name}: {name} changes in the data, and model={config.model.kind} has no input for it: its answer "
            "is the same at all values (model=network_operating has one)"
        )
    say_diagnosis(analysis)
    diagnosis = diagnose(analysis)
    if not diagnosis.by_least_squares:
        warn(
            f"{config.name}: the sensors are too few to tell the force at every bearing, so the fit starts at "
            "several sizes of model.initial_stiffness and model.initial_damping, and may end beside the best answer"
        )
    with training_progress(config.name) as progress:
        fitted = fit(measurement, setup_of(config), progress, diagnosis)
    answer = answer_of(measurement, fitted.model, fitted.uncertainty)
    after = _deviations(analysis, answer)
    determined = {"by": after.of, "coefficients": summarize_determined(after.judge())}
    summary = _summarize(fitted) | {"determined": determined}
    files = _write(analysis, fitted, answer, summary)
    _report(analysis, fitted)
    say(f"{config.name}: {describe_verdicts(summary)}")
    return StageOutput(
        metrics={"training": summary | {"seconds": fitted.seconds}},
        tags=answer.tags | {"outcome": fitted.outcome.label},
        files=files,
        history=[{key: value for key, value in row.items() if not isinstance(value, str)} for row in fitted.history],
        model=analysis.files.folder,
        exit_code=130 if fitted.outcome is Outcome.INTERRUPTED else 0,
    )


def _deviations(analysis: Analysis, answer: Answer) -> Deviations:
    """Posterior ones, of a loss that states them; else those that were expected."""
    values, stated = answer.deviation(answer.table), describe_noise(analysis.config)
    if values is None:
        expected = expect(analysis)
        return replace(expected, of=f"at {stated}, {expected.of}")
    noise = "the noise that was found" if analysis.config.loss.noise == "estimated" else stated
    return Deviations(answer.table, values, f"by this fit at {noise}")


def _summarize(fitted: Fit) -> dict[str, object]:
    # A loss that overflowed is no JSON number.
    summary: dict[str, object] = {"loss": finite(fitted.loss), "steps": fitted.steps}
    if fitted.held_out_loss is not None:
        summary["held_out_loss"] = finite(fitted.held_out_loss)
    return summary | dict(fitted.quality.summary)


def _write(analysis: Analysis, fitted: Fit, answer: Answer, summary: Mapping[str, object]) -> list[Path]:
    """Every file of the fit; tables without a row where the loss says nothing of them. Raises StorageError."""
    work = analysis.files
    model = [*save_model(work.folder, fitted.model), save_uncertainty(work.folder, fitted.uncertainty)]
    about = {
        "outcome": fitted.outcome.label,
        **answer.tags,
        "seed": analysis.config.seed,
        "model": " ".join(hash_file(path) for path in model),
    }
    return [
        *model,
        write_coefficients(work.identified, answer.table, deviation=answer.deviation(answer.table)),
        write_table(work.folder / "bad_points.csv", tabulate_bad_points(fitted)),
        write_table(work.folder / "residual_unbalance.csv", tabulate_unbalance(fitted.uncertainty)),
        write_table(work.folder / "model_parameters.csv", tabulate_parameters(fitted.parameters)),
        write_table(work.history, [{k: v for k, v in row.items() if k != "seconds"} for row in fitted.history]),
        write_json(work.training, about | dict(summary)),
    ]


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


def _report(analysis: Analysis, fitted: Fit) -> None:
    config = analysis.config
    say(
        f"{config.name}: {fitted.outcome.value}\n"
        f"{_describe_misfit(fitted)}, "
        f"{fitted.steps} steps in {fitted.seconds:.1f} s\n"
        f"coefficients in '{analysis.files.identified}'"
    )
    stated = config.identify.model_parameters.deviations
    told = [number for number in fitted.parameters if number.parameter.kind in stated or abs(number.value) > 1]
    if told:
        print_parameters(config.name, told)
    if untold := len(fitted.parameters) - len(told):
        say(f"{config.name}: {untold} usual tolerances were fitted and moved less than that, in 'model_parameters.csv'")
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
