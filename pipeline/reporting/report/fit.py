"""How the model follows the readings: each probe, what was held out, and the tests of the fit."""

from __future__ import annotations

import numpy as np

from pipeline.reporting.report.content import FitContent, ReportContent, View, count
from pipeline.reporting.report.figure import Axes, Curve, Figure, Panel
from pipeline.reporting.report.measured import AMPLITUDE, RPM, vectors_of
from pipeline.reporting.report.section import Block, Paragraph, Section, Table, write_number
from pipeline.trust.misfit import measure_misfit


def describe_fit(content: ReportContent) -> Section | None:
    """Readings and model of every probe over speed with their residuals; None without a fit."""
    fit = content.fit
    if fit is None:
        return None
    blocks: list[Block] = [Paragraph(_write_quality(content)), _list_probes(content, fit)]
    fitted = [r for r in content.shown_runs if not content.held_out(r)]
    return Section(
        "fit", "Fit and residuals", (*blocks, _draw(content, fit, fitted, "fit"), *_list_parameters(content))
    )


def describe_held_out(content: ReportContent) -> Section | None:
    """Runs and speeds that the fit did not see; None without a fit."""
    fit = content.fit
    if fit is None:
        return None
    held_out = content.files.get("metrics", {}).get("held_out", {})
    rows = [
        [
            what,
            write_number(entry["model_error_percent"], digits=3),
            entry["rival"],
            write_number(entry["rival_error_percent"], digits=3),
        ]
        for what, entry in held_out.items()
    ]
    held = [r for r in content.shown_runs if content.held_out(r)]
    if not rows and not held:
        text = "No run and no speed was held out (training.holdout_runs, training.holdout_every)."
        return Section("held-out", "Held-out runs and speeds", (Paragraph(text),))
    text = "The fit did not see these readings. Beside the model stands what needs no bearing model at all."
    header = ["held out", "model, error %", "without a model", "its error, %"]
    table = Table("Root mean square of the error over that of the readings", header, rows)
    figures = [_draw(content, fit, held, "held-out")] if held else []
    return Section("held-out", "Held-out runs and speeds", (Paragraph(text), *([table] if rows else []), *figures))


def _write_quality(content: ReportContent) -> str:
    training = content.files.get("training", {})
    quality = training.get("fit")
    outcome = f"The fit ended as: {str(training.get('outcome', 'unknown')).replace('_', ' ')}."
    if not quality:
        residual = training.get("residual", {}).get("mean_over_bearing_force")
        said = "" if residual is None else f" It leaves {100 * residual:.2g} % of the bearing forces over (mean)."
        return f"{outcome}{said} Its loss weighs no noise, so there is no chi-square."
    square, white, misfit = quality["chi_square"], quality["whiteness"], measure_misfit(quality)
    ratio = float(np.sqrt(square["value"] / square["expected"]))
    text = (
        f"{outcome} Chi-square is {square['value']:.0f}, where {square['expected']:.0f} is expected: the readings lie "
        f"{ratio:.2f} times as far off as their noise. Neighbouring residuals correlate by "
        f"{write_number(white['autocorrelation'], digits=2)} ({write_number(white['over_its_deviation'], digits=2)} "
        "deviations). "
    )
    explained = f"{misfit.sentence[0].upper()}{misfit.sentence[1:]}."
    explained += "" if misfit.explained() else " What is left is systematic, and the deviations are too small."
    return text + f"{explained} {count(quality['bad_points'], 'reading')} lie beyond 4 deviations."


def _list_probes(content: ReportContent, fit: FitContent) -> Table:
    """Root mean square of the residual of each probe, in percent and in deviations."""
    rows, present = [], content.dataset.present
    stated = "fit" in content.files.get("training", {})
    held = np.array([content.held_out(r) for r in range(len(content.dataset.runs))])
    for probe in content.shown_probes:
        measured = content.dataset.displacement[..., ~held].transpose(0, 2, 1) @ probe.weights
        rest = measured - fit.predicted[..., ~held].transpose(0, 2, 1) @ probe.weights
        mask = present[:, ~held]
        percent = 100 * np.linalg.norm(rest[mask]) / np.linalg.norm(measured)
        cells = [probe.name, f"{percent:.3g}"]
        if stated:
            cells.append(f"{np.sqrt((np.abs(rest / _noise(fit, probe)[:, ~held])[mask] ** 2).mean()):.3g}")
        rows.append(cells)
    header = ["probe", "residual, % of the readings", *(["residual over its noise"] if stated else [])]
    return Table("Fitted runs, root mean square over speeds and runs", header, rows)


def _noise(fit: FitContent, probe: View) -> np.ndarray:
    """(S, R) m, root mean square of the noise of a probe's vector."""
    return np.asarray(np.sqrt(fit.noise.transpose(0, 2, 1) ** 2 @ probe.weights**2))


def _draw(content: ReportContent, fit: FitContent, runs: list[int], name: str) -> Figure:
    stated = "fit" in content.files.get("training", {})
    panels = []
    for probe in content.shown_probes:
        above, below = [], []
        for r in runs:
            measured, predicted = vectors_of(content, probe, r), fit.predicted[..., r] @ probe.weights
            rest = np.abs(measured - predicted)
            usual = np.linalg.norm(np.abs(measured)) / np.count_nonzero(measured) ** 0.5
            size = rest / _noise(fit, probe)[:, r] if stated else 100 * rest / usual
            for points, traced in content.traces(r):
                look, rpm = dict(traced), content.rpm[points]
                run, shown = look.pop("label"), slice(None, None, max(1, len(points) // 40))
                seen = np.abs(measured[points])[shown]
                above.append(Curve(rpm[shown], seen, f"{run} measured", look["colour"], "none", "o"))
                above.append(Curve(rpm, np.abs(predicted[points]), f"{run} model", **look))
                below.append(Curve(rpm, size[points], "", **look))
        unit = "residual / noise" if stated else "residual (%)"
        axes = (Axes(tuple(above), AMPLITUDE, amplitude=True), Axes(tuple(below), unit))
        panels.append(Panel(probe.name, RPM, axes))
    caption = "Above, amplitudes: markers measured, lines the model. Below, the size of the complex residual "
    caption += "over the root mean square of its noise." if stated else "in percent of the root mean square reading."
    return Figure(name, caption, tuple(panels))


def _list_parameters(content: ReportContent) -> list[Table]:
    """Model parameters that were fitted with the coefficients, before and after."""
    table = content.tables.get("model_parameters")
    if table is None or not len(table["kind"]):
        return []
    rows = []
    for i, kind in enumerate(table["kind"]):
        value, before, after = (float(table[key][i]) for key in ("value", "prior_std", "std"))
        unit = str(table["unit"][i])
        if not unit:
            value, before, after, unit = 100 * value, 100 * before, 100 * after, "%"
        elif unit == "rad":
            value, before, after = np.degrees([value, before, after]).tolist()
            unit = "deg"
        elif unit == "m":
            value, before, after, unit = 1e6 * value, 1e6 * before, 1e6 * after, "µm"
        label = f"{str(kind).replace('_', ' ')} {table['of'][i]}".strip()
        rows.append([label, unit, f"± {before:.3g}", write_number(value, after), f"{value / before:.2f}"])
    header = ["parameter", "unit", "before the fit", "found", "found over its tolerance"]
    return [Table("Uncertain numbers of the model, change against what was stated", header, rows)]
