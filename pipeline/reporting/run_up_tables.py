"""A run-up as a person reads it: its modes, what a steady reading gives, and what an identified machine says."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np

from pipeline.data.vibration_files import to_rpm
from pipeline.identification.identified import Answer
from pipeline.ingest.run_up import RunUpConfig
from pipeline.reporting.console import say, table, warn
from pipeline.sweep.bias import describe_bias, summarize_bias
from pipeline.sweep.fit import ModalFit
from pipeline.sweep.readings import Reading, RunUpAnalysis, compare_natural_frequency, read_mode
from pipeline.twin.mode_deviations import expect_criticals
from pipeline.units import RAD_S_PER_RPM
from pipeline.write_numbers import write_number, write_percent, write_rough


def summarize_run_up(settings: RunUpConfig, analysis: RunUpAnalysis) -> dict[str, Any]:
    """What ``run_up.json`` has."""
    run_up, steady, frequency = analysis.run_up, analysis.steady, analysis.frequency
    rpm = to_rpm(run_up.speeds)
    return {
        "file": settings.file,
        "probe": settings.probe,
        "rows": len(rpm),
        "first_rpm": float(rpm[0]),
        "last_rpm": float(rpm[-1]),
        "rate_rpm_per_s": run_up.rate / RAD_S_PER_RPM,
        "rate_deviation_rpm_per_s": run_up.rate_deviation and run_up.rate_deviation / RAD_S_PER_RPM,
        "largest_departure_rpm": run_up.departure and run_up.departure / RAD_S_PER_RPM,
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
        "sweep": summarize_bias(analysis.bias),
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


def compare_identified(
    answer: Answer, run_up: Mapping[str, Any], around: tuple[float, float] = (0.5, 2.0)
) -> dict[str, Any]:
    """The first identified critical speed against the first natural frequency of ``run_up.json``.

    Critical speeds are looked for ``around`` it, as shares. Empty where a fit states no deviations, or finds none
    there. Raises ConfigError as :func:`pipeline.twin.mode_deviations.expect_criticals`.
    """
    if answer.uncertainty is None:
        return {}
    expected = expect_criticals(
        answer.measurement,
        answer.uncertainty,
        run_up["natural_frequency"]["rpm"] * np.linspace(*around, 61) * RAD_S_PER_RPM,
    )
    if not expected:
        return {}
    first, (deviation, _) = expected[0]
    return {
        "first": compare_natural_frequency(run_up, first.speed / RAD_S_PER_RPM, deviation / RAD_S_PER_RPM)
        | {
            "critical_speeds": [
                {
                    "rpm": critical.speed / RAD_S_PER_RPM,
                    "deviation_rpm": speed_deviation / RAD_S_PER_RPM,
                    "logarithmic_decrement": critical.logarithmic_decrement,
                    "deviation_logarithmic_decrement": decrement_deviation,
                }
                for critical, (speed_deviation, decrement_deviation) in expected
            ]
        }
    }


def print_run_up(name: str, settings: RunUpConfig, analysis: RunUpAnalysis, poor: float = 0.3) -> None:
    """The table of the readings, and what to look at.

    Modes leave the share ``poor`` of the vectors over only where something is read wrongly.
    """
    (one_mode, two_modes), rows = analysis.fits, []
    if steady := analysis.steady:
        label = f"steady: peak of the mean of {settings.steady_rows} rows, half-power width"
        rpm, damping = write_number(steady.frequency / RAD_S_PER_RPM, digits=5), write_number(steady.damping, digits=3)
        rows.append([label, rpm, "", damping, "", ""])
    fits = [
        ("ramp, 1 mode: first", one_mode, 0),
        ("ramp, 2 modes: first", two_modes, 0),
        ("ramp, 2 modes: second", two_modes, 1),
        *([("free decay behind the peak", analysis.decay, 0)] if analysis.decay else []),
    ]
    rows += [_row(label, *read_mode(fit, mode), write_number(100 * fit.misfit, digits=3)) for label, fit, mode in fits]
    rows.append(_row("first natural frequency", analysis.frequency, analysis.damping, ""))
    table(
        f"{name}: run-up of {settings.probe}, {len(analysis.run_up.speeds)} rows of '{settings.file}'",
        ["reading", "rpm", "+- (95 %)", "damping ratio", "+- (95 %)", "left over, %"],
        rows,
    )
    say(
        f"{name}: rate {write_number(analysis.run_up.rate / RAD_S_PER_RPM)} rpm/s, phase a {analysis.sense}; "
        f"{'two modes' if analysis.gain > 0 else 'one mode'} (Schwarz's criterion "
        f"{write_number(abs(analysis.gain), digits=3)} better)"
    )
    if analysis.chosen.misfit > poor:
        warn(
            f"the modes leave {write_percent(analysis.chosen.misfit)} of '{settings.file}' over: check its columns, "
            "the sense and unit of the phase, and the range of the ramp (from_rpm, to_rpm)"
        )
    if abs(analysis.bias.peak_shift) > settings.most_lag:
        warn(f"the peak is no steady one: {describe_bias(analysis.bias)}")


def _row(label: str, frequency: Reading, damping: Reading, left_over: str) -> list[str]:
    return [
        label,
        write_number(frequency.value / RAD_S_PER_RPM, digits=5),
        write_rough(frequency.half_width() / RAD_S_PER_RPM),
        write_rough(damping.value),
        write_number(damping.half_width(), digits=1),
        left_over,
    ]
