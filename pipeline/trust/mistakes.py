"""Single mistakes that would explain readings which a fit does not: each is tried by a fit in a tenth of a second.

A mistake in a measurement is mostly a single one: a probe the wrong way round, a weight in the other plane, two runs
exchanged. The readings are changed back, or a weight is moved back, and they are fitted again. The mistake that leaves
the least residual is named if that is far below the residual of the readings as they are.

The coefficients of a quick fit are few Chebyshev terms in the logarithm of the speed, direct ones their exponential;
the start is linear least squares, which no wrong guess misleads, and SciPy's least squares does the rest. Beside them
are numbers that an explanation leaves free, such as the size of one run's weight.

Legend: S speeds, P channels, R runs, A active unknowns, K functions, E free numbers. SI units.
"""

from __future__ import annotations

import contextlib
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np

from pipeline.coefficients import is_direct
from pipeline.data.operating import space_evenly
from pipeline.data.sensors import project
from pipeline.errors import IdentifiabilityError
from pipeline.identification.inputs import evaluate_functions
from pipeline.identification.linear_start import linear_start
from pipeline.problem.measurement import Measurement
from pipeline.problem.slopes import ReadingSlopes, stack_rows
from pipeline.trust.mistake import NOTHING_FREE, Free, Mistake, list_mistakes
from pipeline.unknowns import outputs_of, scale_outputs
from pipeline.write_numbers import write_number

WORTH_TRYING = 2.0
"""Mean square over the noise below which the readings are explained well enough."""


def find_mistakes(
    measurement: Measurement,
    values: np.ndarray,
    constant: bool = False,
    probes: Mapping[str, tuple[int, float]] | None = None,
    *,
    first: tuple[int, int] = (16, 3),
    last: tuple[int, int] = (40, 5),
    refined: int = 8,
    falls_by: float = 3.0,
    as_good: float = 1.5,
    most_named: int = 3,
    gross: float = 0.3,
    frees: float = 1.2,
) -> list[Mistake]:
    """The mistakes that explain the readings far better than none; the best first, empty where all is well.

    Args:
        measurement: at the stated model, all readings.
        values: (M, S, U) unknowns that the fit found.
        constant: whether they are the same at all speeds.
        probes: name -> node and degrees of those that the channels x and y were made of; None where channels are
            probes.
        first: at how many speeds, and with how many terms of each coefficient, all mistakes are tried; ``refined`` of
            them then as ``last`` says.
        falls_by: so many times less must a mistake leave over.
        as_good: mistakes that leave so many times as much as the best one are named beside it, ``most_named`` of them.
        gross: a scale or a weight that is off by more than this share is mistaken for another.
        frees: a mistake without a free number is named before one with, where they leave as much but for this factor.
    """
    if probes:  # a channel for each of them, in place of x and y
        data, channels = measurement.dataset, tuple((node, angle % 360.0) for node, angle in probes.values())
        taken = data.subtracted
        if taken is not None:
            taken = project(replace(data, displacement=taken), channels).displacement
        dataset = replace(project(data, channels), subtracted=taken)
        measurement = replace(measurement, dataset=dataset, parameters=())
    names, count = [*(probes or measurement.dataset.channel_names)], len(measurement.dataset.speeds)
    thinned = []
    for speeds, terms in (first, last):
        keep = space_evenly(count, speeds)
        thinned.append((measurement.select(keep), values[:, keep], 1 if constant else min(terms, len(keep))))
    (part, start, terms), screened = thinned[1], thinned[0][0]
    base = quick_fit(part, [start], terms)
    if base.mean_square < WORTH_TRYING:
        return []
    squares = [fit.mean_square for _, fit in _try(list_mistakes(screened, names), *thinned[0][1:])]
    kept = set(sorted(range(len(squares)), key=lambda i: (squares[i], i))[:refined])
    tried = _try((mistake for i, mistake in enumerate(list_mistakes(part, names)) if i in kept), start, terms)
    tried.sort(key=lambda trial: trial[1].mean_square * (frees if len(trial[0].free) else 1.0))
    named, best = [], min(fit.mean_square for _, fit in tried)
    for mistake, fit in tried[:most_named]:
        if fit.mean_square < base.mean_square / falls_by and fit.mean_square < as_good * best:
            sentence, far = mistake.sentence, mistake.gross
            if len(fit.free) == 2:  # the gain that the fit found
                gain = 1 + complex(*fit.free)
                turned = f"turned by {np.degrees(np.angle(gain)):.0f} deg"
                sentence += f" ({write_number(abs(gain), digits=3)} times as large, {turned})"
                far = far or abs(gain - 1) > gross
            named.append(replace(mistake, sentence=sentence, gross=far, falls_by=base.mean_square / fit.mean_square))
    return named


def _try(mistakes: Iterable[Mistake], start: np.ndarray, terms: int) -> list[tuple[Mistake, QuickFit]]:
    """What the readings leave over without each mistake, its penalty included; from the best one so far, too."""
    tried: list[tuple[Mistake, QuickFit]] = []
    for mistake in mistakes:
        begins = [start]
        if len(mistake.free) and tried:
            begins.append(min((fit for _, fit in tried), key=lambda fit: fit.mean_square).values)
        fit = quick_fit(mistake.measurement, begins, terms, mistake.free)
        tried.append((mistake, replace(fit, mean_square=fit.mean_square * mistake.penalty)))
    return tried


# --- a fit in a tenth of a second ----------------------------------------------------------------------


@dataclass(frozen=True, eq=False)
class QuickFit:
    """The end of a quick fit."""

    mean_square: float  # of what it leaves over, over the noise
    values: np.ndarray  # (M, S, U) unknowns
    free: np.ndarray  # (E,)


def quick_fit(
    measurement: Measurement,
    starts: Sequence[np.ndarray],
    terms: int,
    free: Free = NOTHING_FREE,
    rounds: int = 20,
    still: float = 1e-3,
    ran_away: float = 1e4,
) -> QuickFit:
    """Fit the unknowns to the readings, from the best of ``starts`` and of a linear one, where the probes allow it.

    The fit ends where a step lowers the squares by a share below ``still``, or after so many ``rounds``.

    Args:
        starts: (M, S, U) unknowns to begin with as well, N/m and N s/m; the guess takes the place of those that
            ``ran_away``, by so many times its size, in a fit of wrong readings.
        terms: K; 1 for constants.
        free: what else is sought.
    """
    from scipy.optimize import least_squares

    place, guess = np.log(measurement.dataset.speeds), measurement.guess.sizes(measurement.unknowns)
    span = place[-1] - place[0]
    scaled = 2 * (place - place[0]) / span - 1 if span > 0 else np.zeros(len(place))
    functions = np.column_stack(  # (S, K)
        [np.ones(len(place)), evaluate_functions("chebyshev", min(terms, len(place)) - 1, scaled)]
    )
    begins, sizes = [], []
    for start in starts:
        size = np.median(np.abs(start), axis=1)
        fine = (size < ran_away * guess) & (size > guess / ran_away)
        begins.append(np.where(fine[:, None], start, guess[:, None]))
        sizes.append(np.where(fine, size, guess))
    members = np.broadcast_to(functions, (len(begins[0]), *functions.shape))
    with contextlib.suppress(np.linalg.LinAlgError, IdentifiabilityError):
        linear = linear_start(measurement, members, sizes[0])
        begins += [linear] if linear is not None and np.isfinite(linear).all() else []
    problem = _Problem(measurement, sizes[0], functions, free)
    begin = min(
        map(problem.weights_of, begins),
        key=lambda weights: np.nan_to_num((problem.rows(weights) ** 2).sum(), nan=np.inf),
    )
    end = least_squares(problem.rows, begin, problem.jacobian, x_scale="jac", ftol=still, max_nfev=rounds)
    square, count = 2 * end.cost, measurement.dataset.displacement.size
    return QuickFit(square / count, problem.table(end.x)[0], end.x[len(end.x) - len(free) :])


class _Problem:
    """Residuals over the noise, and their derivative by the weights: A K, and E free numbers.

    A direct coefficient is held above ``least``, as a share of its size, and its logarithm within ``widest``.
    """

    least, widest = 1e-3, 12.0

    def __init__(self, measurement: Measurement, scale: np.ndarray, functions: np.ndarray, free: Free) -> None:
        self.measurement, self.functions, self.free = measurement, functions, free
        active = measurement.unknowns.active
        self.scale = np.array([scale[m, u] for m, u in active])
        self.positive = np.array([is_direct(measurement.unknowns.names[u]) for _, u in active])

    def weights_of(self, values: np.ndarray) -> np.ndarray:
        """(A K + E,) nearest to unknowns (M, S, U)."""
        raw = outputs_of(self.measurement.unknowns.to_active(values), self.scale, self.positive, self.least)
        solution = np.linalg.lstsq(self.functions, raw, rcond=None)[0].T
        return np.concatenate([solution.ravel(), np.zeros(len(self.free))])

    def table(self, weights: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """(M, S, U) unknowns, and (S, A) the slopes of the active ones by the raw outputs."""
        raw = self.functions @ weights[: len(weights) - len(self.free)].reshape(len(self.scale), -1).T
        held = np.where(self.positive, np.clip(raw, -self.widest, self.widest), raw)
        values, slope = scale_outputs(held, self.scale, self.positive)
        return self.measurement.unknowns.from_active(values), slope

    def rows(self, weights: np.ndarray) -> np.ndarray:
        """(2 S P R,) predicted less measured readings."""
        data, numbers = self.measurement, weights[len(weights) - len(self.free) :]
        predicted = data.response.predict(data.table(self.table(weights)[0]))
        expected = predicted + (predicted[..., None] * self.free.shares + self.free.shown) @ numbers
        return stack_rows((expected - data.dataset.displacement) / data.deviation).ravel()

    def jacobian(self, weights: np.ndarray) -> np.ndarray:
        """(2 S P R, A K + E)."""
        data, numbers = self.measurement, weights[len(weights) - len(self.free) :]
        values, slope = self.table(weights)
        bearings, gain = data.table(values), 1 + self.free.shares @ numbers
        by_unknown = ReadingSlopes(data, bearings).by_unknown * slope[:, None, None] * gain[..., None]
        by_weight = np.einsum("spra,sk->sprak", by_unknown, self.functions).reshape(*by_unknown.shape[:3], -1)
        by_number = self.free.shown + self.free.shares * (
            data.response.predict(bearings)[..., None] if len(self.free) else 0.0
        )
        columns = np.concatenate([by_weight, by_number / data.deviation[..., None]], axis=-1)
        return stack_rows(columns).reshape(-1, len(weights))
