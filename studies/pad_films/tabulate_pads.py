"""Makes a table of a bearing with fixed or tilting pads: ``python studies/pad_films/tabulate_pads.py FILE --help``.

The tables of the package that no publication has are made so; their heads have the arguments.
"""

from __future__ import annotations

import argparse
import sys
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np
from reynolds import PadBearing, tabulate_bearing

from pipeline.files import write_text
from pipeline.laws.table import COLUMNS, PRELOAD

_HEAD = """\
# Made by Reynolds' equation (isothermal, laminar, rigid; a film breaks where its pressure would fall below ambient):
# python studies/pad_films/tabulate_pads.py {command}
# S = eta N L D / W (R / C)^2, N in 1/s; k = K W / C, c = B W / (w C); C is the clearance of the bore, and the preload
# 1 - C / (clearance of the pads' own radius); x is the direction of the load.{reduced}
"""
_NOTHING = 1e-9
"""What a coefficient that is zero by symmetry leaves by rounding."""
_REDUCED = " Pads without inertia, reduced to the\n# synchronous frequency."


def make_table(bearing: PadBearing, preloads: Sequence[float], sommerfeld: np.ndarray) -> np.ndarray:
    """(n, 10) rows over S, with the preload in the last column. Raises ArithmeticError."""
    parts = []
    for preload in preloads:
        rows = tabulate_bearing(replace(bearing, preload=preload), sommerfeld)
        rows[np.abs(rows) < _NOTHING * np.abs(rows).max(axis=1, keepdims=True)] = 0.0
        parts.append(np.column_stack([sommerfeld, rows, np.full(len(rows), preload)]))
    return np.concatenate(parts)


def _parse(arguments: Sequence[str]) -> argparse.Namespace:
    parser = argparse.ArgumentParser(prog="python studies/pad_films/tabulate_pads.py", description=__doc__)
    parser.add_argument("file", type=Path, help="the CSV file to write")
    parser.add_argument("--pads", type=int, default=2, help="how many, evenly spaced (2)")
    parser.add_argument("--first", type=float, default=0.0, help="degrees from the load to the middle of a pad (0)")
    parser.add_argument("--arc", type=float, default=160.0, help="degrees of a pad (160)")
    parser.add_argument("--length-ratio", type=float, default=0.5, help="L / D (0.5)")
    parser.add_argument("--preloads", type=float, nargs="+", default=[0.0], help="1 - Cb / Cp, one or more (0)")
    parser.add_argument("--tilting", action="store_true", help="pads that tilt about their middles; preloads above 0")
    parser.add_argument("--span", type=float, nargs=2, default=[0.03, 10.0], help="least and largest S (0.03 10)")
    parser.add_argument("--rows", type=int, default=24, help="rows at each preload (24)")
    parser.add_argument("--elements", type=int, nargs=2, default=[240, 12], help="along a pad, half across (240 12)")
    given = parser.parse_args(arguments)
    whole = given.pads * given.arc <= 360
    if given.pads < 1 or given.arc <= 0 or not whole or given.length_ratio <= 0 or given.rows < 4:
        parser.error("needs pads that fit into a turn, a length ratio above zero, and 4 rows or more")
    if not 0 < given.span[0] < given.span[1] or min(given.elements) < 4:
        parser.error("needs a span of ascending numbers above zero, and 4 elements or more")
    low = 0.0 if not given.tilting else 1e-9
    if not all(low <= preload < 1 for preload in given.preloads) or sorted(given.preloads) != given.preloads:
        parser.error("needs ascending preloads from 0 to below 1 (above 0 for tilting pads)")
    return given


def main(arguments: Sequence[str]) -> int:
    """Write the table; 1 where a static place was not found."""
    given = _parse(arguments)
    centres = tuple(np.radians(given.first + 360 / given.pads * np.arange(given.pads)).tolist())
    elements = (int(given.elements[0]), int(given.elements[1]))
    bearing = PadBearing(centres, np.radians(given.arc), 0.0, given.length_ratio, given.tilting, elements)
    try:
        rows = make_table(bearing, given.preloads, np.geomspace(given.span[0], given.span[1], given.rows))
    except ArithmeticError as error:
        print(f"{error}: choose a narrower --span, or other preloads", file=sys.stderr)
        return 1
    several = len(given.preloads) > 1
    names = [*COLUMNS, *([PRELOAD] if several else [])]
    lines = [",".join(f"{value:.5g}" for value in row[: len(names)]) for row in rows]
    command = " ".join([given.file.name, *(argument for argument in arguments if argument != str(given.file))])
    head = _HEAD.format(command=command, reduced=_REDUCED if given.tilting else "")
    write_text(given.file, head + "\n".join([",".join(names), *lines]) + "\n")
    return 0


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
