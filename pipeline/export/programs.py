"""Bearing tables as other programs read them: ANSYS, DyRoBeS, XLTRC2.

Formats: ANSYS Rotordynamic Analysis Guide, appendix "Bearing Characteristics File Format", and the element COMBI214;
DyRoBeS-Rotor help, "Bearing Coefficients from External Data File"; XLTRC2's worksheet of a bearing, as ROSS reads it.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from pipeline.coefficients import COEFFICIENTS
from pipeline.export.coefficients import BRIEF, NAMES, Exported, Number, list_conventions

_ANSYS_NAMES = dict(zip(COEFFICIENTS, ("K11", "K12", "K21", "K22", "C11", "C12", "C21", "C22"), strict=True))
_COMBI214 = (("K11", "K22", "K12", "K21", "C11", "C22"), ("C12", "C21"))
"""Real constants of the element in its own order: six on R, the others on RMORE."""


def write_dyrobes(exported: Exported, b: int) -> str:
    """``N, unit, Nc, kRot, 0, 0, 0 comments``, then ``rpm, Kxx .. Cyy`` a line: counter-clockwise rotation, kRot 0.

    The unit is 2 for s, in, lbf, lbm, and 3 for s, m, N, kg.
    """
    units = " and ".join(NAMES[exported.units])
    text = f"{exported.title}, node {exported.table.nodes[b]}: {units}; {BRIEF}"
    head = f"{len(exported.rpm)}, {3 if exported.units == 'si' else 2}, 8, 0, 0, 0, 0  {text}"
    rows = [
        ", ".join([f"{rpm:.6f}", *(f"{value:.9E}" for value in row)])
        for rpm, row in zip(exported.rpm, exported.values[b], strict=True)
    ]
    return "\n".join([head, *rows]) + "\n"


def write_ansys_file(exported: Exported, b: int) -> str:
    """ANSYS's bearing characteristics file: no transformation of the units, speeds in rpm that become rad/s.

    Its columns give speeds two decimals of an rpm, and coefficients eight digits.
    """
    titles = [
        f"{exported.title}, bearing at node {exported.table.nodes[b]}",
        f"{' and '.join(NAMES[exported.units])}, speeds in rpm; 1 is x, 2 is y",
        BRIEF,
    ]
    lines = [title[:80] for title in titles] + [f"{len(exported.rpm):10d}{0:10d}{1:10d}"]
    for i, (rpm, row) in enumerate(zip(exported.rpm, exported.values[b], strict=True), start=1):
        lines.append(f"{i:10d}{rpm:10.2f}")
        lines += ["".join(f"{value:15.7E}" for value in half) for half in (row[:4], row[4:])]
    return "\n".join(lines) + "\n"


def write_apdl(exported: Exported, b: int) -> str:
    """APDL input: COMBI214 in the XY plane, not symmetric, with tables over the rotational velocity (OMEGS, rad/s)."""
    node = exported.table.nodes[b]
    lines = [f"! {sentence}" for sentence in exported.conventions()]
    lines.append(f"! bearing at node {node}; /INPUT this in PREP7; type and real constant set are {node + 1}")
    lines += [f"ET,{node + 1},COMBI214", f"KEYOPT,{node + 1},2,0", f"KEYOPT,{node + 1},3,1"]
    several = len(exported.rpm) > 1
    constants = {}
    for c, name in enumerate(COEFFICIENTS):
        parameter, values = f"{_ANSYS_NAMES[name]}_{node}", exported.values[b, :, c]
        constants[_ANSYS_NAMES[name]] = f"%{parameter}%" if several else f"{values[0]:.9E}"
        lines += _write_table(parameter, exported.table.speeds, values) if several else ()
    for command, names in zip((f"R,{node + 1}", "RMORE"), _COMBI214, strict=True):
        lines.append(",".join([command, *(constants[name] for name in names)]))
    return "\n".join(lines) + "\n"


def _write_table(parameter: str, speeds: np.ndarray, values: np.ndarray) -> Iterator[str]:
    yield f"*DIM,{parameter},TABLE,{len(speeds)},1,1,OMEGS"
    for i, (speed, value) in enumerate(zip(speeds, values, strict=True), start=1):
        yield f"{parameter}({i},0)={speed:.9E}"
        yield f"{parameter}({i},1)={value:.9E}"


def write_workbook(path: Path, *states: Exported, numbers: Sequence[Number] = ()) -> None:
    """A worksheet a bearing and state as XLTRC2 has it, which ROSS's ``BearingElement.from_table`` reads.

    Deviations, physical numbers and conventions are on sheets of their own.
    """
    from openpyxl import Workbook

    book = Workbook()
    book.remove(book.active)
    for i, exported in enumerate(states, start=1):
        _add_sheets(book, exported, i)
    if numbers:
        sheet = book.create_sheet("physical numbers")
        sheet.append(["number", "value", "standard deviation", "unit"])
        for number in numbers:
            sheet.append([number.name, number.value, number.std, number.unit])
    sheet = book.create_sheet("conventions")
    for convention in list_conventions(states):
        sheet.append([convention])
    book.save(path)


def _add_sheets(book: Any, exported: Exported, number: int, above: int = 5, longest: int = 31) -> None:
    """A name has at most ``longest`` letters; XLTRC2 has so many rows ``above`` the header."""
    for b, node in enumerate(exported.table.nodes):
        name = f"node {node}" + (f", {exported.state}" if exported.operating else "")
        if len(name) > longest - len(" deviations"):
            name = f"node {node}, state {number}"
        for beside, table in exported.tables.items():
            sheet = book.create_sheet(f"{name} deviations" if beside else name)
            sheet.append([f"{exported.title}, bearing at node {node}; the sheet 'conventions' has axes and signs"])
            for _ in range(above - 1):
                sheet.append([None])
            sheet.append(["Speed", *(name.capitalize() for name in COEFFICIENTS)])
            sheet.append(["rpm", *map(exported.unit, COEFFICIENTS)])
            for rpm, row in zip(exported.rpm, table[b], strict=True):
                sheet.append([float(rpm), *(None if np.isnan(value) else float(value) for value in row)])
