"""What a logger's file tells by itself: its probes, runs, units and speeds, as guesses for a person to confirm.

Columns are combined by their names: ``DE_Y Amp`` and ``DE_Y Phase`` are of the probe ``DE_Y``. Units are the words of
the names and of the rows below them.
"""

from __future__ import annotations

import json
import os
import re
from collections.abc import Callable, Mapping, Sequence
from functools import partial
from pathlib import Path
from typing import Literal

import numpy as np

from pipeline.config.own_machines import clean_name
from pipeline.data.tables import PLAIN, list_sheets, read_table
from pipeline.errors import DataError
from pipeline.ingest.recordings import Contents, list_contents
from pipeline.ingest.uff import list_records

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
_RATE = r"fs|(sampl\w*)?(rate|frequency)"
_SIGNALS = {"mv": "mV", "v|volts?": "V"} | _MEANINGS["length"]
_ROLES = f"{_PHASE}|amp|ampl|amplitude|mag|magnitude|disp|1x|um|mm|mils?|in|m|v|mv|pp|p-p|pk|pk-pk|0-p|peak|rms|rad"
_write = partial(json.dumps, ensure_ascii=False)


def recognize_recordings(
    path: Path, folder: Path, nodes: Sequence[int] = (1, 5)
) -> tuple[Literal["tables", "recordings"], dict[str, str]]:
    """The kind of machine file in a folder (``tables`` of amplitudes and phases, ``recordings`` of signals), and what
    takes the place of the example's values, by key; ``???`` for a convention that the file does not say, nothing for a
    key that its format lacks.

    Files of the same columns beside it, and sheets of a workbook, are runs; two probes are at each of the bearings'
    ``nodes``. Raises DataError for a file that is no
    table, and where no probe is recognised in its columns.
    """
    if path.suffix.lower() in (".uff", ".unv"):
        return _recognize_records(path, folder, nodes)
    contents = list_contents(path)
    names = {name: name.rpartition(contents.mark)[2] for name in contents.units}
    units = {name: f"{names[name]} {unit}" for name, unit in contents.units.items()}
    runs = {sheet or clean_name(path): (path, sheet) for sheet in list_sheets(path)}
    if len(runs) == 1:
        runs = _find_beside(path, units, lambda other: list_contents(other).units)
    phases = {_name_probe(names[name]): name for name, text in units.items() if _has(_PHASE, text)}
    further = [name for name in units if name not in phases.values()]
    others = f"{_SPEED}|{_TACHO}|{_TIME}|{_RATE}"
    sizes = {_name_probe(names[name]): name for name in further if not _has(others, units[name])}
    probes = {probe: name for probe, name in sizes.items() if probe in phases or not phases}
    if not probes:
        raise DataError(
            f"'{path}' must have an amplitude and a phase of each probe, or its signal, but no two of its columns are "
            f"called alike: {', '.join(units)}; give names such as 'DE_Y Amp' and 'DE_Y Phase', or leave new.from out"
        )
    guesses = _list_runs(runs, folder)
    if not phases:
        return "recordings", guesses | _describe_signals(contents, units, probes, nodes)
    speed = next((name for name in further if _has(_SPEED, units[name])), further[0])
    for key, meanings in _MEANINGS.items():
        told = {"speed": [speed], "phase": phases.values(), "phase_unit": phases.values()}.get(key, probes.values())
        text = " ".join(units[name] for name in told)
        guesses[key] = next((value for names, value in meanings.items() if _has(names, text)), "???")
    seen = {
        probe: f"columns: {{amplitude: {_write(name)}, phase: {_write(phases[probe])}}}"
        for probe, name in probes.items()
    }
    guesses |= {"columns": f"{{speed: {_write(speed)}}}", "probes": _list_probes(seen, nodes)}
    return "tables", guesses | {"speeds": _find_speeds(runs, speed, _RPM.get(guesses["speed"], 1.0))}


def _describe_signals(
    contents: Contents, units: Mapping[str, str], probes: Mapping[str, str], nodes: Sequence[int]
) -> dict[str, str]:
    """The guesses of time signals: their unit, the channel of the tacho, the times or the rate."""
    text = " ".join(units[name] for name in probes.values())
    unit = next((value for names, value in _SIGNALS.items() if _has(names, text)), "???")
    scale = ", scale: 7.87 V/mm" if unit in ("V", "mV", "???") else ""
    guesses = {
        "probes": _list_probes({probe: f"channel: {_write(name)}{scale}" for probe, name in probes.items()}, nodes)
    }
    tacho = next((name for name in units if _has(_TACHO, units[name])), "???")
    guesses["tacho"] = f"{{angle: 0 deg, channel: {_write(tacho)}, edge: rising, pulses_per_revolution: 1}}"
    rates = [f"null\n  time: {_write(name)}\n  time_unit: s" for name in units if _has(_TIME, units[name])]
    named = [name for name in contents.attributes if _has(_RATE, name.replace("_", ""))]
    rates += [f"null\n  sample_rate_attribute: {_write(name)}" for name in named]
    return guesses | {"signal_unit": unit, "sample_rate": (["", *rates] if contents.rated else [*rates, "???"])[0]}


def _find_beside(
    path: Path, names: Mapping[str, str], look: Callable[[Path], Mapping[str, str]]
) -> dict[str, tuple[Path, str | None]]:
    """The files beside it, and itself, whose channels have the same names."""
    beside = sorted(other for other in path.parent.iterdir() if other.suffix == path.suffix)
    return {clean_name(other): (other, None) for other in beside if look(other).keys() == names.keys()}


def _recognize_records(
    path: Path, folder: Path, nodes: Sequence[int]
) -> tuple[Literal["tables", "recordings"], dict[str, str]]:
    """Records of a universal file by their text, or by node and direction where runs share the file."""
    records, labels, timed = list_records(path)
    runs: dict[str, tuple[Path, str | None]] = {label: (path, label) for label in labels}
    runs = runs or _find_beside(path, records, lambda other: list_records(other)[0])
    tacho = next((text for text in records if _has(_TACHO, text)), "tacho")
    scale = ", scale: 7.87 V/mm" if timed else ""
    probes = _list_probes({_name_probe(text): place + scale for text, place in records.items() if text != tacho}, nodes)
    guesses = _list_runs(runs, folder, "label") | {"format": "uff58", "probes": probes}
    if timed:
        place = records.get(tacho, 'record: "???"')
        guesses |= {"tacho": f"{{angle: 0 deg, {place}, edge: rising}}", "sample_rate": "", "signal_unit": "???"}
        return "recordings", guesses
    guesses |= dict.fromkeys(("length", "amplitude", "phase", "speed"), "???") | {"speeds": "null"}
    return "tables", guesses | dict.fromkeys(("layout", "phase_unit", "columns"), "")


def _has(names: str, text: str) -> bool:
    """Whether one of the ``names`` is in the ``text``; those of units do not part at a slash."""
    letters = str.maketrans({"µ": "u", "μ": "u", "°": "deg", **dict.fromkeys("[](),;:_", " ")})
    return any(re.fullmatch(names, word) for word in text.translate(letters).lower().split())


def _name_probe(column: str) -> str:
    """The column's name without what its numbers are."""
    kept = [name for name in re.split(r"[\s_\[\](),;:]+", column) if name and not _has(_ROLES, name)]
    return "_".join(kept) or column


def _list_probes(seen: Mapping[str, str], nodes: Sequence[int]) -> str:
    """Two at each bearing's node, at 45 and 135 degrees."""
    places = [f"node: {node}, angle: {angle} deg" for node in nodes for angle in (45, 135)] * len(seen)
    lines = [
        f"    {_write(probe)}: {{{place}, {said}}}\n"
        for place, (probe, said) in zip(places, seen.items(), strict=False)
    ]
    return "".join(["  # recognised: confirm what belongs together, and give nodes, angles and scales\n", *lines])


def _list_runs(runs: Mapping[str, tuple[Path, str | None]], folder: Path, part: str = "sheet") -> dict[str, str]:
    """The runs, each a file or a ``part`` of it, and the one without weights among them."""
    hints = "found|fund|base|ref|initial|null|zero|without|ohne"
    baseline = next((name for name in runs if re.search(hints, name, re.IGNORECASE)), "???")
    lines = [
        "  # recognised: say what was on the shaft, such as unbalances: [{node: 2, magnitude: 9 g mm, phase: 0 deg}]\n"
    ]
    for name, (path, label) in runs.items():
        source = f"file: {_write(os.path.relpath(path, folder))}" + (f", {part}: {_write(label)}" if label else "")
        acting = "" if name == baseline else ', unbalances: "???"'
        lines.append(f"    - {{name: {_write(name)}, {source}{acting}}}\n")
    return {"runs": "".join(lines), "baseline": _write(baseline)}


def _find_speeds(runs: Mapping[str, tuple[Path, str | None]], column: str, rpm: float) -> str:
    """The range that all have, in the usual step of the first; the file's unit is so many ``rpm``."""
    tables = [read_table(path, {column: "number"}, text=PLAIN.on(sheet)) for path, sheet in runs.values()]
    every = [rpm * np.unique(table[column]) for table in tables]
    start, stop = max(float(speeds[0]) for speeds in every), min(float(speeds[-1]) for speeds in every)
    step = float(np.median(np.diff(every[0]))) if len(every[0]) > 1 else 1.0
    return f"{{start_rpm: {start:g}, stop_rpm: {stop:g}, step_rpm: {step:g}}}"
