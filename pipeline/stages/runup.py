"""Natural frequencies and damping ratios from a run-up whose ramp is modelled, beside what a steady reading gives."""

from __future__ import annotations

from typing import Any

import numpy as np

from pipeline.data.tables import write_table
from pipeline.data.vibration_files import to_rpm
from pipeline.errors import ConfigError
from pipeline.files import write_json
from pipeline.ingest.run_up import RunUpConfig, read_run_up
from pipeline.reporting.console import say, table, warn
from pipeline.reporting.measured_figures import draw_run_up
from pipeline.stages.analysis import Analysis
from pipeline.stages.execution import StageOutput
from pipeline.stages.identified_criticals import compare_identified
from pipeline.stages.workspace import locate_files
from pipeline.sweep.bias import describe_bias
from pipeline.sweep.fit import MeasuredRate, ModalFit, respond_as_steady
from pipeline.sweep.readings import Reading, RunUpAnalysis, analyse_run_up, read_mode
from pipeline.units import RAD_S_PER_RPM


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
    run_up, rate = read_run_up(settings)
    reading = analyse_run_up(run_up, settings)
    summary = _summarize(settings, reading, rate)
    work = locate_files(config)
    if work.training.exists():
        summary["identified"] = compare_identified(analysis, summary)
    steady = respond_as_steady(reading.run_up, reading.chosen)
    vectors = {"measured": reading.run_up.vectors, "ramp": reading.chosen.fitted, "steady": steady}
    columns = {"rpm": to_rpm(reading.run_up.speeds)}
    for name, values in vectors.items():  # phases are leads
        columns |= {f"{name}_um": 1e6 * np.abs(values), f"{name}_lead_deg": np.degrees(np.angle(values))}
    written = [
        write_json(work.folder / "run_up.json", summary),
        write_table(work.folder / "run_up.csv", columns),
        draw_run_up(work.figure("run_up"), reading.run_up, reading.chosen, steady, settings.probe),
    ]
    _say(config.name, settings, reading)
    for mode in summary.get("identified", {}).values():
        say(f"{config.name}: {mode['sentence']}")
    shown = {"natural_frequency_rpm": summary["natural_frequency"]["rpm"], "misfit": reading.chosen.misfit}
    return StageOutput(metrics={"runup": shown}, files=written)


def _summarize(settings: RunUpConfig, analysis: RunUpAnalysis, rate: MeasuredRate | None) -> dict[str, Any]:
    run_up, bias, steady, frequency = analysis.run_up, analysis.bias, analysis.steady, analysis.frequency
    rpm = to_rpm(run_up.speeds)
    return {
        "file": settings.file,
        "probe": settings.probe,
        "rows": len(rpm),
        "first_rpm": float(rpm[0]),
        "last_rpm": float(rpm[-1]),
        "rate_rpm_per_s": run_up.rate / RAD_S_PER_RPM,
        "rate_deviation_rpm_per_s": rate and rate.deviation / RAD_S_PER_RPM,
        "largest_departure_rpm": rate and rate.departure / RAD_S_PER_RPM,
        "phase": analysis.sense,
        "steady_reading": steady
        and {
            "rpm": steady.frequency / RAD_S_PER_RPM,
            "damping_ratio": steady.damping,
            "amplification": steady.amplification,
            "rows": settings.steady_rows,
        },
        "one_mode": _describe(analysis.fits[0]),
        "two_modes": _describe(analysis.fits[1]),
        "modes": len(analysis.chosen.frequencies),
        "criterion_gain": analysis.gain,
        "decay": analysis.decay and _describe(analysis.decay),
        "natural_frequency": {
            "rpm": frequency.value / RAD_S_PER_RPM,
            "deviation_rpm": frequency.deviation / RAD_S_PER_RPM,
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


def _say(name: str, settings: RunUpConfig, analysis: RunUpAnalysis, poor: float = 0.3) -> None:
    """``poor``: modes leave such a share of the vectors over only where something is read wrongly."""
    rows = []
    if steady := analysis.steady:
        label = f"steady: peak of the mean of {settings.steady_rows} rows, half-power width"
        rows.append([label, f"{steady.frequency / RAD_S_PER_RPM:.5g}", "", f"{steady.damping:.3g}", "", ""])
    labels = ("ramp, 1 mode: first", "ramp, 2 modes: first", "ramp, 2 modes: second")
    for label, fit, mode in zip(labels, (analysis.fits[0], *[analysis.fits[1]] * 2), (0, 0, 1), strict=True):
        rows.append(_row(label, *read_mode(fit, mode), f"{100 * fit.misfit:.3g}"))
    if decay := analysis.decay:
        rows.append(_row("free decay behind the peak", *read_mode(decay, 0), f"{100 * decay.misfit:.3g}"))
    rows.append(_row("first natural frequency", analysis.frequency, analysis.damping, ""))
    title = f"{name}: run-up of {settings.probe}, {len(analysis.run_up.speeds)} rows of '{settings.file}'"
    table(title, ["reading", "rpm", "+- (95 %)", "damping ratio", "+- (95 %)", "left over, %"], rows)
    say(
        f"{name}: rate {analysis.run_up.rate / RAD_S_PER_RPM:.4g} rpm/s, phase a {analysis.sense}; "
        f"{'two modes' if analysis.gain > 0 else 'one mode'} (Schwarz's criterion {abs(analysis.gain):.3g} better)"
    )
    if analysis.chosen.misfit > poor:
        warn(
            f"the modes leave {100 * analysis.chosen.misfit:.2g} % of '{settings.file}' over: check its columns, the "
            "sense and unit of the phase, and the range of the ramp (from_rpm, to_rpm)"
        )
    if abs(analysis.bias.peak_shift) > settings.most_lag:
        warn(f"the peak is no steady one: {describe_bias(analysis.bias)}")


def _row(label: str, frequency: Reading, damping: Reading, left_over: str) -> list[str]:
    return [
        label,
        f"{frequency.value / RAD_S_PER_RPM:.5g}",
        f"{frequency.half_width() / RAD_S_PER_RPM:.2g}",
        f"{damping.value:.2g}",
        f"{damping.half_width():.1g}",
        left_over,
    ]
