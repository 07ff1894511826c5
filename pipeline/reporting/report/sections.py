"""The sections of the report, in their order."""

from __future__ import annotations

from pipeline.reporting.report.balancing import describe_balancing
from pipeline.reporting.report.coefficients import describe_coefficients
from pipeline.reporting.report.content import ReportContent
from pipeline.reporting.report.diagnosis import describe_diagnosis
from pipeline.reporting.report.fit import describe_fit, describe_held_out
from pipeline.reporting.report.machine import describe_machine
from pipeline.reporting.report.measured import describe_measured
from pipeline.reporting.report.modes import describe_modes
from pipeline.reporting.report.numbers import describe_numbers
from pipeline.reporting.report.origin import describe_conventions, describe_origin
from pipeline.reporting.report.response import describe_response
from pipeline.reporting.report.section import Section
from pipeline.reporting.report.verdicts import describe_verdicts

_SECTIONS = (
    describe_verdicts,
    describe_numbers,
    describe_coefficients,
    describe_machine,
    describe_measured,
    describe_diagnosis,
    describe_fit,
    describe_held_out,
    describe_modes,
    describe_response,
    describe_balancing,
    describe_conventions,
    describe_origin,
)


def list_sections(content: ReportContent) -> list[Section]:
    """Those that there is something to say in."""
    return [section for describe in _SECTIONS if (section := describe(content)) is not None]
