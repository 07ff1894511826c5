"""The schema of the folds: how methods that predict vibration from weights are tried on conditions unseen."""

from __future__ import annotations

from typing import Annotated

from pydantic import Field

from pipeline.config.quantities import UnbalanceMagnitude
from pipeline.config.section import Section


class FoldsConfig(Section):
    """``calibration`` names the conditions that calibrate alone and are never scored, the one without weights first.

    ``heavy`` is the sum of weights from which on conditions are predicted by lighter ones; null leaves that out. The
    ``false_alarm_rate`` is that of naming a condition where none contradicts its label.
    """

    calibration: tuple[str, ...] = ()
    count: Annotated[int, Field(ge=2)] = 5
    heavy: UnbalanceMagnitude | None = None
    false_alarm_rate: Annotated[float, Field(gt=0, lt=0.5)] = 0.01
