"""What a command asks about an experiment, and what its stages have made of it so far, each thing once."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field, replace
from functools import wraps
from pathlib import Path
from typing import Any, TypeVar

from pipeline.config.schema import Config
from pipeline.reporting.console import say
from pipeline.stages.workspace import Workspace, locate_files

_T = TypeVar("_T")


@dataclass(frozen=True, eq=False)
class Analysis:
    """A configuration, and what :func:`made_once` keeps: measurement, diagnosis, answer, twin, judgement."""

    config: Config
    made: dict[str, tuple[Any, Any]] = field(default_factory=dict)

    @property
    def files(self) -> Workspace:
        """The experiment's files, which may not be there yet."""
        return locate_files(self.config)

    def at(self, config: Config) -> Analysis:
        """That of another stage; what was made is kept where nothing else of the configuration differs."""
        alike = config.model_copy(update={"stage": self.config.stage}) == self.config
        return replace(self, config=config) if alike else Analysis(config)

    def run(self, stage: str) -> None:
        """Run another stage of the same experiment, and record it."""
        from pipeline.stages.execution import execute

        execute(self.at(self.config.model_copy(update={"stage": stage})))

    def require(self, stage: str, *needed: Path, behind: Path | None = None) -> None:
        """Run ``stage`` first if one of the files that it makes is missing, or older than the file ``behind`` it, and
        say so."""
        stale = [path for path in needed if not path.exists() or (behind and is_older(path, behind))]
        if stale:
            also = f", or older than '{behind}'" if behind else ""
            say(f"'{stale[0]}' is missing{also}: running stage={stage} first")
            self.run(stage)


def is_older(path: Path, source: Path) -> bool:
    """Whether a file is older than its source; not where one of them is missing."""
    return path.exists() and source.exists() and path.stat().st_mtime < source.stat().st_mtime


def made_once(*sources: str) -> Callable[[Callable[[Analysis], _T]], Callable[[Analysis], _T]]:
    """What the function makes is kept by the analysis until one of the ``sources`` is written again: names of files of
    :class:`~pipeline.stages.workspace.Workspace`."""

    def decorate(make: Callable[[Analysis], _T]) -> Callable[[Analysis], _T]:
        @wraps(make)
        def look_up(analysis: Analysis) -> _T:
            paths = [getattr(analysis.files, name) for name in sources]
            marks, value = analysis.made.get(make.__name__, (None, None))
            if marks != list(map(_mark, paths)):
                value = make(analysis)  # which may write the sources first
                analysis.made[make.__name__] = list(map(_mark, paths)), value
            return value

        return look_up

    return decorate


def _mark(path: Path) -> tuple[int, int, int]:
    """Tells a file from the one that was there before; zeros where there is none."""
    if not path.exists():
        return 0, 0, 0
    about = path.stat()
    return about.st_ino, about.st_size, about.st_mtime_ns
