"""What a benchmark is: times of two sides that take turns, and the ratio that is aimed at."""

from __future__ import annotations

import statistics
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field

Action = Callable[[], object]


@dataclass(frozen=True)
class Times:
    """Seconds of both sides, turn by turn. ``scale`` makes unlike amounts of work alike."""

    ours: Sequence[float]
    peer: Sequence[float]
    scale: float = 1.0

    @property
    def ratios(self) -> list[float]:
        """Ours over the peer's, times the scale, in each turn."""
        return [self.scale * ours / peer for ours, peer in zip(self.ours, self.peer, strict=True)]


@dataclass(frozen=True)
class Aim:
    """What is aimed at; it is printed beside what was measured, and never fails."""

    limit: float
    kind: str = "at most"  # or "at least" (times as fast as the peer), or "below", in seconds

    def __str__(self) -> str:
        if self.kind == "below":
            return f"below {self.limit:g} s"
        return f"{self.kind} {self.limit:g}"


@dataclass(frozen=True)
class Benchmark:
    """A named comparison."""

    name: str
    ours: str
    peer: str
    aim: Aim
    run: Callable[[], Times]


@dataclass(frozen=True)
class Measured:
    """The outcome of a benchmark."""

    benchmark: Benchmark
    times: Times

    @property
    def ratios(self) -> list[float]:
        """As the aim has them: ours over the peer's, or how many times as fast."""
        upside_down = self.benchmark.aim.kind == "at least"
        return [1.0 / ratio for ratio in self.times.ratios] if upside_down else self.times.ratios

    @property
    def median(self) -> float:
        """The median ratio."""
        return statistics.median(self.ratios)

    @property
    def met(self) -> bool:
        """Whether the median is as aimed at."""
        aim = self.benchmark.aim
        if aim.kind == "below":
            return statistics.median(self.times.ours) < aim.limit
        return self.median >= aim.limit if aim.kind == "at least" else self.median <= aim.limit


@dataclass(frozen=True)
class Registry:
    """Benchmarks by name, in the order in which they are written down."""

    found: dict[str, Benchmark] = field(default_factory=dict)

    def add(self, name: str, ours: str, peer: str, aim: Aim) -> Callable[[Callable[[], Times]], Callable[[], Times]]:
        """A decorator of a function that measures both sides."""

        def register(run: Callable[[], Times]) -> Callable[[], Times]:
            self.found[name] = Benchmark(name, ours, peer, aim, run)
            return run

        return register


def seconds(action: Action) -> float:
    """How long it takes, once."""
    start = time.perf_counter()
    action()
    return time.perf_counter() - start


def in_turns(ours: Action, peer: Action, turns: int, inner: int = 1) -> Times:
    """Both sides ``turns`` times, one after the other: what slows the machine for a while slows both.

    Each turn is the least of ``inner`` runs: another program only ever makes a time longer.
    """
    pairs = [[min(seconds(action) for _ in range(inner)) for action in (ours, peer)] for _ in range(turns)]
    return Times([pair[0] for pair in pairs], [pair[1] for pair in pairs])


BENCHMARKS = Registry()
