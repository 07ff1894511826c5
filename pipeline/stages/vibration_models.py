"""What predicts vibration from weights, and the records that it is asked about, from their files."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from pipeline.balance.fitted import Fitted, fit_models
from pipeline.balance.linear_vibration import LinearVibration
from pipeline.balance.physical import Physical, restore_physical
from pipeline.balance.records import average_records, judge_together, shift_to_day
from pipeline.balance.unbalance import Estimates
from pipeline.config.schema import Config
from pipeline.data.conditions import Conditions, gather_conditions
from pipeline.errors import ConfigError, DataError
from pipeline.ingest.records import Records
from pipeline.reporting.console import say, warn
from pipeline.rotor.stored import load_rotor, place_probes
from pipeline.stages.analysis import Analysis
from pipeline.stages.measurement import load_dataset, prepare, restore


def load_models(analysis: Analysis) -> tuple[Fitted, str]:
    """Influence coefficients, and where constant coefficients have been identified, that model and the blend of both;
    with the fingerprint of the records.

    Conditions that contradict their labels are named and left out.
    """
    config, dataset = analysis.config, load_dataset(analysis.config)
    conditions = gather_conditions(dataset, config.machine.recordings.planes or None)
    fitted = fit_models(conditions, _load_physical(analysis, conditions))
    if names := ", ".join(fitted.contradictions):
        say(f"{config.name}: influence coefficients without {names}, which contradict their labels")
    return fitted, dataset.fingerprint


def _load_physical(analysis: Analysis, conditions: Conditions) -> Physical | None:
    """The model that was trained on these conditions; None without one, or where its coefficients are no constants."""
    if analysis.config.model.varies or not analysis.files.training.exists():
        return None
    measurement, answer = prepare(analysis), restore(analysis)
    if answer.uncertainty is None or not measurement.drift:
        return None
    return restore_physical(measurement, answer.model, answer.uncertainty, conditions)


def load_records(config: Config, file: str, key: str) -> Records:
    """The records of ``file``, read as those of the machine. Raises ConfigError where the machine has no such table."""
    recordings = config.machine.recordings
    if not recordings.planes:
        raise ConfigError(
            f"{key} must be a table like that of machine.recordings with format records, but this machine's format is "
            f"{recordings.format}: leave it out"
        )
    return place_probes(load_rotor(config.machine.rotor), recordings).read_records(file)


def list_missing(records: Records) -> Sequence[str]:
    """The probes that no record has a vector of."""
    return [name for p, name in enumerate(records.probes) if np.isnan(records.displacement[:, p]).all()]


def follow_day(name: str, records: Records, model: LinearVibration, reference: str | None) -> LinearVibration:
    """The model on the day of the ``records``, as their condition ``reference`` shows it; without one as it is, with a
    warning where they depart together. Raises DataError as :func:`pipeline.balance.records.shift_to_day`."""
    try:
        conditions = average_records(records, model)
    except DataError:  # what is predicted needs no vectors, nor one set of weights a condition
        if reference:
            raise
        return model
    if reference:
        return shift_to_day(conditions, model, reference)
    if (chance := judge_together(conditions, model, Estimates.RARE)) < Estimates.RARE:
        warn(
            f"{name}: the records depart together from what their weights make (by chance in {chance:.1g} of tables), "
            "as on another day: name a condition of theirs with known weights as reference"
        )
    return model
