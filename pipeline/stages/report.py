"""Write the report that an engineer sends on: one HTML page, and the same as a PDF."""

from __future__ import annotations

import time
from pathlib import Path

from pipeline.config.schema import Config
from pipeline.errors import DataError, IdentifiabilityError
from pipeline.files import read_json
from pipeline.ingest.full_spectrum import FullSpectra, measure_full_spectra
from pipeline.reporting.console import say, warn
from pipeline.reporting.content import ReportContent, describe_origin, read_reference
from pipeline.reporting.report.files import write_page, write_pdf
from pipeline.reporting.report.sections import list_sections
from pipeline.stages.analysis import Analysis
from pipeline.stages.measurement import load_modelled, prepare, restore
from pipeline.stages.summary import attempt, collect_fit
from pipeline.stages.verdict import load_judgement
from pipeline.tracking import StageRecord
from pipeline.tracking.entries import describe_provenance

_MOST_SPECTRA = 2
"""Runs, and nodes of each, whose spectra are drawn."""


def run(analysis: Analysis) -> StageRecord:
    """``report.html`` and ``report.pdf``."""
    config, content = analysis.config, collect_content(analysis)
    sections = list_sections(content)
    title = f"Bearing identification: {config.name.replace('_', ' ')}"
    made = time.strftime("%Y-%m-%d %H:%M UTC", time.gmtime())
    head = config.machine.report.model_dump(exclude={"paper"}) | {"subject": config.description, "made": made}
    written = [
        write(analysis.folder / f"report.{kind}", title, head, sections, config.machine.report.paper)
        for kind, write in (("html", write_page), ("pdf", write_pdf))
    ]
    without = "".join(f"\n  without {part}: {reason}" for part, reason in content.missing.items())
    say(f"{config.name}: report in '{written[0]}' and '{written[1]}'{without}")
    return StageRecord(tags={"data_fingerprint": content.dataset.fingerprint}, files=written)


def collect_content(analysis: Analysis) -> ReportContent:
    """Read what the sections speak of; stages whose files are missing or older than the fit run first.

    Raises DataError for a reference table that breaks its laws.
    """
    config, measurement = analysis.config, prepare(analysis)
    reference = {} if config.report.reference is None else read_reference(Path(config.report.reference))
    missing: dict[str, str] = {}
    # Training first where it is missing.
    fit = attempt(
        lambda this: collect_fit(this, load_modelled(config, restore(this).measurement), missing),
        analysis,
        "fit",
        missing,
        (IdentifiabilityError,),
    )
    if fit is None:
        warn(f"{missing['fit']}\n{config.name}: the report has what was measured and the diagnosis alone")
    analysis.require("diagnose", analysis.folder / "diagnosis.json", behind=analysis.vibration)
    names, judged = ["ingest", "diagnosis"], None
    if fit is not None:
        attempt(lambda this: this.require("evaluate", this.metrics, behind=this.training), analysis, "errors", missing)
        names = [*names, *(() if "errors" in missing else ("metrics",))]
        judged = attempt(load_judgement, analysis, "verdicts", missing)
    contents = {name: analysis.folder / f"{name}.json" for name in names}
    return ReportContent(
        config=config,
        measurement=measurement,
        fit=fit,
        spectra=_read_spectra(config),
        files={name: read_json(path) for name, path in contents.items() if path.exists()}
        | ({"verdicts": judged} if judged else {}),
        reference=reference,
        origin=describe_origin(
            config,
            measurement,
            (analysis.vibration, analysis.excitation, analysis.folder / "model.safetensors"),
            describe_provenance(),
        ),
        missing=missing,
    )


def _read_spectra(config: Config) -> dict[str, FullSpectra]:
    """Spectra of the first runs, where there are time signals at hand; a warning where their files are gone."""
    recordings, by_title = config.machine.recordings, {}
    if config.data.vibration is not None:
        return {}
    nodes = sorted({probe.node for probe in recordings.probes.values()})[:_MOST_SPECTRA]
    for measured in recordings.runs[:_MOST_SPECTRA]:
        try:
            records = recordings.read_signals(measured)
        except DataError as error:
            warn(f"the report has no spectra of run '{measured.name}': {error}")
            continue
        for node in nodes:
            spectra = measure_full_spectra(records, recordings.probes, node)
            if spectra is not None:
                by_title[f"{measured.name}, node {node}"] = spectra
    return by_title
