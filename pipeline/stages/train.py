"""Identify the unknown coefficients (paper, Algorithm 1)."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any

from pipeline.data.coefficient_files import write_coefficients
from pipeline.data.tables import write_table
from pipeline.files import hash_file, write_json
from pipeline.identification.fit import fit
from pipeline.identification.identified import Answer, Fit, answer_of
from pipeline.identification.quality import FAR_FROM_EXPECTED, finite
from pipeline.identification.storage import save_model
from pipeline.identification.training import Outcome, setup_of
from pipeline.identification.uncertainty import save_uncertainty
from pipeline.problem.determination import judge_determined, summarize_determined
from pipeline.reporting.console import say, table, training_progress, warn
from pipeline.reporting.fit_tables import (
    describe_verdicts,
    list_parameters,
    print_laws,
    tabulate_bad_points,
    tabulate_parameters,
    tabulate_unbalance,
)
from pipeline.rotor.bearing_table import BearingTable
from pipeline.stages.analysis import Analysis, use_threads
from pipeline.stages.before_fit import say_beforehand
from pipeline.stages.measurement import diagnose, expect, prepare
from pipeline.tracking import StageRecord
from pipeline.tracking.model import exemplify
from pipeline.trust.misfit import describe_readings, measure_misfit
from pipeline.write_numbers import write_rough


def run(analysis: Analysis) -> StageRecord:
    """Fit, keep the best state, and write model, coefficients, history and quality."""
    config, measurement = analysis.config, prepare(analysis)
    use_threads(config)  # torch is imported when the data have been found sound
    say_beforehand(analysis)
    with training_progress(config.name) as progress:
        fitted = fit(measurement, setup_of(config), progress, diagnose(analysis))
    answer = answer_of(measurement, fitted.model, fitted.uncertainty)
    after = _deviations(analysis, answer)
    # A loss that overflowed is no JSON number.
    held_out = {} if fitted.held_out_loss is None else {"held_out_loss": finite(fitted.held_out_loss)}
    summary: dict[str, Any] = {"loss": finite(fitted.loss), "steps": fitted.steps, **held_out, **fitted.quality.summary}
    summary["determined"] = {"by": after.by, "coefficients": summarize_determined(judge_determined(after))}
    files = _write(analysis, fitted, answer, summary)
    _report(analysis, fitted, summary)
    say(f"{config.name}: {describe_verdicts(summary)}")
    return StageRecord(
        metrics={"training": summary | {"seconds": fitted.seconds}},
        tags=answer.tags | {"outcome": fitted.outcome.label},
        files=files,
        history=[{key: value for key, value in row.items() if not isinstance(value, str)} for row in fitted.history],
        model=analysis.folder,
        example=exemplify(fitted.model) if config.tracking.enabled else (),
        exit_code=130 if fitted.outcome is Outcome.INTERRUPTED else 0,
    )


def _deviations(analysis: Analysis, answer: Answer) -> BearingTable:
    """Posterior ones, of a loss that states them; else those that were expected."""
    stated = analysis.config.describe_noise()
    if answer.stated.deviation is None:
        expected = expect(analysis)
        return replace(expected, by=f"at {stated}, {expected.by}")
    noise = "the noise that was found" if analysis.config.loss.noise == "estimated" else stated
    return replace(answer.stated, by=f"by this fit at {noise}")


def _write(analysis: Analysis, fitted: Fit, answer: Answer, summary: Mapping[str, object]) -> list[Path]:
    """Every file of the fit; tables without a row where the loss says nothing of them. Raises StorageError."""
    model = [*save_model(analysis.folder, fitted.model), save_uncertainty(analysis.folder, fitted.uncertainty)]
    about = {
        "outcome": fitted.outcome.label,
        **answer.tags,
        "seed": analysis.config.seed,
        "model": " ".join(hash_file(path) for path in model),
    }
    return [
        *model,
        write_coefficients(analysis.identified, answer.stated),
        write_table(analysis.folder / "bad_points.csv", tabulate_bad_points(fitted)),
        write_table(analysis.folder / "residual_unbalance.csv", tabulate_unbalance(fitted.uncertainty)),
        write_table(analysis.folder / "model_parameters.csv", tabulate_parameters(fitted.parameters)),
        write_table(analysis.history, [{k: v for k, v in row.items() if k != "seconds"} for row in fitted.history]),
        write_json(analysis.training, about | dict(summary)),
    ]


def _report(analysis: Analysis, fitted: Fit, summary: Mapping[str, Any]) -> None:
    config = analysis.config
    readings = describe_readings(summary)
    far_off = f" ({readings['far_off']}, in 'bad_points.csv')" if fitted.quality.bad_points else ""
    say(
        f"{config.name}: {fitted.outcome.value}\n"
        f"{readings['distance']}{far_off}, {fitted.steps} steps in {fitted.seconds:.1f} s\n"
        + (f"{readings['searched']}\n" if "searched" in readings else "")
        + f"coefficients in '{analysis.identified}'"
    )
    stated = config.identify.model_parameters.deviations
    told = {
        parameter.name: summary["model_parameters"][parameter.name]
        for parameter in fitted.parameters
        if parameter.kind in stated or abs(parameter.value) > 1
    }
    table(*list_parameters(f"{config.name}: model parameters, against what is stated", told))
    if untold := len(fitted.parameters) - len(told):
        say(f"{config.name}: {untold} usual tolerances were fitted and moved less than that, in 'model_parameters.csv'")
    if "physical_numbers" in summary:
        print_laws(config, summary)
    misfit = measure_misfit(summary["fit"]) if "fit" in summary else None
    # NaN compares false.
    if misfit is not None and not misfit.explained() and not misfit.size < FAR_FROM_EXPECTED:
        warn(
            f"{config.name}: the readings lie {write_rough(misfit.distance)} times as far from "
            "the fit as their noise; state the noise as it is (stated_noise.additive, or a probe's floor, is what "
            "stays when nothing vibrates), or check units, conventions, rotor and excitation"
        )
    if fitted.outcome in (Outcome.DIVERGED, Outcome.BUDGET_SPENT):
        warn(f"{config.name}: training {fitted.outcome.label}")
