"""Put the results on one screen and in one picture."""

from __future__ import annotations

from pipeline.data.as_built import stand_on_pedestals
from pipeline.files import read_json, write_text
from pipeline.reporting.console import say
from pipeline.reporting.content import FitContent, ReportContent
from pipeline.reporting.summary import write_summary
from pipeline.reporting.summary_figure import draw_summary
from pipeline.rotor.bearing_table import BearingTable
from pipeline.stages.analysis import Analysis
from pipeline.stages.execution import StageOutput
from pipeline.stages.measurement import AGAIN, load_modelled, restore
from pipeline.stages.predict import load_twin
from pipeline.stages.verdict import load_judgement


def run(analysis: Analysis) -> StageOutput:
    """``summary.txt``, which is printed too, and ``figures/summary.png``."""
    config, work, answer = analysis.config, analysis.files, restore(analysis)
    modelled, built = load_modelled(config, answer.measurement), config.machine.as_built
    if modelled is not None and built is not None:  # as the shaft feels them
        modelled = stand_on_pedestals(modelled, built)
    fit = collect_fit(analysis, modelled)
    content = ReportContent(
        config=config, measurement=answer.measurement, fit=fit, files={"verdicts": load_judgement(analysis)}
    )
    picture = draw_summary(work.figure("summary"), content, fit)
    text = write_summary(content, fit, picture)
    written = [write_text(work.folder / "summary.txt", text), picture]
    say(text.rstrip("\n"))
    return StageOutput(tags=answer.tags, files=written)


def collect_fit(analysis: Analysis, modelled: BearingTable | None) -> FitContent:
    """What was identified, training first where it is missing, beside the truth that is ``modelled``."""
    answer = restore(analysis)
    return FitContent(answer, load_twin(analysis), modelled, read_json(analysis.files.training, AGAIN))
