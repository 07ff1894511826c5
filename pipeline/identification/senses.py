"""In which sense phases and angles count: all eight readings of a data set are fitted, and the data choose.

Three things are easily taken the wrong way round. Instruments give phase as lead or as lag; holes are numbered with
the rotation or against it; and the shaft turns from x to y, or from y to x, which mirrors the probes. Two of the eight
at a time are one machine. With the reflection ``S = diag(1, -1)`` of x and y, ``D* = -w^2 M + K - j w (C + W G)`` has

    S D* S = -w^2 M + S K S + j w (-S C S + W G),

since the gyroscopic matrix turns round under S. So a machine that is read wrongly in all three looks like itself,
mirrored, with damping and cross-coupled stiffness of the opposite sign (time reversed). Where damping must be positive
the phase that it makes decides between the two, if the readings are good enough; nothing else does.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from pipeline.coefficients import COEFFICIENTS
from pipeline.errors import ConfigError
from pipeline.identification.linear_start import start_at
from pipeline.identification.output_error_fit import HUBER, OutputErrorFit, fit_from
from pipeline.identification.output_error_start import prepare_output_error
from pipeline.identification.quality import FAR_FROM_EXPECTED
from pipeline.identification.training import FitSetup
from pipeline.problem.measurement import Measurement
from pipeline.problem.ranking import find_least, rank_indices

DECISIVE = 2.0 * math.log(20.0)
"""Chi-square by which one sense must be better: odds of twenty to one."""
_MIRRORED = np.array([-1.0 if name[1] != name[2] else 1.0 for name in COEFFICIENTS])


@dataclass(frozen=True)
class Sense:
    """How a data set is read, against how it is written."""

    lag: bool = False  # phases of the readings count the other way: they are conjugated
    against: bool = False  # angles of the weights count the other way: they change sign
    mirrored: bool = False  # the shaft turns from y to x: angles of the probes change sign

    @property
    def twin(self) -> Sense:
        """The one that is the same machine mirrored, but for the sign of damping and cross-coupled stiffness."""
        return Sense(not self.lag, not self.against, not self.mirrored)

    @property
    def words(self) -> str:
        """In words."""
        return (
            f"phases {'conjugated' if self.lag else 'as written'}, "
            f"angles of weights {'negated' if self.against else 'as written'}, "
            f"rotation {'from y to x' if self.mirrored else 'as written'}"
        )

    def read(self, measurement: Measurement) -> Measurement:
        """The measurement as this sense has it; the frame always turns from x to y."""
        data, known, drift = measurement.dataset, measurement.known, measurement.drift
        if self.lag:
            taken = data.subtracted if data.subtracted is None else data.subtracted.conj()
            data, drift = replace(data, displacement=data.displacement.conj(), subtracted=taken), drift.conjugated()
        if self.against:
            turned = tuple(replace(excitation, phase=-excitation.phase) for excitation in data.excitations)
            data = replace(data, excitations=turned)
        if self.mirrored:
            data = replace(data, channels=tuple((node, -angle % 360.0) for node, angle in data.channels))
            known = replace(known, values=known.values * _MIRRORED)
        return replace(measurement, dataset=data, known=known, drift=drift)


SENSES = tuple(Sense(*flags) for flags in itertools.product((False, True), repeat=3))
"""All eight; the first is the data set as it is written."""


@dataclass(frozen=True)
class Trial:
    """One sense, fitted."""

    sense: Sense
    chi_square: float  # with the priors, beyond the least; infinite where there is no fit
    why_not: str = ""  # there is no fit


@dataclass(frozen=True)
class Senses:
    """All of them, the best first."""

    trials: tuple[Trial, ...]
    expected: float  # of the readings, if the best sense and the noise are right
    least: float  # chi-square of the best, with its priors
    gained: float = 0.0  # what the best fit gained when it started anew; a smaller difference tells nothing

    @property
    def open(self) -> tuple[Trial, ...]:
        """Those that the data do not tell from the best, which is the first."""
        return tuple(trial for trial in self.trials if trial.chi_square < max(DECISIVE, self.gained))

    @property
    def sentence(self) -> str:
        """What the data choose, and by how much."""
        best, rest = self.trials[0], [trial for trial in self.trials if trial not in self.open]
        others = [trial for trial in self.open[1:] if trial.sense != best.sense.twin]
        if others:
            text = f"the data do not tell {best.sense.words} from {'; '.join(trial.sense.words for trial in others)}"
            text += ": a run with a weight at another angle would" if self.gained < DECISIVE else ""
        else:
            text = f"the data choose {best.sense.words}"
            text += "" if best.sense == Sense() else " (not all as they are written)"
        if rest and not others:
            other = next((trial for trial in rest if trial.sense != best.sense.twin), rest[0])
            text += f"; chi-square of the next machine ({other.sense.words}) is {other.chi_square:.3g} larger"
            certain = other.chi_square > 2 * math.log(1e6)
            odds = "more than a million" if certain else f"{math.exp(other.chi_square / 2):.2g}"
            text += f" (odds of {odds} to one)"
        if any(trial.sense == best.sense.twin for trial in self.open):
            text += (
                f". The same machine mirrored ({best.sense.twin.words}) fits as well: only the sign of damping differs,"
                " and these readings do not tell it. Stiffness is the same in both"
            )
        else:
            twin = next(trial for trial in self.trials if trial.sense == best.sense.twin)
            text += f". The same machine mirrored ({twin.sense.words}) would need damping of the other sign"
            text += f": chi-square {twin.chi_square:.3g} larger" if math.isfinite(twin.chi_square) else ": no fit"
        if self.gained >= DECISIVE:
            text += f". Fits stick on their way: one that started anew gained {self.gained:.3g}, so less tells nothing"
        if self.least > FAR_FROM_EXPECTED * self.expected:
            text += (
                f". Doubt this: even the best leaves {self.least / self.expected:.2g} times what the noise explains, "
                "so fits may have stuck on their way; state noise and tolerances as they are first"
            )
        return text + "."


def try_senses(measurement: Measurement, setup: FitSetup, tell: Callable[[Sense], None] = lambda _: None) -> Senses:
    """Fit the data in every sense, and compare chi-square with the priors under one noise.

    The noise is that of the readings as stated; where it is estimated it is what the best sense leaves. What even the
    best leaves beyond its noise widens the noise for all, so that a model that is a little off decides nothing.

    Raises ConfigError where no sense has a fit, or the loss weighs no noise.
    """
    if setup.loss.kind != "response":
        raise ConfigError(
            f"stage=senses must have loss=response, which weighs the readings by their noise, but got {setup.loss.kind}"
        )
    fits: dict[Sense, list[OutputErrorFit]] = {}
    refused: dict[Sense, str] = {}
    for sense in SENSES:
        tell(sense)
        try:
            fits[sense] = _fit(sense.read(measurement), setup)
        except ConfigError as error:
            refused[sense] = str(error)
    if not any(fits.values()):
        why = next(iter(refused.values()), "every fit ran away")
        raise ConfigError(f"the data must have a fit in one sense at least, but {why}")
    factors = [fit.factor for several in fits.values() for fit in several]
    factor = min(factors, key=lambda channel_factors: float(np.median(channel_factors)))
    first = {sense: min((_square(fit, factor) for fit in several), default=math.inf) for sense, several in fits.items()}
    squares: dict[Sense, float] = {}
    for sense in SENSES[: len(SENSES) // 2]:
        squares |= _compare(sense, fits, factor, setup)
    least, count = min(squares.values()), 2 * measurement.dataset.displacement.size
    wider = max(1.0, least / count)
    beyond = {sense: (square - least) / wider for sense, square in squares.items()}
    trials = [Trial(sense, beyond.get(sense, math.inf), refused.get(sense, "")) for sense in SENSES]
    best = SENSES[find_least({SENSES.index(sense): square for sense, square in squares.items()})]
    ranked = tuple(trials[i] for i in rank_indices(-squares.get(sense, math.inf) for sense in SENSES))
    return Senses(ranked, float(count), float(least), (first[best] - least) / wider)


def _fit(measurement: Measurement, setup: FitSetup) -> list[OutputErrorFit]:
    """The fits that did not run away: with uncertain parameters of the model from two starts, since one may stick."""
    start = prepare_output_error(measurement, setup)
    # A damping that runs off to zero is no mistake here: it is what the wrong sign of its phase leaves of it.
    fits = [fit_from(start, setup, near=near) for near in ((False, True) if measurement.parameters else (False,))]
    return [fit for fit in fits if np.isfinite(fit.weights.numpy()).all()]


def _compare(
    sense: Sense,
    fits: Mapping[Sense, Sequence[OutputErrorFit]],
    factor: np.ndarray,
    setup: FitSetup,
    restarts: int = 8,
    no_gain: float = 0.1,
) -> dict[Sense, float]:
    """Chi-square of two senses that are one machine.

    The worse one starts anew at the better one, since fits may stick on their way. With uncertain parameters of the
    model they often do: then each starts at every fit of the other, and again where that gained more than ``no_gain``:
    the evidence is weighed by whole units of chi-square. There are ``restarts`` at most.
    """
    squares = {each: [_square(fit, factor) for fit in fits.get(each, ())] for each in (sense, sense.twin)}
    best = {each: min(several) for each, several in squares.items() if several}
    if len(best) < 2:
        return best
    every = [(square, each, fit) for each in best for square, fit in zip(squares[each], fits[each], strict=True)]
    waiting = sorted(every, key=lambda each: each[0])[: None if every[0][2].problem.places.n_parameters else 1]
    for _ in range(restarts):
        if not waiting:
            break
        _, twin, fit = waiting.pop(0)
        again = _start_at(fits[twin.twin][0], fit, setup)
        if again is not None and (square := _square(again, factor)) < best[twin.twin] - no_gain:
            best[twin.twin] = square
            waiting.append((square, twin.twin, again))
    return best


def _start_at(fit: OutputErrorFit, twin: OutputErrorFit, setup: FitSetup) -> OutputErrorFit | None:
    """The fit once more, from the same machine mirrored, its damping as it is; None where that runs away."""
    start, other, unknowns = fit.start, twin.problem, twin.start.measurement.unknowns
    values = unknowns.from_active(other.unknowns(twin.weights)[0][0].numpy())
    turned = values * [-1.0 if name in ("kxy", "kyx") else 1.0 for name in unknowns.names]
    weights = start_at(start.problem, turned)
    rest = twin.weights[..., other.places.n_coefficients :].clone()
    planes = 2 * other.places.n_planes
    rest[..., :planes] *= other.plane_scale / start.problem.plane_scale
    rest[..., 1:planes:2] *= -1.0  # imaginary parts
    for t, parameter in enumerate(other.measurement.parameters):
        if parameter.mirrored:
            rest[..., planes + t] *= -1.0
    weights[..., start.problem.places.n_coefficients :] = rest
    restarted = fit_from(
        replace(start, problem=start.problem.update(weights), weights=weights, from_guess=False), setup, near=True
    )
    return restarted if np.isfinite(restarted.weights.numpy()).all() else None


def _square(fit: OutputErrorFit, factor: np.ndarray) -> float:
    """Chi-square with the priors, of the noise of the measured readings times ``factor`` (P,); far ones by Huber."""
    import torch

    first, total = fit.start.problem.readings, 0.0
    readings = first.scaled(1 / torch.as_tensor(factor)[:, None])
    parts: dict[str, Any] = {"precision": readings.precision, "common": first.common, "records": readings.records}
    problem = replace(fit.problem, readings=replace(fit.problem.readings, **parts))
    for deviations in problem.deviations(fit.weights):
        off = (deviations.abs() / math.sqrt(2.0)).numpy()
        total += float(np.where(off < HUBER, off**2, HUBER * (2 * off - HUBER)).sum())
    return 2.0 * total + float(problem.prior.deviations(fit.weights[:, 0]).square().sum())
