"""Lines, tables and progress on the terminal."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from functools import cache
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from rich.console import Console

    from pipeline.comparison.result import Result
    from pipeline.identification.training import Progress

StudyProgress = Callable[[int, "float | None"], None]
"""(trials done, best loss so far)."""


@cache
def _console(stderr: bool) -> Console:
    from rich.console import Console

    console = Console(stderr=stderr, highlight=False, soft_wrap=True)
    if not console.is_terminal:
        console.width = 200  # a pipe or a log has no width to fit tables to
    return console


def say(text: str) -> None:
    """A line of result on stdout."""
    _console(False).print(text, markup=False)


def warn(text: str) -> None:
    """A line that needs attention, on stderr."""
    _console(True).print(f"warning: {text}", markup=False, style="yellow")


def table(title: str, header: Sequence[str], rows: Sequence[Sequence[str]]) -> None:
    """A table on stdout; the first column is left-aligned, the others right."""
    from rich import box
    from rich.table import Table

    drawn = Table(title=title, title_justify="left", box=box.SIMPLE_HEAD)
    for i, name in enumerate(header):
        drawn.add_column(name, justify="left" if i == 0 else "right", no_wrap=True)
    for row in rows:
        drawn.add_row(*row)
    _console(False).print(drawn, markup=False, crop=False)


@contextmanager
def training_progress(name: str) -> Iterator[Progress]:
    """A bar with the loss and the rate, on a terminal; nothing elsewhere."""
    from rich.progress import BarColumn, MofNCompleteColumn, TextColumn, TimeElapsedColumn
    from rich.progress import Progress as ProgressBar

    columns = (
        TextColumn("{task.description}"),
        BarColumn(),
        MofNCompleteColumn(),
        TextColumn("loss {task.fields[loss]}"),
        TextColumn("{task.fields[rate]}"),
        TimeElapsedColumn(),
    )
    console = _console(True)
    with ProgressBar(*columns, console=console, transient=True, disable=not console.is_terminal) as bar:
        task = bar.add_task(name, total=None, loss="", rate="")

        def update(phase: str, step: int, total: int, loss: float) -> None:
            """Move the bar; the rate is rich's."""
            speed = bar.tasks[0].speed
            rate = f"{speed:.0f} steps/s" if speed else ""
            bar.update(
                task,
                description=f"{name} {phase}",
                completed=step,
                total=total,
                loss=f"{loss:.3g}",
                rate=rate,
            )

        yield update


@contextmanager
def study_progress(name: str, total: int) -> Iterator[StudyProgress]:
    """One bar for a study, with its best value so far and the time left, on a terminal; nothing elsewhere."""
    from rich.progress import BarColumn, MofNCompleteColumn, TextColumn, TimeRemainingColumn
    from rich.progress import Progress as ProgressBar

    columns = (
        TextColumn("{task.description}"),
        BarColumn(),
        MofNCompleteColumn(),
        TextColumn("trials, best held-out loss {task.fields[best]}, left:"),
        TimeRemainingColumn(elapsed_when_finished=True),
    )
    console = _console(True)
    bar = ProgressBar(
        *columns, console=console, transient=True, disable=not console.is_terminal, speed_estimate_period=3600
    )
    with bar:
        task = bar.add_task(name, total=total, best="-")

        def update(done: int, best: float | None) -> None:
            bar.update(task, completed=done, best="-" if best is None else f"{best:.3g}")

        yield update


@contextmanager
def comparison_progress(name: str, total: int) -> Iterator[Callable[[int, int, Result], None]]:
    """One bar for a comparison, with the newest result and the time left, on a terminal; nothing elsewhere."""
    from rich.progress import BarColumn, MofNCompleteColumn, TextColumn, TimeRemainingColumn
    from rich.progress import Progress as ProgressBar

    columns = (
        TextColumn("{task.description}"),
        BarColumn(),
        MofNCompleteColumn(),
        TextColumn("{task.fields[newest]} left:"),
        TimeRemainingColumn(elapsed_when_finished=True),
    )
    console = _console(True)
    with ProgressBar(*columns, console=console, transient=True, disable=not console.is_terminal) as bar:
        task = bar.add_task(name, total=total, newest="")

        def update(done: int, of: int, result: Result) -> None:
            """Move the bar."""
            newest = f"{result.method}, {result.sensors}, {100 * result.noise:g} % in {result.seconds:.1f} s,"
            bar.update(task, completed=done, total=of, newest=newest)

        yield update
