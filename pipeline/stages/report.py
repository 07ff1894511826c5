"""Write the report that an engineer sends on: one HTML page, and the same as a PDF."""

from __future__ import annotations

import time
from pathlib import Path

import numpy as np

from pipeline.config.schema import Config
from pipeline.errors import DataError, IdentifiabilityError
from pipeline.files import read_json
from pipeline.ingest.full_spectrum import FullSpectra, measure_full_spectra
from pipeline.reporting.coefficient_figures import Coefficients
from pipeline.reporting.console import say, warn
from pipeline.reporting.report.content import FitContent, ReportContent, describe_origin, read_reference, read_tables
from pipeline.reporting.report.files import write_page, write_pdf
from pipeline.reporting.report.sections import list_sections
from pipeline.stages.analysis import Analysis
from pipeline.stages.execution import StageOutput
from pipeline.stages.measurement import load_modelled, prepare, restore
from pipeline.stages.predict import load_twin
from pipeline.stages.verdict import load_judgement
from pipeline.tracking.entries import describe_provenance
from pipeline.twin.at_conditions import say_beyond

_MOST_SPECTRA = 2
"""Runs, and nodes of each, whose spectra are drawn."""


def run(analysis: Analysis) -> StageOutput:
    """``report.html`` and ``report.pdf``."""
    config, work, content = analysis.config, analysis.files, collect_content(analysis)
    sections = list_sections(content)
    title = f"Bearing identification: {config.name.replace('_', ' ')}"
    made = time.strftime("%Y-%m-%d %H:%M UTC", time.gmtime())
    head = [config.description, f"Made {made}."]
    written = [
        write_page(work.folder / "report.html", title, head, sections),
        write_pdf(work.folder / "report.pdf", title, head, sections),
    ]
    say(f"{config.name}: report in '{written[0]}' and '{written[1]}'")
    return StageOutput(tags={"data_fingerprint": content.dataset.fingerprint}, files=written)


def collect_content(analysis: Analysis) -> ReportContent:
    """Read what the sections speak of; stages whose files are missing or older than the fit run first.

    Raises DataError for a reference table that breaks its laws.
    """
    config, work, measurement = analysis.config, analysis.files, prepare(analysis)
    reference = {} if config.report.reference is None else read_reference(Path(config.report.reference))
    fit = _read_fit(analysis)
    _make_current(analysis, fit)
    names = {"ingest", "diagnosis"} | ({"training", "metrics", "prediction"} if fit else set())
    contents = {name: work.folder / f"{name}.json" for name in names}
    judged = {} if fit is None else {"verdicts": load_judgement(analysis)}
    return ReportContent(
        config=config,
        measurement=measurement,
        fit=fit,
        spectra=_read_spectra(config),
        files={name: read_json(path) for name, path in contents.items() if path.exists()} | judged,
        tables={} if fit is None else read_tables(work.folder),
        reference=reference,
        origin=describe_origin(
            config,
            measurement,
            (work.vibration, work.excitation, work.folder / "model.safetensors"),
            describe_provenance(),
        ),
    )


def _make_current(analysis: Analysis, fit: FitContent | None) -> None:
    """Run the stages whose files the report reads, where they are missing or older than what they follow from."""
    work = analysis.files
    analysis.require("diagnose", work.folder / "diagnosis.json", behind=work.vibration)
    if fit is None:
        return
    analysis.require("evaluate", work.metrics, behind=work.training)
    modes = work.folder / "modes.csv"
    analysis.require("predict", modes, behind=work.training)
    if read_json(work.folder / "prediction.json").get("operating", {}) != dict(fit.twin.operating):
        say(f"'{modes}' is of other operating conditions: running stage=predict first")
        analysis.run("predict")


def _read_fit(analysis: Analysis) -> FitContent | None:
    """The fit, training first where it is missing; None, with a warning, where the data determine nothing."""
    config = analysis.config
    try:
        answer = restore(analysis)
    except IdentifiabilityError as error:
        warn(f"{error}\n{config.name}: the report has what was measured and the diagnosis alone")
        return None
    updated, data = answer.measurement, answer.measurement.dataset
    twin = load_twin(analysis)
    at_conditions = twin.systems["identified"]
    factors = read_json(analysis.files.training).get("fit", {}).get("noise_factor")
    factor = np.array(list(factors.values())) if factors and len(factors) == len(data.channels) else None
    return FitContent(
        coefficients=Coefficients.collect(
            answer.table, load_modelled(config, updated), answer.names, answer.deviation(answer.table)
        ),
        at_conditions=Coefficients.collect(at_conditions, None, answer.names, answer.deviation(at_conditions)),
        predicted=updated.response.predict(answer.table, answer.unbalance),
        noise=updated.deviation_of(data.displacement, updated.baseline, 1.0 if factor is None else factor),
        twin=twin,
        beyond=say_beyond(data.operating, twin.operating),
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
