"""The tables of README and docs, made from what was measured.

    python docs/tables.py                      # writes them into the Markdown (make tables)
    python docs/tables.py measure GROUP[/NAME] # runs the commands of docs/measured/GROUP.json again (make measured)
    python docs/tables.py keep GROUP/NAME FOLDER # the figures of a folder in which that command has run

A table stands between ``<!-- table: NAME -->`` and ``<!-- end -->``; ``docs/measured/tables.md`` has its template, in
which ``{EXPERIMENT/FILE.PATH}`` is a figure of ``artifacts/EXPERIMENT/FILE.json`` and ``{GROUP/NAME/FILE.PATH}`` one of
``docs/measured/GROUP.json``, which keeps what takes too long for every ``make reproduce``, with its command. ``*`` in a
path matches any text; the largest match is printed, after ``least`` the smallest, in two digits. ``*0.6745`` behind a
path multiplies; ``:3`` prints three digits, ``:d`` a whole number, ``:>150`` that the figure is larger.
"""

from __future__ import annotations

import fnmatch
import json
import math
import re
import shlex
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Any

ROOT = Path(__file__).resolve().parents[1]
PAGES = (
    "README.md",
    "docs/method.md",
    "docs/noise.md",
    "docs/trust.md",
    "docs/laws.md",
    "studies/coverage/README.md",
    "studies/ordinary/README.md",
    "studies/oil_temperatures/README.md",
)
MEASURED = ROOT / "docs" / "measured"
ROUNDING = 1e-10
"""Smaller figures are rounding: their digits mean nothing."""

_TABLE = re.compile(r"(<!-- table: (\w+) -->\n)(.*?)(<!-- end -->)", re.S)
_FIGURE = re.compile(r"\{(least )?([\w/]+)\.([^{}]+?)(?: \*([\d.]+))?(?: :(>?[\d.]+|d))?\}")
_NUMBER = re.compile(r"\d+(?:\.\d+)?")


def read_templates() -> dict[str, str]:
    """The text of every table, with its figures still to be filled in, by name."""
    parts = re.split(r"^## (\w+)\n\n", (MEASURED / "tables.md").read_text(encoding="utf-8"), flags=re.M)
    return {name: text.strip() + "\n" for name, text in zip(parts[1::2], parts[2::2], strict=True)}


def read_tables(page: str) -> dict[str, str]:
    """The tables that a page prints, by name."""
    return {found[2]: found[3] for found in _TABLE.finditer((ROOT / page).read_text(encoding="utf-8"))}


def fill(template: str, artifacts: Path) -> str:
    """A table with its figures. Raises ValueError where one is missing, or is not what the template says of it."""
    return _FIGURE.sub(lambda found: _print(_look_up(found, artifacts), found), template)


def needs_artifacts(template: str) -> bool:
    """Whether a figure of the table is made by ``make reproduce``."""
    return any(found[2].count("/") == 1 for found in _FIGURE.finditer(template))


def find_differences(printed: str, filled: str) -> list[str]:
    """Lines that differ by more than one in a last printed digit, or in their words."""
    pairs = zip(printed.splitlines(), filled.splitlines(), strict=False)
    differing = [f"{old}\n{new}" for old, new in pairs if not _agree(old, new)]
    return differing if printed.count("\n") == filled.count("\n") else [printed, filled]


def _agree(old: str, new: str) -> bool:
    """A last digit may differ by one: the figure lies between two of them, or the processor is another."""
    if _NUMBER.sub("", old) != _NUMBER.sub("", new):
        return False
    numbers = zip(_NUMBER.findall(old), _NUMBER.findall(new), strict=True)
    return all(abs(float(a) - float(b)) <= 1.001 * max(_unit(a), _unit(b)) for a, b in numbers)


def _unit(number: str) -> float:
    """One in the last place of a printed number that means something: 0.01 of 0.38, 10 of 200."""
    whole, _, decimals = number.partition(".")
    zeros = len(whole) - len(whole.rstrip("0")) if not decimals and len(whole) > 2 else 0
    return float(10.0 ** (zeros - len(decimals)))


def _look_up(found: re.Match[str], artifacts: Path) -> float:
    source, path = found[2], found[3]
    try:
        if source.count("/") == 1:
            values = list(_select(_read(artifacts / f"{source}.json"), path.split(".")))
        else:
            group, name, file = source.split("/")
            kept = _read(MEASURED / f"{group}.json")[name]["figures"]
            values = [kept[("least " if found[1] else "") + f"{file}.{path}"]]
    except (KeyError, OSError) as error:
        raise ValueError(f"{found[0]} must name a figure that was measured, but {error} is missing") from None
    if not values:
        raise ValueError(f"{found[0]} must name a figure that was measured, but nothing has this path")
    return float(min(values) if found[1] else max(values)) * float(found[4] or 1)


def _print(value: float, found: re.Match[str]) -> str:
    form = found[5] or "2"
    if form.startswith(">"):
        if not value > float(form[1:]):
            raise ValueError(f"{found[0]} must be more than it says, but is {value:.3g}")
        return f"> {form[1:]}"
    if form == "d":
        return f"{value:.0f}"
    if value < ROUNDING:
        return "rounding, < 1e-10"
    places = int(form) - 1 - math.floor(math.log10(float(f"{value:.{int(form) - 1}e}")))
    return f"{round(value, places):.{max(places, 0)}f}"


def _read(path: Path) -> Any:
    return json.loads(path.read_text(encoding="utf-8"))


def _select(value: Any, path: list[str]) -> Iterator[float]:
    if not path:
        yield float(value)
        return
    for key in fnmatch.filter(value, path[0]):
        yield from _select(value[key], path[1:])


def write(artifacts: Path) -> list[str]:
    """Fill the tables of every page in. One whose figures are missing stays; why, is returned."""
    templates, missing = read_templates(), []

    def filled(found: re.Match[str]) -> str:
        try:
            return found[1] + fill(templates[found[2]], artifacts) + found[4]
        except ValueError as error:
            missing.append(f"{found[2]}: {error}")
            return found[0]

    for page in PAGES:
        path = ROOT / page
        path.write_text(_TABLE.sub(filled, path.read_text(encoding="utf-8")), encoding="utf-8")
    return missing


def measure(wanted: str) -> None:
    """Run the commands of a group, or of one of its names, and keep the figures that its file asks for."""
    group, _, only = wanted.partition("/")
    for name, entry in _read(MEASURED / f"{group}.json").items():
        if only in ("", name):
            folder = ROOT / "artifacts" / "measured" / group / name
            words = [*shlex.split(entry["command"])[1:], f"output={folder}", "tracking=none"]
            subprocess.run([sys.executable, *words], cwd=ROOT, check=True)
            keep(f"{group}/{name}", folder)


def keep(which: str, folder: Path) -> None:
    """Put the figures that the command of ``GROUP/NAME`` made in ``folder`` into the group's file, in four digits."""
    group, name = which.split("/")
    path = MEASURED / f"{group}.json"
    kept = _read(path)
    for key in kept[name]["figures"]:
        file, *steps = key.removeprefix("least ").split(".")
        values = list(_select(_read(folder / f"{file}.json"), steps))
        kept[name]["figures"][key] = float(f"{(min if key.startswith('least ') else max)(values):.4g}")
    path.write_text(json.dumps(kept, indent=2) + "\n", encoding="utf-8")


if __name__ == "__main__":
    if sys.argv[1:2] == ["measure"]:
        for group in sys.argv[2:]:
            measure(group)
    elif sys.argv[1:2] == ["keep"]:
        keep(sys.argv[2], Path(sys.argv[3]))
    else:
        sys.exit("\n".join(write(Path(sys.argv[1]) if sys.argv[1:] else ROOT / "artifacts")) or None)
