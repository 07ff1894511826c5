"""Single mistakes that would explain readings which a fit does not: each is tried by a quick fit.

A person who sets up a measurement makes one mistake more often than two: a probe the wrong way round, a weight in the
other plane, two runs exchanged. The readings are changed back, or a weight moved back, and fitted again; the mistake
that leaves least over is named where it leaves far less than the readings as they are.

Legend: S speeds, P channels, R runs.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace

import numpy as np

from pipeline.data.dataset import name_direction, project_direction
from pipeline.problem.measurement import Measurement
from pipeline.trust.mistake import Mistake
from pipeline.trust.mistakes_of_probes import of_all_readings, of_probes
from pipeline.trust.mistakes_of_runs import of_rest, of_runs, of_weights
from pipeline.trust.quick_fit import QuickFit, quick_fit

MOST_SPEEDS = 40
_TERMS = 5
WORTH_TRYING = 2.0
"""Mean square over the noise below which the readings are explained well enough."""
FALLS_BY = 3.0
"""So many times less must a mistake leave over."""
_AS_GOOD = 1.5
"""Mistakes that leave so many times as much as the best one are named beside it."""
_MOST_NAMED = 3


@dataclass(frozen=True)
class Found:
    """A mistake that explains the readings."""

    sentence: str
    check: str
    falls_by: float  # mean square without the mistake over that with it, inverted
    gross: bool
    single: bool = False  # of one run, weight or probe


@dataclass(frozen=True)
class Probe:
    """A probe as it stands in the machine, which the channels may be made of."""

    name: str
    node: int
    angle: float  # degrees


def find_mistakes(
    measurement: Measurement, values: np.ndarray, constant: bool = False, probes: Sequence[Probe] = ()
) -> list[Found]:
    """The mistakes that explain the readings far better than none; the best first, empty where all is well.

    Args:
        measurement: at the stated model, all readings.
        values: (M, S, U) unknowns that the fit found.
        constant: whether they are the same at all speeds.
        probes: those that the channels x and y were made of; none where channels are probes.
    """
    as_probes = _as_probes(measurement, probes)
    names = [probe.name for probe in probes] or [_call(*channel) for channel in as_probes.dataset.channels]
    base = _Trial(as_probes, values, MOST_SPEEDS, 1 if constant else _TERMS).fit(None)
    if base.mean_square < WORTH_TRYING:
        return []
    first = _Trial(as_probes, values, _FIRST_SPEEDS, 1 if constant else _FIRST_TERMS)
    screened = sorted(
        (first.fit(mistake, _FIRST_ROUNDS).mean_square, i) for i, mistake in enumerate(list_mistakes(first.part, names))
    )
    kept = {i for _, i in screened[:_REFINED]}
    trial = _Trial(as_probes, values, MOST_SPEEDS, 1 if constant else _TERMS)
    tried = [(mistake, trial.fit(mistake)) for i, mistake in enumerate(list_mistakes(trial.part, names)) if i in kept]
    tried.sort(key=lambda pair: pair[1].mean_square * (1.0 if pair[0].extra is None else _LEAVES_FREE))
    best = min(fit.mean_square for _, fit in tried)
    return [
        Found(
            mistake.sentence + _describe_extra(mistake, fit),
            mistake.check,
            base.mean_square / fit.mean_square,
            mistake.gross or _is_gross(mistake, fit),
            mistake.single,
        )
        for mistake, fit in tried[:_MOST_NAMED]
        if fit.mean_square < base.mean_square / FALLS_BY and fit.mean_square < _AS_GOOD * best
    ]


_LEAVES_FREE = 1.2
"""A mistake without a free number is named before one with, where they leave about as much."""


def list_mistakes(measurement: Measurement, names: Sequence[str]) -> Iterator[Mistake]:
    """Every mistake that is tried; ``names`` are the channels'."""
    yield from of_all_readings(measurement)
    for mistakes in (of_probes(measurement, names), of_runs(measurement), of_weights(measurement)):
        yield from (replace(mistake, single=True) for mistake in mistakes)
    yield from of_rest(measurement)


_FIRST_SPEEDS, _FIRST_TERMS, _FIRST_ROUNDS, _REFINED = 16, 3, 6, 8
"""All mistakes are tried on few speeds first, then the best of them on more."""


class _Trial:
    """Quick fits of the same readings, changed by one mistake after the other."""

    def __init__(self, measurement: Measurement, values: np.ndarray, most_speeds: int, terms: int) -> None:
        count = len(measurement.dataset.speeds)
        keep = np.unique(np.linspace(0, count - 1, min(count, most_speeds)).round().astype(int))
        self.part, self.start, self.terms = measurement.select(keep), values[:, keep], min(terms, len(keep))
        self.best: QuickFit | None = None

    def fit(self, mistake: Mistake | None, rounds: int = 12) -> QuickFit:
        """What the readings leave over without the mistake, its penalty included."""
        if mistake is None:
            return quick_fit(self.part, self.start, self.terms)
        best = quick_fit(mistake.measurement, self.start, self.terms, mistake.extra, rounds)
        if mistake.extra is not None and self.best is not None:
            again = quick_fit(mistake.measurement, self.best.values, self.terms, mistake.extra, rounds)
            best = min(best, again, key=lambda fitted: fitted.mean_square)
        best = replace(best, mean_square=best.mean_square * mistake.penalty)
        if self.best is None or best.mean_square < self.best.mean_square:
            self.best = best
        return best


_SMALL = 0.3
"""Share by which a scale or a weight may be off without anything being mistaken for another."""


def _is_gross(mistake: Mistake, fit: QuickFit) -> bool:
    return len(fit.extra) == 2 and abs(complex(*fit.extra)) > _SMALL


def _describe_extra(mistake: Mistake, fit: QuickFit) -> str:
    """The gain that the fit found."""
    if len(fit.extra) != 2:
        return ""
    gain = 1 + complex(*fit.extra)
    return f" ({abs(gain):.3g} times as large, turned by {np.degrees(np.angle(gain)):.0f} deg)"


def _call(node: int, angle: float) -> str:
    return f"node {node} {name_direction(angle)}"


def _as_probes(measurement: Measurement, probes: Sequence[Probe]) -> Measurement:
    """The measurement with a channel for each probe, in place of x and y that were made of them."""
    if not probes:
        return measurement
    data, rows = measurement.dataset, []
    for probe in probes:
        row = np.zeros(len(data.channels))
        for direction, cosine in zip((0.0, 90.0), project_direction(probe.angle % 360.0), strict=True):
            row[data.channels.index((probe.node, direction))] = cosine
        rows.append(row)
    matrix = np.array(rows)

    def seen(values: np.ndarray) -> np.ndarray:
        return np.einsum("pc,scr->spr", matrix, values)

    return replace(
        measurement,
        dataset=replace(
            data,
            channels=tuple((probe.node, probe.angle % 360.0) for probe in probes),
            displacement=seen(data.displacement),
            subtracted=None if data.subtracted is None else seen(data.subtracted),
        ),
        parameters=(),
        values=(),
    )
