"""The folder ``export``: the answer at each state in every format that is asked for, as other programs read it.

Formats: ANSYS Rotordynamic Analysis Guide, appendix "Bearing Characteristics File Format", and the element COMBI214;
DyRoBeS-Rotor help, "Bearing Coefficients from External Data File"; XLTRC2's worksheet of a bearing, as ROSS reads it.
"""

from __future__ import annotations

import itertools
import json
from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from pipeline.coefficients import COEFFICIENTS
from pipeline.config.runs import find_frequencies
from pipeline.config.schema import Config
from pipeline.data.dataset import VibrationDataset
from pipeline.data.excitation_files import run_excitations
from pipeline.data.operating import split_states
from pipeline.data.tables import write_table
from pipeline.export.coefficients import BRIEF, NAMES, Document, Exported, Number, document, list_conventions, tabulate
from pipeline.files import render, write_json, write_text
from pipeline.identification.identified import Answer
from pipeline.identification.quality import finite
from pipeline.problem.measurement import Measurement
from pipeline.twin.at_conditions import evaluate_at, require_conditions
from pipeline.twin.prediction import predict
from pipeline.write_numbers import write_number

_TEMPLATES = Path(__file__).with_name("templates")
"""Of texts for other programs, by the format's name: each begins with where it is described."""


def write_for(name: str, exported: Exported, b: int) -> str:
    """A bearing in the format of another program: of the template ``dyrobes.txt``, ``ansys.txt`` (the bearing
    characteristics file), or ``ansys.inp`` (APDL)."""
    return render(
        _TEMPLATES / name,
        exported=exported,
        node=exported.table.nodes[b],
        units=" and ".join(NAMES[exported.units]),
        brief=BRIEF,
        rows=list(zip(exported.rpm, exported.values[b], strict=True)),
    )


def write_workbook(
    path: Path, *states: Exported, numbers: Sequence[Number] = (), above: int = 5, longest: int = 31
) -> None:
    """A worksheet a bearing and state as XLTRC2 has it, which ROSS's ``BearingElement.from_table`` reads.

    Deviations, physical numbers and conditions are on sheets of their own. A name has at most ``longest`` letters;
    XLTRC2 has so many rows ``above`` the header.
    """
    from openpyxl import Workbook

    sheets: dict[str, list[list[Any]]] = {}
    for (i, exported), (b, node) in itertools.product(enumerate(states, start=1), enumerate(states[0].table.nodes)):
        title = f"node {node}" + (f", {exported.state}" if exported.operating else "")
        if len(title) > longest - len(" deviations"):
            title = f"node {node}, state {i}"
        for beside, table in exported.tables.items():
            sheets[f"{title} deviations" if beside else title] = [
                [f"{exported.title}, bearing at node {node}; the sheet 'conventions' has axes and signs"],
                *[[None]] * (above - 1),
                ["Speed", *(name.capitalize() for name in COEFFICIENTS)],
                ["rpm", *map(exported.unit, COEFFICIENTS)],
                *([float(rpm), *map(finite, row)] for rpm, row in zip(exported.rpm, table[b], strict=True)),
            ]
    if numbers:
        rows = ([number.name, number.value, number.std, number.unit] for number in numbers)
        sheets["physical numbers"] = [["number", "value", "standard deviation", "unit"], *rows]
    sheets["conventions"] = [[convention] for convention in list_conventions(states)]
    book = Workbook()
    book.remove(book.active)
    for title, lines in sheets.items():
        sheet = book.create_sheet(title)
        for line in lines:
            sheet.append(line)
    for cell in (cell for sheet in book for row in sheet.iter_rows() for cell in row):
        cell.data_type = "s" if cell.data_type == "f" else cell.data_type  # a name that begins with "=" is no formula
    book.save(path)


def list_states(config: Config, dataset: VibrationDataset) -> list[dict[str, float]]:
    """The conditions (SI) of each state that is written: the configured ones, or the measured ones by their means.

    One without conditions for data that have none. Raises ConfigError for a condition that is missing, or that the
    data lack.
    """
    for given in config.export.operating:
        require_conditions(_KEY, given, dataset.operating)
    if config.export.operating:
        return [{name: given[name] for name in dataset.operating} for given in config.export.operating]
    measured = split_states(dataset.speeds, dataset.operating)
    return [
        {name: float(np.mean(values[points])) for name, values in dataset.operating.items()} for _, points in measured
    ]


_KEY = "export.operating"


def export_at(config: Config, answer: Answer, operating: Mapping[str, float]) -> Exported:
    """The answer at one state, at each speed of the data."""
    table = evaluate_at(answer.model, answer.measurement, operating, _KEY)[1]
    identified = answer.model.unknowns.identified
    return Exported(config.name, answer.state(table), identified, config.export.units, operating)


def write_exports(
    folder: Path,
    config: Config,
    updated: Measurement,
    states: Sequence[Exported],
    numbers: Sequence[Number],
    reservation: str,
) -> list[str]:
    """Every format that is asked for; what there is to say of them. ``updated`` is at the fitted model parameters.

    A ``reservation`` stands in the conventions, and in a file whose name nobody overlooks.
    """
    formats, notes = config.export.formats, []
    warning = [reservation] if reservation else []
    write_text(folder / "conventions.txt", "\n".join([*warning, *list_conventions(states)]) + "\n")
    if reservation:
        write_text(folder / "MODEL_REJECTED.txt", reservation + "\n")
    if "csv" in formats:
        write_table(folder / "coefficients.csv", tabulate(*states))
        if numbers:
            write_table(folder / "physical_numbers.csv", [number.model_dump() for number in numbers])
    if "excel" in formats:
        write_workbook(folder / "coefficients.xlsx", *states, numbers=numbers)
    if "json" in formats:
        write_json(folder / "coefficients.json", document(*states, numbers=numbers).model_dump(mode="json"))
        write_text(folder / "coefficients.schema.json", json.dumps(Document.model_json_schema(), indent=2) + "\n")
    for exported, (b, node) in itertools.product(states, enumerate(states[0].table.nodes)):
        name = f"node_{node}{exported.suffix}"
        for template in sorted(_TEMPLATES.iterdir()):
            if template.stem in formats:
                text = write_for(template.name, exported, b)
                write_text(folder / f"{template.stem}_{name}{template.suffix}", text)
    if "ross" in formats:
        notes.append(_write_ross(folder, config, updated, states))
    return notes


def _write_ross(folder: Path, config: Config, updated: Measurement, states: Sequence[Exported]) -> str:
    """The rotor and each bearing, a file a state, and their deviations; how far ROSS's smoothing moves the response."""
    from pipeline.rotor.ross_export import export_rotor, make_bearings, read_table

    rotor, prediction, off = config.machine.rotor, config.machine.prediction, []
    asked = run_excitations(prediction), prediction.node, find_frequencies(prediction, states[0].table.speeds)
    for exported in states:
        made = export_rotor(rotor, updated.parameters, exported.table)
        made.save(folder / f"rotor{exported.suffix}.toml")
        elements = make_bearings(exported.table, {})
        for element in elements:
            element.save(folder / f"bearing_node_{element.n}{exported.suffix}.toml")
        smoothed = read_table(elements, exported.table.speeds)
        ours, theirs = (predict(updated.updated_rotor, table, *asked) for table in (exported.table, smoothed))
        off.append(float(np.max(theirs.error_percent(ours))))
    if states[0].table.deviation is not None:
        columns = tabulate(*(replace(state, units="si") for state in states))
        write_table(folder / "deviations.csv", {k: v for k, v in columns.items() if k not in COEFFICIENTS})
    every = zip(updated.rotor.bearing_nodes, updated.updated_rotor.bearing_shifts, strict=False)
    beside = "".join(
        f"; the fit places the bearing of node {node} {1e3 * shift:+.3g} mm along the shaft, which 'rotor.toml' lacks"
        for node, shift in every
    )
    files = " and ".join(f"'rotor{state.suffix}.toml'" for state in states[:3]) + (", ..." if len(states) > 3 else "")
    return (
        f"{files} {'is' if len(states) == 1 else 'are'} for ross.Rotor.load; ROSS smooths tables over the speed, which "
        f"moves the response to the prediction's unbalance by at most {write_number(max(off), digits=1)} %{beside}"
    )
