"""Conventions of all numbers, and where they come from: versions, hashes of the data, the command."""

from __future__ import annotations

from pipeline.reporting.report.content import ReportContent
from pipeline.reporting.report.section import Section, Table


def describe_conventions(content: ReportContent) -> Section:
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
    if said:
        rows.append(["Recordings", f"Read as {said}."])
    return Section("conventions", "Conventions", (Table("How the numbers are meant", ["", "meaning"], rows),))


def describe_origin(content: ReportContent) -> Section:
    """Command, versions and hashes."""
    rows = [[name, value] for name, value in content.origin.items()]
    return Section("origin", "Where this comes from", (Table("Versions, data and command", ["", "value"], rows),))
