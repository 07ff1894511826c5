"""The experiment tracker: the one package that imports MLflow.

A stage computes and saves its files first and then hands one :class:`StageRecord` to :func:`track`; a study hands over
its trials on the way (:func:`hand_over`). Nothing
that goes wrong with MLflow reaches the stage; what could not be logged comes back as sentences.
Importing this package imports neither MLflow nor pandas.
"""

from __future__ import annotations

from pipeline.tracking.entries import RUNNING, StageRecord
from pipeline.tracking.tracker import hand_over, recorder_beside, track

__all__ = ["RUNNING", "StageRecord", "hand_over", "recorder_beside", "track"]
