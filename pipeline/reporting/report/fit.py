"""How the model follows the readings: each probe, what was held out, and the tests of the fit."""

from __future__ import annotations

import numpy as np

from pipeline.reporting.figure import RPM, Axes, Curve, Figure, Panel, mark
from pipeline.reporting.fit_tables import list_parameters
from pipeline.reporting.measured_figures import AMPLITUDE
from pipeline.reporting.report.content import FitContent, ReportContent
from pipeline.reporting.tables import Block, Paragraph, Section, Table
from pipeline.trust.misfit import measure_misfit
from pipeline.write_numbers import count, write_number


def describe_fit(content: ReportContent, fit: FitContent) -> Section:
    """Readings and model of every probe over speed with their residuals."""
    fitted = [r for r in content.shown_runs if not content.held_out(r)]
    blocks = (Paragraph(_write_quality(content)), _list_probes(content, fit), _draw(content, fit, fitted, "fit"))
    return Section("fit", "Fit and residuals", (*blocks, *_list_parameters(content)))


def describe_held_out(content: ReportContent, fit: FitContent) -> Section:
    """Runs and speeds that the fit did not see."""
    rows = []
    for what, entry in content.files.get("metrics", {}).get("held_out", {}).items():
        errors = [write_number(entry[f"{whose}_error_percent"], digits=3) for whose in ("model", "rival")]
        rows.append([what, errors[0], entry["rival"], errors[1]])
    held = [r for r in content.shown_runs if content.held_out(r)]
    text = "The fit did not see these readings. Beside the model stands what needs no bearing model at all."
    if not rows and not held:
        text = "No run and no speed was held out (training.holdout_runs, training.holdout_every)."
    header = ["held out", "model, error %", "without a model", "its error, %"]
    table = Table("Root mean square of the error over that of the readings", header, rows)
    blocks: list[Block] = [Paragraph(text), *[table] * bool(rows)]
    blocks += [_draw(content, fit, held, "held-out")] if held else []
    return Section("held-out", "Held-out runs and speeds", tuple(blocks))


def _write_quality(content: ReportContent) -> str:
    training = content.files.get("training", {})
    quality = training.get("fit")
    outcome = f"The fit ended as: {str(training.get('outcome', 'unknown')).replace('_', ' ')}."
    if not quality:
        residual = training.get("residual", {}).get("mean_over_bearing_force")
        share = write_number(residual and 100 * residual, digits=2)
        left = f"It leaves {share} % of the bearing forces over (mean)."
        return f"{outcome} {left} Its loss weighs no noise, so there is no chi-square."
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
    rows, fitted = [], [r for r in range(len(content.dataset.runs)) if not content.held_out(r)]
    mask = content.dataset.present[:, fitted]
    for probe in content.shown_probes:
        measured = probe.read(content.dataset.displacement[..., fitted])
        rest = measured - probe.read(fit.predicted[..., fitted])
        percent = 100 * np.linalg.norm(rest[mask]) / np.linalg.norm(measured)
        over = ""
        if content.weighs_noise:
            squared = np.abs(rest / probe.read_noise(fit.noise[..., fitted]))[mask] ** 2
            over = write_number(float(np.sqrt(squared.mean())), digits=3)
        rows.append([probe.name, write_number(float(percent), digits=3), over])
    header = ["probe", "residual, % of the readings", "residual over its noise"]
    return Table("Fitted runs, root mean square over speeds and runs", header, rows).without_blank()


def _draw(content: ReportContent, fit: FitContent, runs: list[int], name: str) -> Figure:
    stated, panels = content.weighs_noise, []
    for probe in content.shown_probes:
        above, below = [], []
        every = probe.read(content.dataset.displacement), probe.read(fit.predicted), probe.read_noise(fit.noise)
        for r, points, traced in content.traces(*runs):
            measured, predicted, noise = (vectors[:, r] for vectors in every)
            usual = np.linalg.norm(measured) / np.count_nonzero(measured) ** 0.5 / 100
            size = np.abs(measured - predicted) / (noise if stated else usual)
            look, rpm = dict(traced), content.rpm[points]
            run = look.pop("label")
            above.append(mark(rpm, np.abs(measured[points]), f"{run} measured", look["colour"], count=40))
            above.append(Curve(rpm, np.abs(predicted[points]), f"{run} model", **look))
            below.append(Curve(rpm, size[points], "", **look))
        unit = "residual / noise" if stated else "residual (%)"
        axes = [Axes(above, AMPLITUDE, quantity="amplitude"), Axes(below, unit)]
        panels.append(Panel(probe.name, RPM, axes))
    caption = "Above, amplitudes: markers measured, lines the model. Below, the size of the complex residual "
    caption += "over the root mean square of its noise." if stated else "in percent of the root mean square reading."
    return Figure(name, caption, panels)


def _list_parameters(content: ReportContent) -> list[Table]:
    """Model parameters that were fitted with the coefficients, before and after."""
    fitted = content.tables.get("model_parameters")
    if fitted is None:
        return []
    names = [
        f"{str(kind).replace('_', ' ')} {of}".strip() for kind, of in zip(fitted["kind"], fitted["of"], strict=True)
    ]
    return [list_parameters("Uncertain numbers of the model, change against what was stated", names, fitted)]
