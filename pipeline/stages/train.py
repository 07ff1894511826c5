"""Identify the unknown coefficients (paper, Algorithm 1)."""

from __future__ import annotations

import math
from collections.abc import Mapping
from pathlib import Path

from pipeline.config.promotion import has_value, value_at
from pipeline.config.schema import Config
from pipeline.data.coefficient_files import write_coefficients
from pipeline.data.tables import fingerprint_of, write_table
from pipeline.files import write_json
from pipeline.identification.identified import IdentificationResult
from pipeline.identification.outcome import Outcome
from pipeline.identification.storage import save_model
from pipeline.identification.training import initial_parameters, prepare, run_training, setup_of
from pipeline.reporting.console import say, training_progress, warn
from pipeline.stages.diagnose import say_diagnosis
from pipeline.stages.inputs import Inputs, load_inputs
from pipeline.stages.run import StageOutput, flat_metrics, workspace


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
    import torch

    torch.set_num_threads(config.threads)
    inputs, setup = load_inputs(config), setup_of(config)
    say_promoted(config)
    prepared = prepare(inputs.equations, inputs.known, setup)
    say_diagnosis(config, inputs)
    start = initial_parameters(prepared, setup, config.seed)
    with training_progress(config.name) as progress:
        result = run_training(prepared, start, setup, progress).result()
    files = _save(config, inputs, result)
    _report(config, result)
    return StageOutput(
        metrics=flat_metrics({"training": _account(result) | {"seconds": result.seconds}}),
        tags={"data_fingerprint": inputs.dataset.fingerprint, "outcome": result.outcome.label},
        files=files,
        history=[{key: value for key, value in row.items() if not isinstance(value, str)} for row in result.history],
        model=workspace(config).folder,
        exit_code=130 if result.outcome is Outcome.INTERRUPTED else 0,
    )


def _account(result: IdentificationResult) -> dict[str, object]:
    # A loss that overflowed is no JSON number.
    account: dict[str, object] = {"loss": result.loss if math.isfinite(result.loss) else None, "steps": result.steps}
    if result.held_out_loss is not None:
        account["held_out_loss"] = result.held_out_loss if math.isfinite(result.held_out_loss) else None
    return account


def _save(config: Config, inputs: Inputs, result: IdentificationResult) -> list[Path]:
    import pandas as pd

    work = workspace(config)
    table = result.identified.table(inputs.known)
    account = {
        "outcome": result.outcome.label,
        "data_fingerprint": inputs.dataset.fingerprint,
        "seed": config.seed,
    } | _account(result)
    model = save_model(work.folder, result.identified)
    account["model"] = " ".join(fingerprint_of(path) for path in model)
    return [
        write_coefficients(work.identified, table),
        write_table(work.history, pd.DataFrame(list(result.history)).drop(columns="seconds")),
        write_json(work.training, account),
    ]


def _report(config: Config, result: IdentificationResult) -> None:
    held_out = "" if result.held_out_loss is None else f", on held-out speeds {result.held_out_loss:.3g}"
    say(
        f"{config.name}: {result.outcome.value}\n"
        f"residual {result.loss:.3g} of the bearing force{held_out}, "
        f"{result.steps} steps in {result.seconds:.1f} s\n"
        f"coefficients in '{workspace(config).identified}'"
    )
    if result.outcome in (Outcome.DIVERGED, Outcome.BUDGET_SPENT):
        warn(f"{config.name}: training {result.outcome.label}")
