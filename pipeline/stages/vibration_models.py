"""What predicts vibration from weights, by the name of the method, and the records that it is asked about."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from pipeline.balance.blend import blend_with_influence
from pipeline.balance.consistency import find_contradictions
from pipeline.balance.influence import Influence, fit_influence
from pipeline.balance.linear_vibration import LinearVibration
from pipeline.balance.physical import Physical, restore_physical
from pipeline.config.schema import Config
from pipeline.data.conditions import Conditions, gather_conditions
from pipeline.errors import ConfigError, IdentifiabilityError, nearest
from pipeline.ingest.records import Records
from pipeline.reporting.console import say
from pipeline.stages.analysis import Analysis
from pipeline.stages.measurement import load_dataset, prepare, restore
from pipeline.stages.workspace import locate_files


def list_planes(config: Config) -> tuple[int, ...] | None:
    """The nodes of the planes that the recordings have weights in; None where they do not say."""
    return config.machine.recordings.planes or None


@dataclass(frozen=True, eq=False)
class Fitted:
    """The experiment's conditions, those among them that do not contradict their labels, and what was fitted to these,
    by method; the preferred one is the first."""

    conditions: Conditions
    sound: Conditions
    models: Mapping[str, LinearVibration]
    fingerprint: str  # of the records' data set

    def can_leave_out(self, method: str) -> bool:
        """Whether the method is fitted anew without each condition: quickly done, and of enough conditions."""
        return method == "influence" and len(self.sound.names) > len(self.sound.planes) + 3

    def leave_each_out(self, method: str) -> list[LinearVibration]:
        """The model of a method for each of the experiment's conditions: influence coefficients that it is no part of.

        With too few conditions to leave one out, and for other methods, it is the one that there is.
        """
        left_out = self.sound.names if self.can_leave_out(method) else ()
        return [
            fit_influence(self.sound.without([name])) if name in left_out else self.models[method]
            for name in self.conditions.names
        ]

    def pick(self, wanted: str | None, key: str) -> str:
        """The method that is asked for at ``key``, or the first. Raises ConfigError for one that there is not."""
        method = wanted or next(iter(self.models))
        if method not in self.models:
            raise ConfigError(f"{key} must be a method with a fit, but got '{method}': {nearest(method, self.models)}")
        return method


def load_models(config: Config) -> Fitted:
    """Influence coefficients, and where constant coefficients have been identified, that model and the blend of both.

    Conditions that contradict their labels are named and left out.
    """
    dataset = load_dataset(config)
    conditions = gather_conditions(dataset, list_planes(config))
    sound, influence = _leave_out(config, conditions)
    models: dict[str, LinearVibration] = {"influence": influence}
    if physical := _load_physical(config, conditions):
        models |= {"physical": physical, "blend": blend_with_influence(physical, sound)}
    return Fitted(conditions, sound, models, dataset.fingerprint)


def _leave_out(config: Config, conditions: Conditions) -> tuple[Conditions, Influence]:
    """The conditions that do not contradict their labels, and their influence coefficients."""
    try:
        contradictions, influence = find_contradictions(conditions)
    except IdentifiabilityError:  # too few conditions to judge one by the others
        return conditions, fit_influence(conditions)
    if contradictions:
        names = ", ".join(contradictions)
        say(f"{config.name}: influence coefficients without {names}, which contradict their labels")
    return conditions.without(contradictions), influence


def _load_physical(config: Config, conditions: Conditions) -> Physical | None:
    """The model that was trained on these conditions; None without one, or where its coefficients are no constants."""
    work = locate_files(config)
    if config.model.kind != "constant" or not work.training.exists():
        return None
    analysis = Analysis(config)
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
    return recordings.read_records(file)


def list_missing(records: Records) -> Sequence[str]:
    """The probes that no record has a vector of."""
    return [name for p, name in enumerate(records.probes) if np.isnan(records.displacement[:, p]).all()]
