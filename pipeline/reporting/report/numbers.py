"""The numbers of the bearing laws, and what the readings say against these."""

from __future__ import annotations

from pipeline.evaluation.contradiction import find_contradiction, list_contradicted
from pipeline.reporting.physical_numbers import NUMBERS_HEADER, describe_law, list_number_rows, list_numbers
from pipeline.reporting.report.content import ReportContent
from pipeline.reporting.report.section import Block, Paragraph, Section, Table


def describe_numbers(content: ReportContent) -> Section | None:
    """A row a number, and sentences; None for a fit without bearing laws."""
    training, kind = content.files.get("training", {}), content.config.model.kind
    numbers = list_numbers(training.get("physical_numbers", {}), content.config)
    if not numbers:
        return None
    against = find_contradiction(training, kind) is not None or any(
        map(list_contradicted, training.get("correction", {}).values())
    )
    text = "All coefficients over speed and operating conditions follow from these numbers"
    text += ", times what a network corrects." if training.get("correction") else "."
    rows = [[cell.replace("+-", "±") for cell in row] for row in list_number_rows(numbers)]
    header = [head.replace("+-", "±") for head in NUMBERS_HEADER]
    blocks: list[Block] = [Paragraph(text), Table("Found, ± one standard deviation", header, rows)]
    blocks += [Paragraph(said.replace("+-", "±"), warning=against) for said in describe_law(training, kind)]
    return Section("numbers", "Numbers of the bearing laws", tuple(blocks))
