"""The sections of the report, in their order, and those that have sentences and tables alone."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import Any

import numpy as np

from pipeline.coefficients import COEFFICIENTS
from pipeline.evaluation.errors import find_contradiction, list_contradicted
from pipeline.ingest.conventions import GRAM_MILLIMETRE
from pipeline.problem.determination import read_determined
from pipeline.reporting.blocks import Block, Cell, Figure, Mark, Section, Table
from pipeline.reporting.coefficient_figures import UNITS
from pipeline.reporting.content import FitContent, ReportContent, list_reservations
from pipeline.reporting.diagnosis import list_bearings, list_determined
from pipeline.reporting.fit_tables import describe_law, list_numbers, tabulate_numbers
from pipeline.reporting.report.fit import describe_coefficients, describe_fit, describe_held_out
from pipeline.reporting.report.measured import describe_machine, describe_measured
from pipeline.reporting.report.twin import describe_modes, describe_response
from pipeline.reporting.summary import describe_data, describe_stability, draw_kind, list_critical_speeds
from pipeline.reporting.twin import summarize_modes
from pipeline.trust.judgement import AS_FELT, NO_RUN
from pipeline.write_numbers import write_number


def list_sections(content: ReportContent) -> list[Section]:
    """Those that there is something to say in."""
    fit, origin = content.fit, list(content.origin.items())
    sections: list[Section] = [
        ("answer", "In short", describe_answer(content, fit) if fit else ()),
        ("verdicts", "Can this be trusted?", describe_verdicts(content)),
        ("numbers", "Numbers of the bearing laws", describe_numbers(content, fit) if fit else ()),
        ("coefficients", "Stiffness and damping", describe_coefficients(content, fit) if fit else ()),
        ("machine", "Machine", describe_machine(content)),
        ("measured", "What was measured", describe_measured(content)),
        ("diagnosis", "Diagnosis", describe_diagnosis(content)),
        ("fit", "Fit and residuals", describe_fit(content, fit) if fit else ()),
        ("held-out", "Held-out runs and speeds", describe_held_out(content, fit) if fit else ()),
        ("modes", "Critical speeds and stability", describe_modes(content, fit, fit.twin) if fit and fit.twin else ()),
        ("response", "Unbalance response", describe_response(content, fit) if fit else ()),
        ("balancing", "Residual unbalance and correction weights", [describe_balancing(content, fit)] if fit else ()),
        ("conventions", "Conventions", [describe_conventions(content)]),
        (
            "origin",
            "Where this comes from",
            [Table("Versions, data and command", ["item", "value"], origin)],
        ),
    ]
    return [section for section in sections if section[-1]]


def describe_answer(content: ReportContent, fit: FitContent) -> list[Block]:
    """What was asked, the answer, what may be relied on and what to do next; and both kinds of coefficients, drawn."""
    config, shown, machine, values = content.config, fit.at_conditions, content.machine_verdict, []
    several = sum(map(len, shown.unknowns)) > 8  # more numbers than a paragraph can carry: the direct ones
    at = int(np.abs(shown.rpm - config.machine.prediction.speed_rpm).argmin())
    for b, (node, names) in enumerate(zip(shown.identified.nodes, shown.unknowns, strict=True)):
        told = [name for name in names if not several or name[1] == name[2]] or names
        for name in told:
            (scale, unit), place = UNITS[name[0]], (b, at, COEFFICIENTS.index(name))
            number = write_number(
                scale * float(shown.identified.values[place]), scale * float(shown.identified.spread[place])
            )
            said = " (not determined)" if shown.lost[place] else f" {number} {unit}"
            values.append(f"{f'at node {node} ' * (name == told[0])}{name}{said}")
    known = ", with one standard deviation" if shown.stated else ""
    elsewhere = " Cross-coupling, and other speeds, stand in the section Stiffness and damping." * several
    answer = f"At {write_number(shown.rpm[at], digits=6)} rpm{fit.state}{known}: {', '.join(values)}.{elsewhere}"
    if fit.twin:
        modes: Mapping[str, Any] = summarize_modes(fit.twin.behaviour["identified"], shown.rpm[at])
        critical, stable = list_critical_speeds(fit, modes), describe_stability(modes["stability"])
        answer += f" Critical speeds: {critical}. Stability: {stable}."
    felt = f" What is identified: {AS_FELT}." if machine["identified"] == AS_FELT else ""
    beyond = "".join(f" {text[0].upper()}{text[1:]}." for text in fit.beyond)
    said = f"The machine as a whole: {machine['verdict']}. {machine['reason']}{felt}{beyond}"
    steps = dict.fromkeys(
        entry["next"] for entry in (machine, *content.files.get("verdicts", {}).get("bearings", ())) if entry["next"]
    )
    rows: list[list[Cell]] = [
        [
            "What was asked?",
            f"{config.description[:1].upper()}{config.description[1:]}. Data: {describe_data(content, fit)}.",
        ],
        ["What is the answer?", answer],
        ["What may be relied on?", said if machine["verdict"] == "good" else Mark("warning", said)],
        [
            "What is to be done next?",
            " ".join(step for step in steps if step != NO_RUN or len(steps) == 1) or "These data ask for nothing more.",
        ],
    ]
    caption = "Identified coefficients over the speed; the sections below have each with its band and its reasons."
    figure = Figure("answer", caption, [replace(draw_kind(shown, letter, fit.state), legend=False) for letter in "kc"])
    return [*list_reservations(content), Table("", ["question", "answer"], rows), figure]


def describe_verdicts(content: ReportContent) -> list[Block]:
    """The verdicts on every bearing and coefficient, as stage=verdict wrote them: why, and what to do next."""
    judged = content.files.get("verdicts")
    gaps = [
        Mark(
            "warning",
            f"This report has no {'critical speeds, stability and prediction' if name == 'twin' else name}: {reason}",
        )
        for name, reason in content.missing.items()
    ]
    if not judged:
        return [*gaps, *["No verdicts were written: stage=verdict makes them."] * ("fit" not in content.missing)]
    every = judged["verdicts"]
    common = [reason for reason in every[0]["reasons"] if all(reason in entry["reasons"] for entry in every)]
    rest = [
        {**entry, "reasons": [reason for reason in entry["reasons"] if reason not in common] or ["The above."]}
        for entry in every
    ]
    return [
        *gaps,
        _list_verdicts("Bearings", judged["bearings"]),
        *["Percentages are of the coefficient; of a cross-coupled one below a tenth of the direct ones, of that tenth."]
        * any(entry["coefficient"][1] != entry["coefficient"][2] for entry in every),
        *(Mark("warning", f"Of all coefficients: {reason}") for reason in common),
        _list_verdicts("Coefficients", rest),
    ]


def _list_verdicts(caption: str, entries: Sequence[Mapping[str, Any]]) -> Table:
    """A row for all that are judged alike, for the same reason."""
    alike: dict[tuple[str, str, str], list[str]] = {}
    for entry in entries:
        why = entry.get("reason") or " ".join(entry["reasons"])
        name = f"node {entry['node']} {entry.get('coefficient', '')}".strip()
        alike.setdefault((entry["verdict"], why, entry["next"] or ""), []).append(name)
    first = {step: names[0] for (_, _, step), names in reversed(alike.items())}
    rows: list[list[Cell]] = [
        [
            ", ".join(names),
            Mark(verdict, verdict),
            why,
            step if not step or first[step] == names[0] else f"as for {first[step]}",
        ]
        for (verdict, why, step), names in alike.items()
    ]
    return Table(caption, [caption.lower().removesuffix("s"), "verdict", "why", "next step"], rows).without_blank()


def describe_numbers(content: ReportContent, fit: FitContent) -> list[Block]:
    """The numbers of the bearing laws, and what the readings say against these; nothing for a fit without laws."""
    training, kind = fit.training, content.config.model.kind
    numbers = list_numbers(training.get("physical_numbers", {}), content.config)
    if not numbers:
        return []
    corrections = training.get("correction", {})
    against = find_contradiction(training, kind) is not None or any(map(list_contradicted, corrections.values()))
    corrected = ", times what a network corrects" if corrections else ""
    return [
        f"All coefficients over speed and operating conditions follow from these numbers{corrected}.",
        tabulate_numbers("Found, +- one standard deviation", numbers),
        *(Mark("warning" if against else "", sentence) for sentence in describe_law(training, kind)),
    ]


def describe_diagnosis(content: ReportContent) -> list[Block]:
    """What the data determine before any fit: rank, condition, deviations; and what the fit found otherwise."""
    diagnosis = content.files["diagnosis"]
    noise, expected = content.config.describe_noise(), diagnosis["determined"]
    after = content.fit.training["determined"]["coefficients"] if content.fit else {}
    other = [
        f"{entry.name} at node {entry.node} is {entry.verdict.determined} (expected: {before})"
        for entry in read_determined(after)
        if (before := expected["coefficients"].get(str(entry.node), {}).get(entry.name, {}).get("verdict", ""))
        != entry.verdict.determined
    ]
    return [
        (
            f"Before the fit, at each speed by itself, at {noise} (root mean square, zero-to-peak). A fit over all "
            "speeds does better: what it was expected to reach follows below."
        ),
        *(
            Mark("warning", f"Bearing at node {node}: {bearing['reason']}")
            for node, bearing in diagnosis["bearings"].items()
            if bearing["reason"]
        ),
        list_bearings("What the readings tell of each bearing", diagnosis["bearings"]),
        list_determined(
            f"Expected standard deviation, {expected['by']} (median over the speed)",
            read_determined(expected["coefficients"]),
        ),
        *[
            "The table was made before the fit, at the coefficients that the fit starts from. At those that it found, "
            f"{'; '.join(other)}. What was found counts."
        ]
        * bool(other),
    ]


def describe_balancing(content: ReportContent, fit: FitContent) -> str | Table:
    """Residual unbalance of each plane and the weights that take it away; a sentence where none was identified."""
    uncertainty = fit.answer.uncertainty
    if uncertainty is None or not len(uncertainty.planes):
        return (
            "No residual unbalance was identified, so there are no correction weights: the configuration names no "
            "planes of it."
        )
    weights, rows = content.source.weights(uncertainty.residual_unbalance), []
    for node, weight, deviation in zip(
        uncertainty.planes, weights, uncertainty.unbalance_deviation() / GRAM_MILLIMETRE, strict=True
    ):
        size, angle = float(abs(weight)), float(np.degrees(np.angle(weight)))
        spread = float(np.degrees(np.arcsin(min(deviation / size, 1.0)))) if size > 0 else None
        amount = write_number(size, deviation)
        at, opposite = (write_number((angle + turn) % 360, spread) for turn in (0, 180))
        rows.append([f"node {node:.0f}", amount, at, amount, opposite])
    return Table(
        f"Angles are {content.counted}; +- one standard deviation. Add the correction, or remove as much at the "
        "unbalance.",
        ["plane", "unbalance, g mm", "at, deg", "correction, g mm", "at, deg (opposite)"],
        rows,
    )


def describe_conventions(content: ReportContent) -> Table:
    """Axes, rotation, amplitudes, phases, deviations."""
    rows = [
        ["Axes", "x and y span the plane across the shaft; angles are counted from x towards y."],
        ["Rotation", "The shaft turns from x towards y, counterclockwise in the figures."],
        [
            "Vectors",
            "q(t) = Re(Q e^(jwt)); time zero is a tacho pulse; a probe at the angle a shows x cos a + y sin a.",
        ],
        ["Amplitude", "Of 1X; peak-to-peak unless the unit says 0-pk (half of it)."],
        [
            "Phase",
            "Lag: rotation from the tacho pulse to the next positive peak of the signal; a lead is its opposite.",
        ],
        ["Unbalance", "F = w² m e e^(jp) [1, -j] on (x, y); p is its angle from x at the tacho pulse."],
        ["Bearings", "Force on the shaft -(K q + C q'); kxy is the force in x for a displacement in y."],
        ["Deviations", "± is one standard deviation; bands are nominal 95 % intervals (1.96 deviations)."],
        [
            "Log decrement",
            "2π times -(real part) / (imaginary part) of an eigenvalue; amplification factor: π over it.",
        ],
    ]
    said = content.files.get("ingest", {}).get("conventions")
    read = [["Recordings", f"Read as {said}."]] * bool(said)
    return Table("How the numbers are meant", ["subject", "meaning"], rows + read)
