"""Put the results on one screen and in one picture."""

from __future__ import annotations

from collections.abc import Callable
from typing import TypeVar

from pipeline.errors import ConfigError, DataError, PipelineError
from pipeline.files import read_json, write_text
from pipeline.parameters.as_built import stand_on_pedestals
from pipeline.reporting.console import say
from pipeline.reporting.content import FitContent, ReportContent
from pipeline.reporting.summary import draw_summary, write_summary
from pipeline.rotor.bearing_table import BearingTable
from pipeline.stages.analysis import Analysis
from pipeline.stages.measurement import AGAIN, load_modelled, restore
from pipeline.stages.predict import load_twin
from pipeline.stages.verdict import load_judgement
from pipeline.tracking import StageRecord

_T = TypeVar("_T")


def run(analysis: Analysis) -> StageRecord:
    """``summary.txt``, which is printed too, and ``figures/summary.png``."""
    config, answer = analysis.config, restore(analysis)
    modelled, built = load_modelled(config, answer.measurement), config.machine.as_built
    if modelled is not None and built is not None:  # as the shaft feels them
        modelled = stand_on_pedestals(modelled, built)
    missing: dict[str, str] = {}
    fit = collect_fit(analysis, modelled, missing)
    verdicts = attempt(load_judgement, analysis, "verdicts", missing)
    content = ReportContent(
        config=config,
        measurement=answer.measurement,
        fit=fit,
        files={"verdicts": verdicts} if verdicts else {},
        missing=missing,
    )
    picture = draw_summary(analysis.figure("summary"), content, fit)
    text = write_summary(content, fit, picture)
    written = [write_text(analysis.folder / "summary.txt", text), picture]
    say(text.rstrip("\n"))
    return StageRecord(tags=answer.tags, files=written)


def collect_fit(analysis: Analysis, modelled: BearingTable | None, missing: dict[str, str]) -> FitContent:
    """What was identified, training first where it is missing, beside the truth that is ``modelled``; without a twin
    where ``missing`` has the reason."""
    answer, twin = restore(analysis), attempt(load_twin, analysis, "twin", missing)
    return FitContent(answer, twin, modelled, read_json(analysis.training, AGAIN))


def attempt(
    make: Callable[[Analysis], _T],
    analysis: Analysis,
    part: str,
    missing: dict[str, str],
    kinds: tuple[type[PipelineError], ...] = (ConfigError, DataError),
) -> _T | None:
    """What ``make`` makes; None where it ends in an error of these ``kinds``: its reason is in ``missing`` then, and
    the rest goes on without."""
    try:
        return make(analysis)
    except kinds as error:
        missing[part] = str(error)
        return None
