"""What a fit gives, in tables and words: coefficients, errors, numbers of laws and model, quality and verdicts."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from typing import Any

import numpy as np

from pipeline.coefficients import COEFFICIENTS
from pipeline.config.schema import Config
from pipeline.data.operating import list_columns, write_condition
from pipeline.data.vibration_files import to_rpm
from pipeline.evaluation.errors import CoefficientErrors, find_contradiction, list_contradicted
from pipeline.identification.identified import Fit
from pipeline.identification.uncertainty import Uncertainty
from pipeline.parameters.kind import ModelParameter
from pipeline.parameters.model import KINDS
from pipeline.problem.determination import describe_determined, judge_determined, read_determined
from pipeline.reporting.blocks import Table
from pipeline.reporting.coefficient_figures import Coefficients
from pipeline.reporting.console import say, table, warn
from pipeline.trust.judgement import AS_FELT
from pipeline.trust.misfit import describe_held_out, describe_readings, measure_misfit
from pipeline.write_numbers import format_engineering, write_number, write_percent, write_rough


def make_error_table(shown: Coefficients, errors: CoefficientErrors, beside: CoefficientErrors) -> list[dict[str, Any]]:
    """Paper, Table 1: one row a bearing and coefficient, values as means over the speeds, errors in percent.

    Measured data have no modelled coefficients, and so neither these columns nor errors; ``beside`` are those of least
    squares.
    """
    answer, rows = shown.identified, list[dict[str, Any]]()
    verdicts = {
        (determined.node, determined.name): determined.verdict.determined for determined in judge_determined(answer)
    }
    for b, node in enumerate(answer.nodes):
        for name in shown.unknowns[b]:
            error, least = (each.get(str(node), {}).get(name, {}) for each in (errors, beside))
            if shown.compared and not error:
                continue  # a modelled coefficient of zero has no relative error
            c = COEFFICIENTS.index(name)
            rows.append(
                {
                    "bearing_node": node,
                    "coefficient": name,
                    "modelled": shown.truth[b, :, c].mean(),
                    "identified": answer.values[b, :, c].mean(),
                    **error,
                    "least_squares_mean_error_percent": least.get("mean_error_percent"),
                    "median_std_percent": float(
                        100 * np.median(answer.spread[b, :, c] / np.abs(answer.values[b, :, c]))
                    ),
                    "verdict": verdicts.get((node, name)),
                }
            )
    told = {column for row in rows for column, value in row.items() if value not in (None,) and value == value}
    return [{column: row[column] for column in row if column in told} for row in rows]


def print_error_table(name: str, errors: Sequence[Mapping[str, Any]]) -> None:
    """Print the table on the screen."""
    columns = [column for column in _SHOWN if any(column in row for row in errors)]
    rows = [
        [
            f"node {row['bearing_node']} {row['coefficient']}",
            *(
                value
                if isinstance(value := row.get(column, np.nan), str)
                else format_engineering(value)
                if column in ("modelled", "identified")
                else write_rough(value)
                for column in columns
            ),
        ]
        for row in errors
    ]
    what = "identified against modelled" if "modelled" in columns else "identified"
    table(f"{name}: {what}", ["bearing and coefficient", *(_SHOWN[column] for column in columns)], rows)


_SHOWN = {
    "modelled": "modelled (mean)",
    "identified": "identified (mean)",
    "mean_error_percent": "mean error %",
    "median_error_percent": "median",
    "p95_error_percent": "95 %",
    "max_error_percent": "max",
    "l2_error_percent": "L2",
    "least_squares_mean_error_percent": "least squares mean error %",
    "median_std_percent": "median std %",
    "verdict": "verdict",
}


def describe_verdicts(about: Mapping[str, Any]) -> str:
    """Say how well each coefficient is determined, from ``determined`` of ``training.json``, and whether its ``fit``
    lets that count."""
    determined = about["determined"]
    text = f"{determined['by']}: {describe_determined(read_determined(determined['coefficients']))}"
    misfit = None if "fit" not in about else measure_misfit(about["fit"])
    return text if misfit is None or misfit.explained() else f"were the model right, {text}; but {misfit.sentence}"


def describe_quality(quality: Mapping[str, Any]) -> str:
    """Say how well a fit explains its readings, from the summary of its quality; no truth is needed."""
    lines, fit = list(describe_readings(quality).values()), quality.get("fit")
    if fit is None:
        return f"no modelled coefficients, so no errors; {lines[0]}"
    for kind in ("held_out_speeds", "held_out_runs"):
        if kind in fit:
            told, square = describe_held_out(kind, fit[kind], 3), fit[kind]["mean_square_over_noise"]
            if square is not None:
                told += f" (root mean square), mean square over the noise {square:.3f}, where 1 is expected"
            lines.append(told)
    return "\n".join(lines)


def tabulate_bad_points(fitted: Fit) -> dict[str, list[Any]]:
    """Readings, and how many deviations they are off."""
    every = fitted.quality.bad_points
    names = every[0]["operating"] if every else ()
    conditions = {name: np.array([point["operating"][name] for point in every]) for name in names}
    return {
        "run": [point["run"] for point in every],
        "speed_rpm": to_rpm(np.array([point["speed"] for point in every])).tolist(),
        **{name: values.tolist() for name, values in list_columns(conditions).items()},
        **{name: [point[name] for point in every] for name in ("node", "direction", "deviations")},
    }


def tabulate_unbalance(uncertainty: Uncertainty | None) -> dict[str, Any]:
    """kg m and degrees."""
    if uncertainty is None:
        return {"node": [], "magnitude": [], "phase_deg": [], "magnitude_std": []}
    return {
        "node": uncertainty.planes,
        "magnitude": np.abs(uncertainty.residual_unbalance),
        "phase_deg": np.degrees(np.angle(uncertainty.residual_unbalance)),
        "magnitude_std": uncertainty.unbalance_deviation(),
    }


def tabulate_parameters(every: Sequence[ModelParameter]) -> dict[str, list[Any]]:
    """Prior deviation, and what the fit made of it: a share of the stated value, or in the unit; supports' numbers."""
    numbers, keys = [parameter.number for parameter in every], ("number", "number_deviation")
    table: dict[str, list[Any]] = {
        "kind": [parameter.kind for parameter in every],
        "of": [parameter.label for parameter in every],
        "unit": [parameter.row.unit for parameter in every],
        "prior_std": [parameter.deviation for parameter in every],
        "value": [parameter.shift for parameter in every],
        "std": [parameter.left * parameter.deviation for parameter in every],
    }
    return table | {key: [support.get(key, "") for support in numbers] for key in keys if any(numbers)}


def list_parameters(
    caption: str,
    fitted: Mapping[str, Mapping[str, float]],
    told: float = 0.9,
    spell: Callable[[str], str] = str,
) -> Table:
    """A row a model parameter of ``model_parameters`` of ``training.json``, against what is stated.

    Where the posterior is more than ``told`` of the prior, the data tell nothing. Kinds are written as ``spell`` has
    them.
    """
    rows = []
    for name, number in fitted.items():
        (kind, _, place), prior, value = name.partition(" "), number["prior_deviation"], number["value"]
        unit, factor = KINDS[kind].shown_unit
        remark = "" if number["deviation"] < told * prior else "as stated: the data do not tell"
        if not remark and "number" in number:
            remark = _write_held(kind, place, number["number"], number["number_deviation"])
        rows.append(
            [
                f"{spell(kind)} {place}".strip(),
                unit,
                f"0 +- {write_number(factor * prior, digits=3)}",
                write_number(factor * value, factor * number["deviation"]),
                write_rough(round(value / prior, 2) + 0.0),
                remark,
            ]
        )
    return Table(
        caption, ["parameter", "unit", "stated", "found", "over its tolerance", "remark"], rows
    ).without_blank()


def _write_held(kind: str, place: str, number: float, deviation: float) -> str:
    """A support's own number; of a mode of a base, with unit mass, w^2 is its frequency and 2 zeta w a rate."""
    if not place.startswith("mode"):
        return f"{write_number(number, deviation)} {KINDS[kind].stated_unit}"
    if kind == "support_damping":
        return f"{write_number(number, deviation)} 1/s"
    hertz = np.sqrt(number) / (2 * np.pi)
    return f"{write_number(hertz, hertz * deviation / (2 * number))} Hz"


_UNITS = {
    "radial_clearance": ("um", 1e6, 0.0),
    "journal_diameter": ("mm", 1e3, 0.0),
    "ball_diameter": ("mm", 1e3, 0.0),
    "length": ("mm", 1e3, 0.0),
    "viscosity": ("mPa s", 1e3, 0.0),
    "slope": ("1/K", 1.0, 0.0),
    "b": ("K", 1.0, 0.0),
    "c": ("degC", 1.0, -273.15),
    "contact_angle": ("deg", 180.0 / np.pi, 0.0),
}
"""By the last part of a number's name: the unit that is shown, what SI is multiplied by, and what is added."""


def list_numbers(found: Mapping[str, Mapping[str, Any]], config: Config) -> list[dict[str, Any]]:
    """The ``physical_numbers`` (SI) of ``training.json`` or ``metrics.json`` in an engineer's units.

    Beside what they have there, each has its ``name`` (8.radial_clearance) and a ``label`` (node 8 radial clearance).
    """
    oil = None if config.machine.laws is None else config.machine.laws.oil
    reference = getattr(oil, "reference", None)
    numbers = []
    for name, number in found.items():
        where, _, what = name.partition(".")
        unit, factor, shift = _UNITS.get(what, (number["unit"].replace(" * ", " ").replace(" / ", "/"), 1.0, 0.0))
        label = (where if where == "oil" else f"node {where}") + f" {what.replace('_', ' ')}"
        if what == "viscosity" and reference is not None:
            label += f" at {write_condition('oil_temperature', reference)}"
        scaled = {key: factor * number[key] + shift for key in ("value", "guess")}
        scaled["deviation"] = factor * number["deviation"]
        numbers.append({**number, **scaled, "name": name, "label": label, "unit": unit})
    return numbers


def print_laws(config: Config, quality: Mapping[str, Any]) -> None:
    """A row a number, and what speaks for and against the laws, of a fit with bearing laws."""
    numbers = list_numbers(quality["physical_numbers"], config)
    table(*tabulate_numbers(f"{config.name}: numbers of the bearing laws (+- standard deviation)", numbers))
    for sentence in describe_law(quality, config.model.kind):
        say(f"{config.name}: {sentence}")


def tabulate_numbers(caption: str, numbers: Sequence[Mapping[str, Any]]) -> Table:
    """A row a number."""
    return Table(
        caption,
        ["number", "found", "unit", "+- %", "guess", "remark"],
        [
            [
                number["label"],
                write_number(number["value"], number["deviation"]),
                number["unit"],
                write_rough(100.0 * abs(number["deviation"] / number["value"]) if number["value"] else np.inf),
                write_number(number["guess"]),
                "" if number["determined"] else "the data do not tell it",
            ]
            for number in numbers
        ],
    ).without_blank()


def describe_law(quality: Mapping[str, Any], kind: str) -> list[str]:
    """Sentences for and against the bearing laws of a fit of model ``kind``; empty without any."""
    contradiction, law = find_contradiction(quality, kind), quality.get("law", {})
    return [
        *([] if contradiction is None else [" ".join(contradiction)]),
        *(_describe_correction(node, correction) for node, correction in quality.get("correction", {}).items()),
        *(
            f"At {write_rough(100 * share)} % of the points the bearing of node {node} lies beyond the "
            "end of its table, whose last coefficients are continued there: give a table that goes further."
            for node, share in law.get("outside_table", {}).items()
            if share > 0
        ),
    ]


def _describe_correction(
    node: str, coefficients: Mapping[str, Mapping[str, float]], least_percent: float = 0.01
) -> str:
    """How much a network corrects the law of a bearing: what stands out of its own deviation speaks against the law."""
    if all(max(entry["percent"], entry["deviation_percent"]) < least_percent for entry in coefficients.values()):
        return f"The network corrects nothing of the law of node {node}: the readings do not ask for it."
    shown = ", ".join(
        f"{name} {write_rough(entry['percent'])} +- {write_rough(entry['deviation_percent'])} %"
        for name, entry in coefficients.items()
    )
    out = list_contradicted(coefficients)
    against = f"That of {', '.join(out)} speaks against the law" if out else "None of it speaks against the law"
    return f"The network corrects the law of node {node} by {shown} (root mean square). {against}."


def tabulate_verdicts(judged: Mapping[str, Any]) -> list[dict[str, Any]]:
    """A row a coefficient."""
    return [
        {
            **{key: entry[key] for key in ("bearing", "node", "coefficient", "verdict")},
            "band_percent": _read_band(entry),
            "reason": " ".join(entry["reasons"]),
            "next": entry["next"] or "",
        }
        for entry in judged["verdicts"]
    ]


def _read_band(entry: Mapping[str, Any]) -> float:
    """Half of the 95 % band of a coefficient in percent; NaN where it was not checked."""
    percent = entry["checks"].get("band", {}).get("percent")
    return np.nan if percent is None else float(percent)


def print_verdicts(name: str, judged: Mapping[str, Any]) -> None:
    """Every coefficient, bearing and the whole, with reasons and the next step."""
    rows = [
        [
            f"node {entry['node']} {entry['coefficient']}",
            entry["verdict"],
            "" if np.isnan(band := _read_band(entry)) else write_percent(band / 100),
            entry["reasons"][0],
        ]
        for entry in judged["verdicts"]
    ]
    table(f"{name}: can it be trusted?", ["coefficient", "verdict", "+- (95 %)", "why"], rows)
    for entry in judged["bearings"]:
        say(f"{name}: bearing at node {entry['node']}: {entry['verdict']}. {entry['reason']}")
    if judged.get("supports"):
        say(f"{name}: supports: {judged['supports']}")
    whole = judged["machine"]
    say(
        f"{name}: {whole['verdict']}. {whole['reason']}"
        + (f"\nnext: {whole['next']}" if whole["next"] else "")
        + (f"\nwhat is identified: {whole['identified']}" if whole["identified"] == AS_FELT else "")
    )
    if whole["reservation"]:
        warn(f"{name}: {whole['reservation']}")
