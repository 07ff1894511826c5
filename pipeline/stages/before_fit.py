"""What is said before any fit: values of a study in force, what the data determine, and what the model can't follow."""

from __future__ import annotations

from typing import Any

import numpy as np

from pipeline.config.promotion import get_value, has_value
from pipeline.config.schema import Config
from pipeline.data.operating import write_condition
from pipeline.errors import IdentifiabilityError
from pipeline.laws.numbers import OIL_TEMPERATURE
from pipeline.problem.determination import describe_determined, judge_determined
from pipeline.problem.identifiability import Solvability
from pipeline.problem.law_information import (
    describe_open,
    inform,
    require_temperatures,
    summarize_numbers,
    try_warmer,
)
from pipeline.problem.measurement import Measurement
from pipeline.reporting.console import say, table, warn
from pipeline.reporting.fit_tables import list_numbers
from pipeline.stages.analysis import Analysis
from pipeline.stages.measurement import diagnose, expect, prepare
from pipeline.write_numbers import write_number, write_rough, write_value


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
        given = [key for key in promoted.overridden if has_value(config, key)]
        now = ", ".join(f"{key}={write_value(get_value(config, key))}" for key in given) or "none"
        phrases.append(f"given on the command line instead of tuned: {now}")
    say("\n".join(phrases))


def list_idle(kind: str, measurement: Measurement) -> list[str]:
    """The operating conditions that change in the data, and that a model of this kind does not depend on."""
    changing = [name for name, values in measurement.dataset.operating.items() if np.ptp(values) > 0]
    if kind == "law" and measurement.laws:
        return [name for name in changing if name not in measurement.laws.inputs]
    return changing if kind == "constant" else []


def say_beforehand(analysis: Analysis) -> None:
    """All of it for a training, with a warning of conditions without an input, and of too few sensors."""
    config = analysis.config
    say_promoted(config)
    for name in list_idle(config.model.kind, prepare(analysis)):
        warn(
            f"{config.name}: {name} changes in the data, and model={config.model.kind} has no input for it: its answer "
            "is the same at all values (model=network_operating has one)"
        )
    say_diagnosis(analysis)
    if not diagnose(analysis).by_least_squares:
        warn(
            f"{config.name}: the sensors are too few to tell the force at every bearing, so the fit starts at "
            "several sizes of model.initial_stiffness and model.initial_damping, and may end beside the best answer"
        )


def say_diagnosis(analysis: Analysis) -> None:
    """A line a bearing, before a fit."""
    config, diagnosis, expected = analysis.config, diagnose(analysis), expect(analysis)
    judged = judge_determined(expected)
    for report in diagnosis.reports:
        text = report.sentence
        if report.verdict is not Solvability.NOT_IDENTIFIABLE:
            members = [coefficient for coefficient in judged if coefficient.node in report.nodes]
            text += (
                f"; condition number {write_rough(np.median(report.condition))} (worst "
                f"{write_rough(report.condition.max())}); at {config.describe_noise()}, {expected.by}: "
                f"{describe_determined(members)}"
            )
        say(f"{config.name}: {text}")


def diagnose_laws(analysis: Analysis) -> dict[str, Any]:
    """Print what the data tell of each number, and return it for ``diagnosis.json``; nothing of a model without laws.

    Raises DataError for an operating condition that the laws need and the data lack.
    """
    config, measurement = analysis.config, prepare(analysis)
    if not measurement.laws or not config.model.has_laws:
        return {}
    information, warmer = inform(measurement), try_warmer(measurement)
    columns = {"known to, %": 100 * information.prior, "with these data, %": 100 * information.deviation}
    if warmer:
        columns[f"with {write_condition(OIL_TEMPERATURE, warmer[0])} as well, %"] = 100 * warmer[1].deviation
    summary = summarize_numbers(information, warmer and 100 * warmer[1].deviation)
    rows = [
        [
            number["name"],
            f"{write_number(number['guess'])} {number['unit']}".strip(),
            *(write_rough(column[i]) for column in columns.values()),
            "" if number["determined"] else "not told by these data",
        ]
        for i, number in enumerate(list_numbers(summary, config))
    ]
    title = f"numbers of the bearing laws at their guesses, at {config.describe_noise()} (one standard deviation)"
    table(f"{config.name}: {title}", ["number", "guess", *columns, ""], rows)
    for sentence in describe_open(information):
        say(f"{config.name}: {sentence}")
    try:
        require_temperatures(measurement.laws, measurement.dataset.operating)
    except IdentifiabilityError as error:
        warn(f"{config.name}: {error}")
    return {"physical_numbers": summary, "free_combinations": list(information.free)}
