"""Identify the unknown coefficients (paper, Algorithm 1)."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from pipeline.config.promotion import has_value, value_at
from pipeline.config.schema import Config
from pipeline.data.coefficient_files import write_coefficients
from pipeline.data.tables import fingerprint_of, write_table
from pipeline.equations.identifiability import require_identifiable
from pipeline.files import write_json
from pipeline.identification.identified import IdentificationResult
from pipeline.identification.outcome import Outcome
from pipeline.identification.response_fit import ResponseFit
from pipeline.identification.storage import save_model
from pipeline.identification.training import TrainingSetup, initial_parameters, prepare, run_training, setup_of
from pipeline.identification.uncertainty import Uncertainty, save_uncertainty, uncertainty_of
from pipeline.reporting.console import say, training_progress, warn
from pipeline.stages.diagnosis import say_diagnosis
from pipeline.stages.inputs import Inputs, load_inputs
from pipeline.stages.response import account_of, fitted, prepared_response, write_account
from pipeline.stages.run import StageOutput, flat_metrics, use_threads, workspace


def say_promoted(config: Config) -> None:
    """Which values of a study are in force, and which the command line overrode."""
    promoted = config.promoted
    if promoted is None:
        return
    source = f"study '{promoted.study}' (trial {promoted.trial})"
    if not promoted.in_force and not promoted.overridden:
        say(f"{config.name}: configured values, which {source} found no better ones for")
        return
    words = [f"{config.name}: tuned values of {source} in force: {_listed(promoted.in_force)}"]
    if promoted.overridden:
        now = {key: value_at(config, key) for key in promoted.overridden if has_value(config, key)}
        words.append(f"given on the command line instead of tuned: {_listed(now)}")
    say("\n".join(words))


def _listed(values: Mapping[str, object]) -> str:
    shown = (f"{key}={value:.4g}" if isinstance(value, float) else f"{key}={value}" for key, value in values.items())
    return ", ".join(shown) or "none"


def run(config: Config) -> StageOutput:
    """Train, keep the best state, and write model, coefficients, history and account."""
    inputs, setup = load_inputs(config), setup_of(config)
    use_threads(config)  # torch is imported when the data have been found sound
    say_promoted(config)
    if config.loss.kind == "response":
        result, fit = _by_response(config, inputs, setup)
        left_over = account_of(fit, inputs.dataset)
        account = _account(result) | {"fit": left_over.summary}
        uncertainty = uncertainty_of(fit, left_over.inflation if config.loss.noise == "estimated" else 1.0)
        files = write_account(workspace(config).folder, left_over, uncertainty)
    else:
        result = _by_residual(config, inputs, setup)
        account, uncertainty = _account(result), None
        files = write_account(workspace(config).folder, None, None)
    files += _save(config, inputs, result, account, uncertainty)
    _report(config, result, account)
    return StageOutput(
        metrics=flat_metrics({"training": account | {"seconds": result.seconds}}),
        tags={"data_fingerprint": inputs.dataset.fingerprint, "outcome": result.outcome.label},
        files=files,
        history=[{key: value for key, value in row.items() if not isinstance(value, str)} for row in result.history],
        model=workspace(config).folder,
        exit_code=130 if result.outcome is Outcome.INTERRUPTED else 0,
    )


def _by_residual(config: Config, inputs: Inputs, setup: TrainingSetup) -> IdentificationResult:
    prepared = prepare(inputs.equations, inputs.known, setup)
    say_diagnosis(config, inputs)
    start = initial_parameters(prepared, setup, config.seed)
    with training_progress(config.name) as progress:
        return run_training(prepared, start, setup, progress).result()


def _by_response(config: Config, inputs: Inputs, setup: TrainingSetup) -> tuple[IdentificationResult, ResponseFit]:
    diagnosis = say_diagnosis(config, inputs)
    if not config.force:
        require_identifiable(diagnosis.accounts)
    prepared = prepared_response(config, inputs, setup)
    if prepared.from_guess:
        warn(
            f"{config.name}: the sensors are too few to tell the force at every bearing, so the fit starts at "
            "several sizes of model.initial_stiffness and model.initial_damping, and may end beside the best answer"
        )
    with training_progress(config.name) as progress:
        fit = fitted(config, prepared, setup, progress)
    loss = float(fit.problem.loss(fit.free))
    result = IdentificationResult(fit.batch.identified(), fit.outcome, loss, None, fit.steps, fit.seconds, fit.history)
    return result, fit


def _account(result: IdentificationResult) -> dict[str, object]:
    # A loss that overflowed is no JSON number.
    account: dict[str, object] = {"loss": result.loss if math.isfinite(result.loss) else None, "steps": result.steps}
    if result.held_out_loss is not None:
        account["held_out_loss"] = result.held_out_loss if math.isfinite(result.held_out_loss) else None
    return account


def _save(
    config: Config,
    inputs: Inputs,
    result: IdentificationResult,
    account: Mapping[str, object],
    uncertainty: Uncertainty | None,
) -> list[Path]:
    work = workspace(config)
    table = result.identified.table(inputs.known)
    model = [*save_model(work.folder, result.identified), save_uncertainty(work.folder, uncertainty)]
    deviation = None if uncertainty is None else uncertainty.deviation(result.identified, inputs.dataset.speeds)
    about = {
        "outcome": result.outcome.label,
        "data_fingerprint": inputs.dataset.fingerprint,
        "seed": config.seed,
        "model": " ".join(fingerprint_of(path) for path in model),
    }
    return [
        write_coefficients(work.identified, table, deviation=deviation),
        write_table(work.history, _columns(result.history)),
        write_json(work.training, about | dict(account)),
    ]


def _columns(history: Sequence[Mapping[str, float | str]]) -> dict[str, list[float | str]]:
    """The history without its clock."""
    return {name: [row[name] for row in history] for name in history[0] if name != "seconds"}


def _left_over(result: IdentificationResult, account: Mapping[str, Any]) -> str:
    """The loss in words."""
    if "fit" not in account:
        held_out = "" if result.held_out_loss is None else f", on held-out speeds {result.held_out_loss:.3g}"
        return f"residual {result.loss:.3g} of the bearing force{held_out}"
    square, bad = account["fit"]["chi_square"], account["fit"]["bad_points"]
    left = (
        f"chi-square {square['value']:.0f}, where {square['expected']:.0f} is expected of {square['readings']} readings"
    )
    return left + (f" ({bad} of them far off, in 'bad_points.csv')" if bad else "")


def _report(config: Config, result: IdentificationResult, account: Mapping[str, Any]) -> None:
    say(
        f"{config.name}: {result.outcome.value}\n"
        f"{_left_over(result, account)}, "
        f"{result.steps} steps in {result.seconds:.1f} s\n"
        f"coefficients in '{workspace(config).identified}'"
    )
    square = account["fit"]["chi_square"] if "fit" in account else None
    # NaN compares false.
    if square is not None and not square["value"] < _FAR_FROM_EXPECTED * square["expected"]:
        warn(
            f"{config.name}: the readings lie {math.sqrt(square['value'] / square['expected']):.2g} times as far from "
            "the fit as their noise; state the noise as it is (stated_noise.additive is its floor), or check units, "
            "conventions, rotor and excitation"
        )
    if result.outcome in (Outcome.DIVERGED, Outcome.BUDGET_SPENT):
        warn(f"{config.name}: training {result.outcome.label}")


_FAR_FROM_EXPECTED = 3.0
