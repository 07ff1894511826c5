"""Natural frequencies and damping ratios from a run-up whose ramp is modelled, beside what a steady reading gives."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np

from pipeline.data.tables import write_table
from pipeline.data.vibration_files import to_rpm
from pipeline.errors import ConfigError
from pipeline.files import write_json
from pipeline.ingest.run_up import RunUpConfig, read_run_up
from pipeline.reporting.console import say, table, warn
from pipeline.reporting.run_up_figure import draw_run_up
from pipeline.stages.analysis import Analysis
from pipeline.stages.execution import StageOutput
from pipeline.stages.identified_criticals import compare_identified
from pipeline.stages.workspace import locate_files
from pipeline.sweep.bias import SteadyReading, SweepBias, describe_bias, measure_bias
from pipeline.sweep.fit import (
    MeasuredRate,
    ModalFit,
    RunUp,
    choose_modes,
    choose_sense,
    fit_decay,
    read_smoothed_peak,
    respond_as_steady,
)
from pipeline.sweep.readings import NORMAL, Reading, combine
from pipeline.units import RAD_S_PER_RPM

_MICROMETRES = 1e6
_POOR = 0.3
"""Share of the vectors that is left over: modes explain so little only where something is read wrongly."""


@dataclass(frozen=True, eq=False, kw_only=True)
class _Found:
    """All that was read of a run-up."""

    run_up: RunUp
    measured: MeasuredRate | None
    sense: str
    steady: SteadyReading | None
    fits: tuple[ModalFit, ModalFit]
    count: int
    decay: ModalFit | None
    frequency: Reading  # rad/s
    damping: Reading
    bias: SweepBias

    @property
    def chosen(self) -> ModalFit:
        return self.fits[self.count - 1]


def run(analysis: Analysis) -> StageOutput:
    """``run_up.json``, ``run_up.csv`` and ``figures/run_up.png``.

    Raises ConfigError where the machine has no run-up, and DataError as :func:`pipeline.ingest.run_up.read_run_up`.
    """
    config = analysis.config
    settings = config.machine.run_up
    if settings is None:
        raise ConfigError(
            "runup must have a run-up to fit, but machine.run_up is missing: give its file and what its numbers mean "
            "(docs/run_up.md)"
        )
    reading = _analyse(settings)
    summary = _summarize(settings, reading)
    work = locate_files(config)
    if work.training.exists():
        summary["identified"] = compare_identified(analysis, summary)
    steady = respond_as_steady(reading.run_up, reading.chosen)
    written = [
        write_json(work.folder / "run_up.json", summary),
        write_table(work.folder / "run_up.csv", _tabulate(reading, steady)),
        draw_run_up(work.figure("run_up"), reading.run_up, reading.chosen, steady, settings.probe),
    ]
    _say(config.name, settings, reading)
    for mode in summary.get("identified", {}).values():
        say(f"{config.name}: {mode['sentence']}")
    shown = {"natural_frequency_rpm": summary["natural_frequency"]["rpm"], "misfit": reading.chosen.misfit}
    return StageOutput(metrics={"runup": shown}, files=written)


def _analyse(settings: RunUpConfig) -> _Found:
    run_up, measured = read_run_up(settings)
    sense = str(settings.phase or "")
    if not sense:
        run_up, sense, _ = choose_sense(run_up)
    single, two, count = choose_modes(run_up, settings.background_degree)
    chosen = (single, two)[count - 1]
    decay = fit_decay(run_up, float(chosen.frequencies[0]), settings.background_degree)
    frequency, damping = _combine(chosen, decay)
    return _Found(
        run_up=run_up,
        measured=measured,
        sense=sense,
        steady=read_smoothed_peak(run_up, settings.steady_rows),
        fits=(single, two),
        count=count,
        decay=decay,
        frequency=frequency,
        damping=damping,
        bias=measure_bias(frequency.value, damping.value, run_up.rate, settings.most_lag),
    )


def _combine(chosen: ModalFit, decay: ModalFit | None) -> tuple[Reading, Reading]:
    """Frequency and damping of the first mode; the decay is that of the mode that is nearest to it."""
    readings = [_read(chosen, 0)]
    if decay is not None and int(np.argmin(np.abs(chosen.frequencies - decay.frequencies[0]))) == 0:
        readings.append(_read(decay, 0))
    return combine([vector for vector, _ in readings]), combine([other for _, other in readings])


def _read(fit: ModalFit, mode: int) -> tuple[Reading, Reading]:
    deviation = fit.deviations[mode]
    return (
        Reading(float(fit.frequencies[mode]), float(deviation[0])),
        Reading(float(fit.dampings[mode]), float(deviation[1])),
    )


def _summarize(settings: RunUpConfig, analysis: _Found) -> dict[str, Any]:
    run_up, bias = analysis.run_up, analysis.bias
    rpm = to_rpm(run_up.speeds)
    steady = analysis.steady
    return {
        "file": settings.file,
        "probe": settings.probe,
        "rows": len(rpm),
        "first_rpm": float(rpm[0]),
        "last_rpm": float(rpm[-1]),
        "rate_rpm_per_s": run_up.rate / RAD_S_PER_RPM,
        "rate_deviation_rpm_per_s": None if analysis.measured is None else analysis.measured.deviation / RAD_S_PER_RPM,
        "largest_departure_rpm": None if analysis.measured is None else analysis.measured.departure / RAD_S_PER_RPM,
        "phase": analysis.sense,
        "steady_reading": None
        if steady is None
        else {
            "rpm": steady.frequency / RAD_S_PER_RPM,
            "damping_ratio": steady.damping,
            "amplification": steady.amplification,
            "rows": settings.steady_rows,
        },
        "one_mode": _describe(analysis.fits[0]),
        "two_modes": _describe(analysis.fits[1]),
        "modes": analysis.count,
        "criterion_gain": analysis.fits[0].criterion - analysis.fits[1].criterion,
        "decay": None if analysis.decay is None else _describe(analysis.decay),
        "natural_frequency": {
            "rpm": analysis.frequency.value / RAD_S_PER_RPM,
            "deviation_rpm": analysis.frequency.deviation / RAD_S_PER_RPM,
        },
        "damping_ratio": {"value": analysis.damping.value, "deviation": analysis.damping.deviation},
        "sweep": {
            "peak_shift_percent": 100 * bias.peak_shift,
            "damping_factor": bias.damping_factor,
            "amplitude_factor": bias.amplitude_factor,
            "rate_limit_rpm_per_s": bias.limit / RAD_S_PER_RPM,
        },
    }


def _describe(fit: ModalFit) -> dict[str, Any]:
    rpm, deviations = fit.frequencies / RAD_S_PER_RPM, fit.deviations
    return {
        "rpm": rpm.tolist(),
        "deviation_rpm": (deviations[:, 0] / RAD_S_PER_RPM).tolist(),
        "damping_ratio": fit.dampings.tolist(),
        "deviation_damping_ratio": deviations[:, 1].tolist(),
        "misfit_percent": 100 * fit.misfit,
        "rows": len(fit.fitted),
        "correlated_rows": fit.correlation,
    }


def _tabulate(analysis: _Found, steady: np.ndarray) -> dict[str, np.ndarray]:
    """A row a row of the ramp; phases are leads."""
    columns: dict[str, np.ndarray] = {"rpm": to_rpm(analysis.run_up.speeds)}
    of: Mapping[str, np.ndarray] = {
        "measured": analysis.run_up.vectors,
        "ramp": analysis.chosen.fitted,
        "steady": steady,
    }
    for name, vectors in of.items():
        columns[f"{name}_um"] = _MICROMETRES * np.abs(vectors)
        columns[f"{name}_lead_deg"] = np.degrees(np.angle(vectors))
    return columns


def _say(name: str, settings: RunUpConfig, analysis: _Found) -> None:
    rows = []
    if analysis.steady is not None:
        steady = analysis.steady
        what = f"steady: peak of the mean of {settings.steady_rows} rows, half-power width"
        rows.append([what, f"{steady.frequency / RAD_S_PER_RPM:.5g}", "", f"{steady.damping:.3g}", "", ""])
    for count, fit in enumerate(analysis.fits, 1):
        for mode in range(count):
            rows.append(_row(f"ramp, {count} mode{'s' * (count > 1)}: {'first' if not mode else 'second'}", fit, mode))
    if analysis.decay is not None:
        rows.append(_row("free decay behind the peak", analysis.decay, 0))
    frequency, damping = analysis.frequency, analysis.damping
    rows.append(
        [
            "first natural frequency",
            f"{frequency.value / RAD_S_PER_RPM:.5g}",
            f"{NORMAL * frequency.deviation / RAD_S_PER_RPM:.2g}",
            f"{damping.value:.2g}",
            f"{NORMAL * damping.deviation:.1g}",
            "",
        ]
    )
    title = f"{name}: run-up of {settings.probe}, {len(analysis.run_up.speeds)} rows of '{settings.file}'"
    table(title, ["reading", "rpm", "+- (95 %)", "damping ratio", "+- (95 %)", "left over, %"], rows)
    gain = analysis.fits[0].criterion - analysis.fits[1].criterion
    say(
        f"{name}: rate {analysis.run_up.rate / RAD_S_PER_RPM:.4g} rpm/s, phase a {analysis.sense}; "
        f"{'two modes' if analysis.count == 2 else 'one mode'} (Schwarz's criterion {abs(gain):.3g} better)"
    )
    if analysis.chosen.misfit > _POOR:
        warn(
            f"the modes leave {100 * analysis.chosen.misfit:.2g} % of '{settings.file}' over: check its columns, the "
            "sense and unit of the phase, and the range of the ramp (from_rpm, to_rpm)"
        )
    if abs(analysis.bias.peak_shift) > settings.most_lag:
        warn(f"the peak is no steady one: {describe_bias(analysis.bias)}")


def _row(what: str, fit: ModalFit, mode: int) -> list[str]:
    frequency, damping = _read(fit, mode)
    return [
        what,
        f"{frequency.value / RAD_S_PER_RPM:.5g}",
        f"{NORMAL * frequency.deviation / RAD_S_PER_RPM:.2g}",
        f"{damping.value:.2g}",
        f"{NORMAL * damping.deviation:.1g}",
        f"{100 * fit.misfit:.3g}",
    ]
