"""Tables of the digital twin: its vibration, its modes, and what it says on the terminal."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np

from pipeline.config.schema import Config
from pipeline.data.operating import name_state
from pipeline.data.operating_points import list_columns
from pipeline.data.vibration_files import to_rpm
from pipeline.reporting.console import say, table
from pipeline.reporting.write_numbers import format_deviation
from pipeline.twin.mode_deviations import Behaviour
from pipeline.twin.modes import amplify, require_separation
from pipeline.twin.prediction import PredictedVibration
from pipeline.units import RAD_S_PER_RPM

RAD_S_PER_HERTZ = 2.0 * np.pi


def summarize_modes(behaviour: Behaviour, running_rpm: float) -> dict[str, object]:
    """Critical speeds and stability for ``prediction.json``; margins are from the running speed, in percent of it.

    Standard deviations stand beside (``*_std``) where the fit states them.
    """
    margin = behaviour.margin
    stability: dict[str, object] = {
        "stable": margin.stable,
        "verdict": behaviour.stability.value,
        "largest_growth": margin.largest_growth,
        "smallest_logarithmic_decrement": margin.smallest_logarithmic_decrement,
        "at_rpm": None if margin.at_speed is None else margin.at_speed / RAD_S_PER_RPM,
    }
    if behaviour.deviations is not None:
        growth, decrement = behaviour.margin_deviations
        stability |= {"largest_growth_std": growth, "smallest_logarithmic_decrement_std": decrement}
    critical = {f"{i + 1}": _summarize_critical(behaviour, i, running_rpm) for i in range(len(behaviour.critical))}
    return {"critical_speeds": critical, "stability": stability}


def _summarize_critical(behaviour: Behaviour, i: int, running_rpm: float) -> dict[str, float | None]:
    critical = behaviour.critical[i]
    rpm, decrement = critical.speed / RAD_S_PER_RPM, critical.logarithmic_decrement
    speed_std, decrement_std = (
        (0.0, 0.0) if behaviour.deviations is None else behaviour.deviations.of_critical(critical)
    )
    amplified = amplify(decrement, decrement_std)
    factor, factor_std = (None, None) if amplified is None else amplified
    entry: dict[str, float | None] = {
        "rpm": rpm,
        "logarithmic_decrement": decrement,
        "amplification_factor": factor,
        "separation_margin_percent": 100.0 * abs(rpm / running_rpm - 1.0),
        "separation_margin_required_percent": require_separation(factor, rpm > running_rpm),
    }
    if behaviour.deviations is not None:
        entry |= {
            "rpm_std": speed_std / RAD_S_PER_RPM,
            "logarithmic_decrement_std": decrement_std,
            "amplification_factor_std": factor_std,
            "separation_margin_percent_std": 100.0 * speed_std / RAD_S_PER_RPM / running_rpm,
        }
    return entry


def tabulate_modes(behaviour: Mapping[str, Behaviour], operating: Mapping[str, float]) -> dict[str, Any]:
    """Columns of ``modes.csv``: a row a system, speed and mode that oscillates, by ascending frequency.

    ``operating`` are the conditions (SI) of all rows.
    """
    columns: dict[str, list[Any]] = {}
    for name, machine in behaviour.items():
        present = ~np.isnan(machine.modes.frequency)
        speed, mode = np.nonzero(present)
        rows = {
            "system": np.full(len(speed), name, dtype=object),
            "speed_rpm": to_rpm(machine.modes.speeds)[speed],
            "mode": mode + 1,
            "frequency_hz": machine.modes.frequency[present] / RAD_S_PER_HERTZ,
            "logarithmic_decrement": machine.modes.logarithmic_decrement[present],
            "frequency_std_hz": np.full(len(speed), np.nan),
            "logarithmic_decrement_std": np.full(len(speed), np.nan),
        }
        if machine.deviations is not None:
            rows["frequency_std_hz"] = machine.deviations.frequency[present] / RAD_S_PER_HERTZ
            rows["logarithmic_decrement_std"] = machine.deviations.logarithmic_decrement[present]
        rows |= _repeat_conditions(operating, len(speed))
        for key, values in rows.items():
            columns.setdefault(key, []).extend(values)
    return columns


def _repeat_conditions(operating: Mapping[str, float], count: int) -> dict[str, np.ndarray]:
    """A column a condition, named with its unit."""
    return list_columns({name: np.full(count, value) for name, value in operating.items()})


def tabulate_vibration(
    vibration: Mapping[str, PredictedVibration], operating: Mapping[str, float]
) -> dict[str, np.ndarray]:
    """Columns of ``prediction.csv``: amplitudes (zero-to-peak, m) and phases over the speed.

    ``operating`` are the conditions (SI) of all rows.
    """
    columns = {"speed_rpm": to_rpm(next(iter(vibration.values())).speeds)}
    columns |= _repeat_conditions(operating, len(columns["speed_rpm"]))
    for name, predicted in vibration.items():
        for d, direction in enumerate("xy"):
            columns[f"{direction}_{name}_amplitude_m"] = np.abs(predicted.displacement[:, d])
            if predicted.deviation is not None:
                columns[f"{direction}_{name}_amplitude_std_m"] = predicted.deviation[:, d]
            columns[f"{direction}_{name}_phase_deg"] = np.degrees(np.angle(predicted.displacement[:, d]))
    return columns


def print_twin(
    config: Config,
    summary: Mapping[str, Any],
    vibration: Mapping[str, PredictedVibration],
    at: int,
    operating: Mapping[str, float],
) -> None:
    """The vibration at the prediction's speed and ``operating`` conditions (SI), the stability, each critical speed."""
    prediction, rpm = config.machine.prediction, config.machine.prediction.speed_rpm
    state = f", at {name_state(operating)}" if operating else ""
    rows, criticals = [], []
    for name, predicted in vibration.items():
        size = 1e6 * np.abs(predicted.displacement[at])
        known_to = [None, None] if predicted.deviation is None else list(1e6 * predicted.deviation[at])
        shown = [format_deviation(float(s), d) for s, d in zip(size, known_to, strict=True)]
        rows.append([name, *shown, _show(summary[name]["stability"], "smallest_logarithmic_decrement")])
        for critical in summary[name]["critical_speeds"].values():
            keys = ("rpm", "logarithmic_decrement", "amplification_factor", "separation_margin_percent")
            asked = f"{critical['separation_margin_required_percent']:.0f}"
            criticals.append([name, *(_show(critical, key) for key in keys), asked])
    header = ["system", f"x at {rpm:g} rpm, um", f"y at {rpm:g} rpm, um", "smallest log decrement"]
    title = f"{config.name}: node {prediction.node} under an unbalance never seen{state} (+- standard deviation)"
    table(title, header, rows)
    if criticals:
        header = ["system", "rpm", "log decrement", "amplification factor", "separation, %", "API 617 asks, %"]
        table(f"critical speeds{state}; separation is that from {rpm:g} rpm", header, criticals)
    else:
        say(f"critical speeds{state}: none in the range of speeds")
    if "displacement" in summary:
        errors = (
            f"{direction} {e['mean_error_percent']:.2g} % mean, {e['max_error_percent']:.2g} % max"
            for direction, e in summary["displacement"].items()
        )
        say(f"error of the displacement over all speeds: {'; '.join(errors)}")


def _show(entry: Mapping[str, Any], key: str) -> str:
    """A number with its deviation; "none" where there is none."""
    return "none" if entry[key] is None else format_deviation(entry[key], entry.get(f"{key}_std"))
