"""The experiment tracker: the one package that imports MLflow.

A stage computes and saves its files first and then hands one :class:`StageRecord` to :func:`track`. Nothing
that goes wrong with MLflow reaches the stage; what could not be logged comes back as sentences.
Importing this package imports neither MLflow nor pandas.
"""

from __future__ import annotations

from pipeline.tracking.entries import StageRecord
from pipeline.tracking.store import find_trial_pages
from pipeline.tracking.tracker import recorder_beside, track

__all__ = ["StageRecord", "find_trial_pages", "recorder_beside", "track"]
