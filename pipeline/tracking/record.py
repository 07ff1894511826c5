"""What a stage hands to the tracker."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import KW_ONLY, dataclass
from pathlib import Path


@dataclass(frozen=True)
class StageRecord:
    """One stage's work, complete and saved; or a piece of it that is a run of its own, such as a trial of a study.

    :param experiment: the name of the MLflow experiment, such as ``hydrostatic_stiffness``
    :param stage: the run's name, such as ``train``
    :param started: start and
    :param ended: end of the stage as ``time.time()`` gives them (s)
    :param parameters: the composed configuration, nested; logged flat, and whole as ``config.yaml``
    :param tags: such as the data's fingerprint, the seed, the outcome, ``pipeline.group``
    :param metrics: final values by name; those that are not finite are not logged
    :param history: rows by training step: a key ``step`` and metrics, which need not be the same in each row;
        texts among them are left out, for MLflow's metrics are numbers
    :param files: images go to the artifact folder ``figures``, other files to ``files``
    :param model: a folder that holds ``model.safetensors`` and ``model.json``, logged as a loadable model
    :param children: logged as runs below this one: parameters, tags, metrics and history of each
    :param status: ``FINISHED``, ``KILLED`` or ``FAILED``
    """

    experiment: str
    stage: str
    started: float
    ended: float
    parameters: Mapping[str, object]
    tags: Mapping[str, str]
    metrics: Mapping[str, float]
    _: KW_ONLY
    history: Sequence[Mapping[str, float | str]] = ()
    files: Sequence[Path] = ()
    model: Path | None = None
    children: Sequence[StageRecord] = ()
    status: str = "FINISHED"
