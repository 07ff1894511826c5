"""What a logger's file tells by itself: its probes, runs, units and speeds, as guesses for a person to confirm.

Columns are combined by their names: ``DE_Y Amp`` and ``DE_Y Phase`` are of the probe ``DE_Y``. Units are the words of
the names and of the rows below them.
"""

from __future__ import annotations

import json
import os
import re
from collections.abc import Mapping
from functools import partial
from pathlib import Path
from typing import Literal
from zipfile import ZipFile

import numpy as np

from pipeline.config.own_machines import clean_name
from pipeline.data.mat_files import open_measured
from pipeline.data.tables import PLAIN, list_sheets, list_units, read_table
from pipeline.errors import DataError

_MEANINGS = {
    "length": {"um": "um", "mm": "mm", "mils?": "mil", "in": "in", "m": "m"},
    "amplitude": {"pp|p-p|pk-pk|pkpk": "peak_to_peak", "rms": "rms", "0-p|pk|peak|0-pk": "zero_to_peak"},
    "phase": {"lag": "lag", "lead": "lead"},
    "phase_unit": {"deg|degrees?": "deg", "rad": "rad"},
    "speed": {"rpm|1/min|min-1|cpm": "rpm", "hz": "Hz", "rad/s": "rad/s"},
}
"""Key of the conventions -> words that mean each of its values."""
_RPM = {"Hz": 60.0, "rad/s": 30 / np.pi}
_PHASE = "phase|phs|ph|angle|deg|degrees?|lag|lead"
_SPEED = "speed|rpm|drehzahl|1/min|min-1|cpm|frequency|freq|hz|rad/s"
_TACHO = "tacho|tach|trigger|trig|key|keyphasor|kph"
_TIME = "time|t|zeit"
_ROLES = f"{_PHASE}|amp|ampl|amplitude|mag|magnitude|disp|1x|um|mm|mils?|in|m|v|mv|pp|p-p|pk|pk-pk|0-p|peak|rms|rad"
_write = partial(json.dumps, ensure_ascii=False)


def recognize_recordings(path: Path, folder: Path) -> tuple[Literal["tables", "recordings"], dict[str, str]]:
    """The kind of machine file in a folder (``tables`` of amplitudes and phases, ``recordings`` of signals), and what
    takes the place of the example's values, by key; ``???`` for a convention that the file does not say.

    Files of the same columns beside it, and sheets of a workbook, are runs. Raises DataError for a file that is no
    table, and where no probe is recognised in its columns.
    """
    units = {name: f"{name} {unit}" for name, unit in _list_columns(path).items()}
    runs = {sheet or clean_name(path): (path, sheet) for sheet in list_sheets(path)}
    if len(runs) == 1:
        beside = sorted(other for other in path.parent.iterdir() if other.suffix == path.suffix)
        runs = {clean_name(other): (other, None) for other in beside if _list_columns(other).keys() == units.keys()}
    phases = {_name_probe(name): name for name, text in units.items() if _has(_PHASE, text)}
    further = [name for name in units if name not in phases.values()]
    sizes = {_name_probe(name): name for name in further if not _has(f"{_SPEED}|{_TACHO}|{_TIME}", units[name])}
    probes = {probe: name for probe, name in sizes.items() if probe in phases or not phases}
    if not probes:
        raise DataError(
            f"'{path}' must have an amplitude and a phase of each probe, or its signal, but no two of its columns are "
            f"called alike: {', '.join(units)}; give names such as 'DE_Y Amp' and 'DE_Y Phase', or leave new.from out"
        )
    baseline = next((name for name in runs if re.search("found|base|ref|initial|null", name)), next(iter(runs)))
    guesses = {"runs": _list_runs(runs, baseline, folder), "baseline": _write(baseline)}
    if not phases:
        seen = {probe: f"channel: {_write(name)}, scale: 7.87 V/mm" for probe, name in probes.items()}
        for name in units:
            if _has(_TIME, name):
                guesses["sample_rate"] = f"null\n  time: {_write(name)}\n  time_unit: s"
            if _has(_TACHO, name):
                edge = "edge: rising, pulses_per_revolution: 1"
                guesses["tacho"] = f"{{angle: 0 deg, channel: {_write(name)}, {edge}}}"
        return "recordings", guesses | {"probes": _list_probes(seen)}
    speed = next((name for name in further if _has(_SPEED, units[name])), further[0])
    for key, meanings in _MEANINGS.items():
        told = {"speed": [speed], "phase": phases.values(), "phase_unit": phases.values()}.get(key, probes.values())
        text = " ".join(units[name] for name in told)
        guesses[key] = next((value for names, value in meanings.items() if _has(names, text)), "???")
    seen = {
        probe: f"columns: {{amplitude: {_write(name)}, phase: {_write(phases[probe])}}}"
        for probe, name in probes.items()
    }
    guesses |= {"columns": f"{{speed: {_write(speed)}}}", "probes": _list_probes(seen)}
    return "tables", guesses | {"speeds": _find_speeds(runs, speed, _RPM.get(guesses["speed"], 1.0))}


def _list_columns(path: Path) -> dict[str, str]:
    """Name of each column -> what stands below it."""
    if path.suffix != ".npz":
        return list_units(path)
    with open_measured(path, "complete NumPy file (.npz)"), ZipFile(path) as file:
        return {name.removesuffix(".npy"): "" for name in file.namelist()}


def _has(names: str, text: str) -> bool:
    """Whether one of the ``names`` is in the ``text``; those of units do not part at a slash."""
    letters = str.maketrans({"µ": "u", "μ": "u", "°": "deg", **dict.fromkeys("[](),;:_", " ")})
    return any(re.fullmatch(names, word) for word in text.translate(letters).lower().split())


def _name_probe(column: str) -> str:
    """The column's name without what its numbers are."""
    kept = [name for name in re.split(r"[\s_\[\](),;:]+", column) if name and not _has(_ROLES, name)]
    return "_".join(kept) or column


def _list_probes(seen: Mapping[str, str]) -> str:
    """Two at a bearing of the example, at 45 and 135 degrees."""
    places = [f"node: {node}, angle: {angle} deg" for node in (1, 5) for angle in (45, 135)] * len(seen)
    lines = [
        f"    {_write(probe)}: {{{place}, {said}}}\n"
        for place, (probe, said) in zip(places, seen.items(), strict=False)
    ]
    return "".join(["  # recognised: confirm what belongs together, and give nodes and angles\n", *lines])


def _list_runs(runs: Mapping[str, tuple[Path, str | None]], baseline: str, folder: Path) -> str:
    lines = [
        "  # recognised: say what was on the shaft, such as unbalances: [{node: 2, magnitude: 9 g mm, phase: 0 deg}]\n"
    ]
    for name, (path, sheet) in runs.items():
        source = f"file: {_write(os.path.relpath(path, folder))}" + (f", sheet: {_write(sheet)}" if sheet else "")
        acting = "" if name == baseline else ', unbalances: "???"'
        lines.append(f"    - {{name: {_write(name)}, {source}{acting}}}\n")
    return "".join(lines)


def _find_speeds(runs: Mapping[str, tuple[Path, str | None]], column: str, rpm: float) -> str:
    """The range that all have, in the usual step of the first; the file's unit is so many ``rpm``."""
    tables = [read_table(path, {column: "number"}, text=PLAIN.on(sheet)) for path, sheet in runs.values()]
    every = [rpm * np.unique(table[column]) for table in tables]
    start, stop = max(float(speeds[0]) for speeds in every), min(float(speeds[-1]) for speeds in every)
    step = float(np.median(np.diff(every[0]))) if len(every[0]) > 1 else 1.0
    return f"{{start_rpm: {start:g}, stop_rpm: {stop:g}, step_rpm: {step:g}}}"
