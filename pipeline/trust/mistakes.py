"""Single mistakes that would explain readings which a fit does not: each is tried by a quick fit.

A mistake in a measurement is mostly a single one: a probe the wrong way round, a weight in the other plane, two runs
exchanged. The readings are changed back, or a weight is moved back, and they are fitted again. The mistake that leaves
the least residual is named if that is far below the residual of the readings as they are.

Legend: S speeds, P channels, R runs.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from pipeline.data.sensors import project
from pipeline.problem.measurement import Measurement
from pipeline.trust.linearised import name_channels
from pipeline.trust.mistake import Mistake, list_mistakes
from pipeline.trust.quick_fit import QuickFit, quick_fit

WORTH_TRYING = 2.0
"""Mean square over the noise below which the readings are explained well enough."""


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


@dataclass(frozen=True)
class Depth:
    """How closely mistakes are tried."""

    speeds: int
    terms: int  # of each coefficient's function of the speed


def find_mistakes(
    measurement: Measurement,
    values: np.ndarray,
    constant: bool = False,
    probes: Sequence[Probe] = (),
    *,
    first: Depth = Depth(16, 3),
    last: Depth = Depth(40, 5),
    refined: int = 8,
    falls_by: float = 3.0,
    as_good: float = 1.5,
    most_named: int = 3,
    gross: float = 0.3,
) -> list[Found]:
    """The mistakes that explain the readings far better than none; the best first, empty where all is well.

    Args:
        measurement: at the stated model, all readings.
        values: (M, S, U) unknowns that the fit found.
        constant: whether they are the same at all speeds.
        probes: those that the channels x and y were made of; none where channels are probes.
        first: how closely all mistakes are tried; ``refined`` of them then to the depth ``last``.
        falls_by: so many times less must a mistake leave over.
        as_good: mistakes that leave so many times as much as the best one are named beside it, ``most_named`` of them.
        gross: a scale or a weight that is off by more than this share is mistaken for another.
    """
    as_probes = _as_probes(measurement, probes)
    names = [probe.name for probe in probes] or name_channels(as_probes)
    if constant:
        first, last = replace(first, terms=1), replace(last, terms=1)
    base = _Trial(as_probes, values, last).fit_as_stated()
    if base.mean_square < WORTH_TRYING:
        return []
    screen, trial = _Trial(as_probes, values, first), _Trial(as_probes, values, last)
    squares = [screen.fit(mistake).mean_square for mistake in list_mistakes(screen.part, names)]
    kept = set(sorted(range(len(squares)), key=lambda i: (squares[i], i))[:refined])
    tried = [(mistake, trial.fit(mistake)) for i, mistake in enumerate(list_mistakes(trial.part, names)) if i in kept]
    tried.sort(key=_order)
    best = min(fit.mean_square for _, fit in tried)
    return [
        Found(
            mistake.sentence + _describe_extra(fit),
            mistake.check,
            base.mean_square / fit.mean_square,
            mistake.gross or (len(fit.free) == 2 and abs(complex(*fit.free)) > gross),
            mistake.single,
        )
        for mistake, fit in tried[:most_named]
        if fit.mean_square < base.mean_square / falls_by and fit.mean_square < as_good * best
    ]


def _order(trial: tuple[Mistake, QuickFit], frees: float = 1.2) -> float:
    """A mistake without a free number is named before one with, where they leave about as much."""
    mistake, fit = trial
    return fit.mean_square * (frees if mistake.free else 1.0)


class _Trial:
    """Quick fits of the same readings, changed by one mistake after the other."""

    def __init__(self, measurement: Measurement, values: np.ndarray, depth: Depth) -> None:
        count = len(measurement.dataset.speeds)
        keep = np.unique(np.linspace(0, count - 1, min(count, depth.speeds)).round().astype(int))
        self.part, self.start = measurement.select(keep), values[:, keep]
        self.terms = min(depth.terms, len(keep))
        self.fits: list[QuickFit] = []

    def fit_as_stated(self) -> QuickFit:
        """What the readings leave over as they are."""
        return quick_fit(self.part, [self.start], self.terms)

    def fit(self, mistake: Mistake) -> QuickFit:
        """What the readings leave over without the mistake, its penalty included; from the best one, too."""
        begins = [self.start]
        if mistake.free and self.fits:
            begins.append(min(self.fits, key=lambda fitted: fitted.mean_square).values)
        best = quick_fit(mistake.measurement, begins, self.terms, mistake.free)
        self.fits.append(replace(best, mean_square=best.mean_square * mistake.penalty))
        return self.fits[-1]


def _describe_extra(fit: QuickFit) -> str:
    """The gain that the fit found."""
    if len(fit.free) != 2:
        return ""
    gain = 1 + complex(*fit.free)
    return f" ({abs(gain):.3g} times as large, turned by {np.degrees(np.angle(gain)):.0f} deg)"


def _as_probes(measurement: Measurement, probes: Sequence[Probe]) -> Measurement:
    """The measurement with a channel for each probe, in place of x and y that were made of them."""
    if not probes:
        return measurement
    data, channels = measurement.dataset, tuple((probe.node, probe.angle % 360.0) for probe in probes)
    taken = data.subtracted
    if taken is not None:
        taken = project(replace(data, displacement=taken), channels).displacement
    dataset = replace(project(data, channels), subtracted=taken)
    return replace(measurement, dataset=dataset, parameters=(), values=())
