"""The table of what was measured, with the machine and the date."""

from __future__ import annotations

import os
import platform
import statistics
import textwrap
from collections.abc import Sequence
from datetime import UTC, datetime
from importlib.metadata import version
from pathlib import Path

from benchmarks.measure import Benchmark, Measured

_WIDTH = 100
_HEADER = ["benchmark", "ratio", "smallest to largest", "aim", "met", "ours", "peer"]
_VERSIONS = ["torch", "numpy", "scipy", "ross-rotordynamics", "mlflow", "optuna"]


def row(measured: Measured) -> list[str]:
    """A line of the table."""
    ratios = measured.ratios
    return [
        measured.benchmark.name,
        f"{measured.median:.3g}",
        f"{min(ratios):.3g} to {max(ratios):.3g}",
        str(measured.benchmark.aim),
        "yes" if measured.met else "no",
        _time(statistics.median(measured.times.ours)),
        _time(statistics.median(measured.times.peer)),
    ]


def _time(seconds: float) -> str:
    return f"{seconds:.2f} s" if seconds >= 0.1 else f"{1e3 * seconds:.2f} ms"


def surroundings(load: float) -> str:
    """Machine, date, versions, and whether it was quiet when the measurement began (``load`` of the last minute)."""
    cores = len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count()
    quiet = "the machine was quiet" if load < _QUIET else "other programs ran beside it, and the spread shows it"
    versions = ", ".join(f"{name} {version(name)}" for name in _VERSIONS)
    return (
        f"Measured on {datetime.now(UTC):%Y-%m-%d} on {_processor()}, {cores} cores, {platform.system()}, Python "
        f"{platform.python_version()}, {versions}. Load of the machine when it began: {load:.1f}; {quiet}."
    )


_QUIET = 0.5


def _processor() -> str:
    """Its model, where the system tells it."""
    try:
        lines = Path("/proc/cpuinfo").read_text(encoding="utf-8").splitlines()
    except OSError:
        lines = []
    names = [line.partition(":")[2].strip() for line in lines if line.startswith("model name")]
    return names[0] if names else platform.processor() or platform.machine()


def markdown(results: Sequence[Measured], failed: Sequence[tuple[Benchmark, str]], load: float) -> str:
    """The whole page."""
    parts = ["# Benchmarks", *map(_wrapped, [*_INTRODUCTION, surroundings(load)])]
    parts.append(_table([row(result) for result in results]))
    if failed:
        parts.append("\n".join(_item(f"`{one.name}` could not be measured: {why}") for one, why in failed))
    parts.append("What is compared with what:")
    parts.append(
        "\n".join(_item(f"`{r.benchmark.name}`: {r.benchmark.ours}; peer: {r.benchmark.peer}.") for r in results)
    )
    return "\n\n".join(parts) + "\n"


_INTRODUCTION = [
    "`make bench` writes this page. No time on it is a threshold of `check` or of a test: times differ from machine to "
    "machine and from hour to hour.",
    "Each ratio compares two sides that are measured in turns in one process (commands from the shell: in turns, each "
    "in a process of its own), several times. The table has the median of the ratios, the smallest and the largest, "
    "and the median time of both sides. An aim `at most` is of our time over the peer's; `at least` is how many times "
    "as fast as the peer; `below` is of our time alone.",
    "hsbalance 0.5.5 (influence coefficients) is no peer: it resolves beside our packages, but brings ten more, among "
    "them the commercial solver Xpress, for one small least-squares problem.",
]


def _wrapped(text: str) -> str:
    return textwrap.fill(text, _WIDTH, break_on_hyphens=False)


def _item(text: str) -> str:
    return textwrap.fill(text, _WIDTH, initial_indent="- ", subsequent_indent="  ", break_on_hyphens=False)


def _table(rows: Sequence[Sequence[str]]) -> str:
    lines = ["| " + " | ".join(_HEADER) + " |", "|---|" + "---:|" * (len(_HEADER) - 1)]
    return "\n".join([*lines, *("| " + " | ".join(cells) + " |" for cells in rows)])
