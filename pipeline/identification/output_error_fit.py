"""The fit by the output error: Levenberg-Marquardt, precisions from the noise, as many features as the data determine.

The deviation of a reading follows from the predicted amplitude, not from the measured one, whose noise would bias the
fit; so precisions and coefficients are found in turn. Readings far off (bad points) count less (Huber 1964).

Legend: G fits, S speeds, P channels, R runs, U unknowns, A those of them that members have, Z weights.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import numpy as np

from pipeline.errors import ConfigError
from pipeline.identification.identified import IdentifiedModel
from pipeline.identification.model_error import MeanSquareError, measure_error, noise_alone
from pipeline.identification.noise_estimate import estimate_correlation, reshape_noise
from pipeline.identification.output_error_start import OutputErrorStart, prepare_output_error
from pipeline.identification.problem import OutputError
from pipeline.identification.selection import add_features, drop_features, weigh_by_evidence, with_sigma
from pipeline.identification.training import FitSetup, Minimum, Outcome, Progress, minimise
from pipeline.problem.measurement import Measurement
from pipeline.problem.response import join_runs

if TYPE_CHECKING:
    import torch

HUBER = 2.5
"""Readings beyond so many deviations (complex) count less; of good ones that is one in five hundred."""


@dataclass(frozen=True, eq=False, kw_only=True)
class OutputErrorFit:
    """The minimum, and what it rests on."""

    start: OutputErrorStart
    problem: OutputError  # with the final precisions
    minimum: Minimum  # of the last round; its history and steps are those of all rounds
    factor: np.ndarray  # (P,) deviation of each channel over the stated one

    @property
    def weights(self) -> torch.Tensor:
        """(1, 1, Z)."""
        return self.minimum.parameters

    @property
    def identified(self) -> IdentifiedModel:
        """The coefficients."""
        return self.problem.identified(self.weights)

    def covariance(self) -> np.ndarray:
        """(Z, Z) of the weights: the inverse of the information, the Cramer-Rao bound of the parametrisation."""
        return np.asarray(self.problem.covariance(self.weights)[0])

    def error(self, inflation: float = 1.0) -> MeanSquareError:
        """What the weights are off by: their covariance, and what the functions of the speed can't follow.

        The readings' variances are ``inflation`` times as large as the fit took them; what was known before stays.
        """
        problem, searched = self.problem.scaled(inflation**-0.5), self.start.searched
        if searched is None:
            return measure_error(problem, self.weights)
        return noise_alone(problem, searched.mix(problem.covariance(self.weights)[0]))


def fit_output_error(measurement: Measurement, setup: FitSetup, progress: Progress | None = None) -> OutputErrorFit:
    """Prepare the fit and solve it: :func:`fit_from`, and then the hidden layers where they are trained, too.

    Ctrl-C ends it with the best state so far. Raises ConfigError as :func:`prepare_output_error`, and where a
    coefficient ran off to zero.
    """
    from pipeline.identification.trained_fit import train_hidden
    from pipeline.identification.trained_network import train_from_nodes

    fit = fit_from(prepare_output_error(measurement, setup), setup, progress)
    _refuse_lost(fit)
    if fit.minimum.outcomes[0] is Outcome.INTERRUPTED:
        return fit
    if setup.model.network:
        return train_from_nodes(fit, setup, progress)
    return train_hidden(fit, setup, progress) if setup.loss.hidden == "trained" else fit


def _refuse_lost(fit: OutputErrorFit, nothing: float = 1e-60) -> None:
    """Raise ConfigError where a coefficient ran off so far that no reading feels it, and no deviation is finite.

    Its weights then have less information than ``nothing``, as the logarithm of a coefficient that ran off to zero.
    """
    felt = fit.problem.normal(fit.weights)[1][0, 0].diagonal()[fit.problem.places.coefficients]
    unfelt = (felt.unflatten(-1, (len(fit.problem.active), -1)) < nothing).all(-1)
    lost = [fit.problem.active[a] for a in unfelt.nonzero().flatten().tolist()]
    if lost:
        nodes, names = fit.start.measurement.rotor.bearing_nodes, fit.start.measurement.unknowns.names
        named = ", ".join(f"{names[u]} at node {nodes[m]}" for m, u in lost)
        raise ConfigError(
            f"every coefficient that is identified must leave a trace in the readings, but {named} ran off to zero: "
            "the readings tell nothing of it (stage=diagnose says so beforehand), or contradict the rotor or the runs. "
            "Check phase (lag or lead), probes, weights and rotor, state a size (identify.known_within=30), "
            "or give what can't be told as data.known"
        )


def fit_from(
    start: OutputErrorStart,
    setup: FitSetup,
    progress: Progress | None = None,
    *,
    near: bool = False,
    rounds: int = 8,
    settled: float = 1e-3,
    choice: int = 1,
    no_worse: float = 2.0,
    least_noise: float = 0.1,
    astray: float = 1e-2,
) -> OutputErrorFit:
    """Fit, weigh the readings anew, and fit again until the precisions stay; from a start ``near`` the answer at the
    full precision.

    Args:
        rounds: at most so many, until no precision changes by more than ``settled``.
        choice: the round after which superfluous features are dropped: the precisions are nearly right by then.
        no_worse: so many times the loss before, dropping them may raise it to.
        least_noise: of the stated one, where noise is estimated and nodes over the speed carry the coefficients, which
            follow no curve exactly: data without noise would be fitted by tolerances instead.
        astray: so much above the loss to first order of the model parameters, that of the rotor solved anew shows that
            they lead astray: from then on the rotor is solved at every step.
    """
    problem, weights = start.problem, start.weights
    if start.from_guess:
        problem, weights, reached = add_features(start, setup.optimizer.levenberg_marquardt)
        start = replace(start, starts=reached)
    if start.by_evidence:
        problem = with_sigma(problem)
    factor = np.ones(len(start.measurement.dataset.channels))
    minimum: Minimum | None = None
    exact = start.near
    near = near or start.near or start.searched is not None
    approach = _LESS_EXACT if problem.places.n_parameters and not near else ()
    selects = not problem.law.laws and not start.by_evidence and start.searched is None
    for turn in range(-len(approach), rounds):
        less = problem.scaled(approach[turn]) if turn < 0 else problem
        last = minimise(replace(less, exact=exact), weights, setup, progress=progress)
        minimum, weights = last.after(minimum) if minimum else last, last.parameters
        if minimum.outcomes[0] is Outcome.INTERRUPTED:
            break
        if turn >= 0 and setup.loss.noise == "estimated":
            factor = np.maximum(estimate_noise(problem, weights), least_noise if start.searched else 0.0)
        problem = problem.update(weights)
        if turn < 0:
            continue
        before, first_order = problem, exact
        exact = exact or (turn > choice and float(problem.loss(weights)) > (1 + astray) * float(last.loss[0]))
        if turn == choice and setup.loss.noise == "estimated" and not start.searched:
            problem = reshape_noise(problem, weights, factor)
        problem = reweigh(problem, weights, factor, setup.loss.robust)
        if start.searched is not None and setup.loss.noise == "estimated":
            correlation, size = estimate_correlation(problem, weights)
            problem, factor = problem.correlated(correlation).scaled(1 / size), factor * size
        if turn >= choice and start.by_evidence and bool(problem.kept.any()):
            problem, weights = weigh_by_evidence(problem, weights)
        if turn == choice and not start.from_guess and selects:
            chosen, restart = drop_features(problem, weights, problem.covariance(weights)[0])
            # The choice takes the minimum for quadratic: where there is none yet, it may lead anywhere, or to NaN.
            if float(chosen.loss(restart)) <= no_worse * float(problem.loss(weights)):
                problem, weights = chosen, restart
        if turn == choice and selects:
            n_speeds = problem.features.shape[1]
            problem = replace(problem, precision=problem.basis.prior_precision(n_speeds, setup.loss.beyond_trend))
        if turn > choice and exact == first_order and _change(problem, before) < settled:
            break
    assert minimum is not None, "there are rounds"
    return OutputErrorFit(start=start, problem=problem, minimum=minimum, factor=factor)


_LESS_EXACT = (0.03, 0.1, 0.3)
"""Shares of the precision that a fit of model parameters goes through: far from the answer, exact readings would drive
them many prior deviations away, into valleys of their own. While the readings count for less, the priors hold them."""


def _change(problem: OutputError, before: OutputError) -> float:
    """The largest change of a precision, of its logarithm; what was not measured has none."""
    pairs = zip(problem.readings.precision, before.readings.precision, strict=True)
    return max(float((new[new > 0] / old[new > 0]).log().abs().max()) for new, old in pairs)


# --- what the readings' noise is -------------------------------------------------------------------------


def reweigh(problem: OutputError, weights: torch.Tensor, factor: np.ndarray, robust: bool) -> OutputError:
    """The problem with precisions from the predicted amplitudes and, if ``robust``, Huber's for readings far off.

    Where the noise is in levels, each run has the share of its condition, as that belongs to the others, and the levels
    stay as they are: would they follow the residuals, a fit could leave a bias that the noise then explains.
    """
    readings, drift, predicted, shares = problem.readings, problem.measurement.drift, problem.predicted(weights), []
    for b, expected in enumerate(predicted):
        off = readings.departure(b, expected.numpy(), factor)
        share = HUBER / np.maximum(off, HUBER) if robust else np.ones_like(off)
        shares.append(np.minimum(drift.weights, 1.0)[readings.runs[b]] * np.ones_like(off) if drift else share)
    return replace(problem, readings=readings.follow(predicted, factor, shares))


def estimate_by_residuals(problem: OutputError, weights: torch.Tensor) -> np.ndarray:
    """(P,) deviation of each channel over the stated one, from the medians of what the fit leaves over.

    The squared modulus of circular noise has the median ln 2; the weights took their share of the rest.
    """
    data, readings = problem.measurement.dataset, problem.readings
    blocks = [readings.departure(b, block.numpy())[0] for b, block in enumerate(problem.predicted(weights))]
    off = join_runs(readings.runs, blocks)
    squared = np.nanmedian(np.where(data.present[:, None], off, np.nan) ** 2, axis=(0, 2)) / np.log(2.0)
    used = float(problem.n_fitted)
    if len(problem.functions.aims):  # what the prior says takes nothing of the rest
        used -= float((problem.covariance(weights)[0] * problem.prior.information.numpy()).sum())
    rest = max(1.0 - used / readings.size, 0.05)
    return np.asarray(np.sqrt(squared / rest))


def estimate_noise(problem: OutputError, weights: torch.Tensor) -> np.ndarray:
    """(P,) deviation of each channel over the stated one, from runs that repeat each other: what differs between them
    is noise whatever the model is, and half the squared difference of two has their variance.

    Where no run repeats another, :func:`estimate_by_residuals`.
    """
    squares = []
    for b, predicted in enumerate(problem.predicted(weights)):
        runs, measured = problem.readings.runs[b], problem.readings.measured[b][0].numpy()
        # All runs had the same baseline taken off: its noise cancels.
        taken = problem.measurement.baseline[..., runs]
        deviation = problem.measurement.deviation_of(predicted[0].numpy() + taken, runs=runs)
        here = problem.readings.present(b).numpy()[:, 0] > 0  # (S, R)
        # By what is stated: a fitted weight of one run is not that of another. Runs of a block share their frequencies.
        for r, before in problem.measurement.dataset.find_repeats(runs):
            both = here[:, r] & here[:, before]
            squares.append((np.abs((measured[..., r] - measured[..., before]) / deviation[..., r]) ** 2 / 2)[both])
    if not squares:
        return estimate_by_residuals(problem, weights)
    return np.asarray(np.sqrt(np.median(np.concatenate(squares), axis=0) / np.log(2.0)))
