"""All that is read of a run-up: one natural frequency from several readings; an identified one held against it."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np

from pipeline.sweep.bias import SteadyReading, SweepBias, measure_bias
from pipeline.sweep.fit import ModalFit, RunUp, choose_sense, fit_decay, fit_single_and_pair, read_smoothed_peak
from pipeline.write_numbers import write_number, write_rough

if TYPE_CHECKING:
    from pipeline.ingest.run_up import RunUpConfig


@dataclass(frozen=True)
class Reading:
    """A number with its standard deviation, in one unit."""

    value: float
    deviation: float

    def half_width(self, deviations: float = 1.96) -> float:
        """Half of the 95 % interval."""
        return deviations * self.deviation


@dataclass(frozen=True, eq=False, kw_only=True)
class RunUpAnalysis:
    """All that was read of a run-up."""

    run_up: RunUp
    sense: str  # what its phases were, lead or lag
    steady: SteadyReading | None
    fits: tuple[ModalFit, ModalFit]  # of one mode, and of two
    chosen: ModalFit  # the fit with the modes that Schwarz's criterion prefers
    decay: ModalFit | None
    frequency: Reading  # rad/s, of the first mode
    damping: Reading  # its ratio
    bias: SweepBias

    @property
    def gain(self) -> float:
        """By how much Schwarz's criterion is less with two modes."""
        return self.fits[0].criterion - self.fits[1].criterion


def analyse_run_up(run_up: RunUp, settings: RunUpConfig) -> RunUpAnalysis:
    """Fit modes and the free decay behind the peak; the first mode has the mean of what both say of it."""
    sense = str(settings.phase or "")
    if not sense:
        run_up, sense, _ = choose_sense(run_up)
    fits = fit_single_and_pair(run_up, settings.background_degree)
    chosen = min(fits, key=lambda fit: fit.criterion)
    decay = fit_decay(run_up, float(chosen.frequencies[0]), settings.background_degree)
    readings = [read_mode(chosen, 0)]
    if decay is not None and int(np.argmin(np.abs(chosen.frequencies - decay.frequencies[0]))) == 0:
        readings.append(read_mode(decay, 0))  # it is that of the mode that is nearest to it
    frequency, damping = (combine(each) for each in zip(*readings, strict=True))
    return RunUpAnalysis(
        run_up=run_up,
        sense=sense,
        steady=read_smoothed_peak(run_up, settings.steady_rows),
        fits=fits,
        chosen=chosen,
        decay=decay,
        frequency=frequency,
        damping=damping,
        bias=measure_bias(frequency.value, damping.value, run_up.rate, settings.most_lag),
    )


def read_mode(fit: ModalFit, mode: int) -> tuple[Reading, Reading]:
    """Natural frequency (rad/s) and damping ratio of a mode."""
    frequency, damping = fit.deviations[mode].tolist()
    return Reading(float(fit.frequencies[mode]), frequency), Reading(float(fit.dampings[mode]), damping)


def combine(readings: Sequence[Reading]) -> Reading:
    """The mean of readings of one quantity that may contradict each other by more than their deviations.

    What they differ by beyond these is a variance of its own, which every reading gets (DerSimonian and Laird 1986).
    """
    values = np.array([reading.value for reading in readings])
    variances = np.array([reading.deviation**2 for reading in readings])
    weights = 1 / variances
    excess = float(weights @ (values - np.average(values, weights=weights)) ** 2) - (len(values) - 1)
    spread = weights.sum() - (weights**2).sum() / weights.sum()
    between = max(excess / spread, 0.0) if len(values) > 1 else 0.0
    weights = 1 / (variances + between)
    return Reading(float(np.average(values, weights=weights)), float(weights.sum() ** -0.5))


def compare_natural_frequency(run_up: Mapping[str, Any], rpm: float, deviation: float) -> dict[str, Any]:
    """An identified first natural frequency (rpm, standard deviation in rpm) against that of ``run_up.json``.

    ``within`` says whether the run-up's lies in the identified 95 % interval, widened by the run-up's own deviation;
    ``share_of_interval`` is the difference over its half-width;
    ``band_percent`` is how wide the identified interval is, of the run-up's value; ``sentence`` says all of it.
    """
    measured = Reading(run_up["natural_frequency"]["rpm"], run_up["natural_frequency"]["deviation_rpm"])
    identified = Reading(rpm, deviation)
    apart = 100 * (rpm - measured.value) / measured.value
    band = 100 * 2 * identified.half_width() / measured.value
    share = float(abs(rpm - measured.value) / Reading(0.0, float(np.hypot(deviation, measured.deviation))).half_width())
    return {
        "identified_rpm": rpm,
        "identified_deviation_rpm": deviation,
        "run_up_rpm": measured.value,
        "run_up_deviation_rpm": measured.deviation,
        "difference_percent": apart,
        "band_percent": band,
        "within": share <= 1,
        "share_of_interval": share,
        "sentence": (
            f"first natural frequency: {write_number(rpm)} +- {write_rough(identified.half_width())} rpm identified "
            f"(95 %, {write_rough(band)} % wide), {write_number(measured.value)} +- "
            f"{write_rough(measured.half_width())} rpm in the run-up: they "
            f"{'agree' if share <= 1 else 'contradict each other'} ({apart:+.2g} %)"
        ),
    }
