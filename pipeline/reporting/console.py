"""Lines, tables and progress on the terminal, and its steps in a file."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager, suppress
from functools import cache
from pathlib import Path
from typing import TYPE_CHECKING

from pipeline.reporting.blocks import Cell
from pipeline.write_numbers import write_number

if TYPE_CHECKING:
    from rich.console import Console
    from rich.progress import Progress as ProgressBar
    from rich.progress import TaskID

    from pipeline.identification.training import Progress


@cache
def _open_console(stderr: bool) -> Console:
    from rich.console import Console

    console = Console(stderr=stderr, highlight=False, soft_wrap=True)
    if not console.is_terminal:
        console.width = 200  # a pipe or a log has no width to fit tables to
    return console


def say(text: str) -> None:
    """Print a line of result on stdout."""
    _open_console(False).print(text, markup=False)


def warn(text: str) -> None:
    """Print a line that needs attention on stderr."""
    _open_console(True).print(f"warning: {text}", markup=False, style="yellow")


def table(title: str, header: Sequence[str], rows: Sequence[Sequence[Cell]]) -> None:
    """Print a table on stdout, unless it has no rows; the first column is left-aligned, the others right.

    A column of long sentences is wrapped where there is no room: it takes none from the others.
    """
    from rich import box
    from rich.table import Table

    drawn = Table(title=title, title_justify="left", box=box.SIMPLE_HEAD)
    for i, name in enumerate(header):
        short = all(len(str(row[i])) <= 100 for row in rows)
        drawn.add_column(name, justify="right" if i and short else "left", no_wrap=short)
    for row in rows:
        drawn.add_row(*map(str, row))
    if rows:
        _open_console(False).print(drawn, markup=False, crop=False)


_LOGS: list[Path] = []
"""Where long steps write what they have done; the last one counts."""


@contextmanager
def log_steps(folder: Path) -> Iterator[None]:
    """Write each step of what has a bar into ``log.txt`` of the ``folder``, a line with its time; without any, none."""
    _LOGS.append(folder / "log.txt")
    try:
        yield
    finally:
        _LOGS.pop()


def _log(text: str) -> None:
    """Add a line. What can't be written, as on a full disk, is said of the results."""
    for path in _LOGS[-1:]:
        with suppress(OSError):
            path.parent.mkdir(parents=True, exist_ok=True)
            with path.open("a", encoding="utf-8") as file:
                file.write(f"{time.strftime('%Y-%m-%d %H:%M:%S')} {text}\n")


@contextmanager
def training_progress(name: str) -> Iterator[Progress]:
    """Show a bar with the loss and the rate of a training; of its steps the log has one a second, and the last."""
    due = 0.0
    with _show_bar(name, None) as (bar, task):

        def update(phase: str, step: int, total: int, loss: float) -> None:
            """As :data:`pipeline.identification.training.Progress`."""
            nonlocal due
            if time.monotonic() > due or step == total:
                due = time.monotonic() + 1.0
                _log(f"{name} {phase}: step {step} of {total}, loss {write_number(loss)}")
            rate = f"{bar.tasks[0].speed:.0f} steps/s" if bar.tasks[0].speed else ""
            bar.update(
                task,
                description=f"{name} {phase}",
                completed=step,
                total=total,
                words=f"loss {write_number(loss)} {rate}",
            )

        yield update


@contextmanager
def count_progress(name: str, total: int) -> Iterator[Callable[[int, str], None]]:
    """Show a bar for what is done one after another; it is given how many are done, and what they are in words."""
    with _show_bar(name, total) as (bar, task):

        def update(done: int, words: str) -> None:
            """So many are done."""
            _log(f"{name}: {done} of {total} {words}")
            bar.update(task, completed=done, words=f"{words}, left:")

        yield update


@contextmanager
def _show_bar(name: str, total: int | None) -> Iterator[tuple[ProgressBar, TaskID]]:
    """Show a bar on a terminal, and nothing elsewhere, with the time left, or the time taken without a total."""
    from rich import progress

    console = _open_console(True)
    bar = progress.Progress(
        progress.TextColumn("{task.description}"),
        progress.BarColumn(),
        progress.MofNCompleteColumn(),
        progress.TextColumn("{task.fields[words]}"),
        progress.TimeRemainingColumn(elapsed_when_finished=True) if total else progress.TimeElapsedColumn(),
        console=console,
        transient=True,
        disable=not console.is_terminal,
        speed_estimate_period=3600 if total else 30,
    )
    with bar:
        yield bar, bar.add_task(name, total=total, words="")
