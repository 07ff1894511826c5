"""The unbalance of every condition in each plane, polar, as a balancing engineer draws it."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np

from pipeline.balance.unbalance import Estimates
from pipeline.ingest.conventions import SourceUnits
from pipeline.reporting.blocks import BLUE, GREY, ORANGE, Axes, Curve, Figure, Panel
from pipeline.reporting.matplotlib_figures import write_figure


def draw_balance(
    path: Path, method: str, estimates: Estimates, planes: Sequence[int], source: SourceUnits, most_names: int = 12
) -> Path:
    """The unbalance of every condition in each plane, polar, as a balancing engineer draws it.

    A panel a plane: estimates with the circle that holds 95 %, and lines from the known weights to them. Conditions
    that no unbalance explains, or that contradict their weights, have another colour, and always their names; the
    others have them where there are at most ``most_names``.
    """
    values, known = source.weights(estimates.unbalance), source.weights(estimates.readings.unbalance)
    radius, remarked = 1e6 * estimates.radius, estimates.inconsistent | estimates.contradicted
    names = estimates.readings.names
    reach = 1.15 * float(np.nanmax(np.abs([*values.ravel(), *known.ravel(), 1e-9])))
    turn, panels = np.exp(2j * np.pi * np.linspace(0, 1, 181)), []
    for n, node in enumerate(planes):
        curves = _draw_grid(reach, turn)
        for c, name in enumerate(names):
            colour = ORANGE if remarked[c] else BLUE
            label = "inconsistent, or contradicts its label" if remarked[c] else f"from the vibration ({method}), 95 %"
            circle = values[c, n] + min(radius[c, n], 4 * reach) * turn
            pair = np.array([known[c, n], values[c, n]])
            texts = [name] if remarked[c] or len(names) <= most_names else []
            curves += [
                Curve(circle.real, circle.imag, "", colour, filled=True, width=0.8),
                Curve(pair.real, np.where(np.isnan(known[c, n]), np.nan, pair.imag), "", colour, width=1.0),
                Curve(pair[:1].real, pair[:1].imag, "known weight", GREY, "none", "+", size=7),
                Curve(pair[1:].real, pair[1:].imag, label, colour, "none", "o", full=True, texts=texts),
            ]
        panels.append(
            Panel(
                f"plane at node {node}: g mm and angle on the shaft",
                "",
                [Axes(curves, "")],
                equal=True,
                bare=True,
                wide=True,
            )
        )
    return write_figure(path, Figure("balance", "", panels, columns=1))


def _draw_grid(reach: float, turn: np.ndarray) -> list[Curve]:
    """Circles of equal size (each a ``turn``) with their numbers, and rays every 45 degrees."""
    step = 10 ** np.floor(np.log10(reach / 2))
    step *= next(k for k in (1, 2, 5, 10) if reach / (k * step) <= 5)
    sizes, rays = np.arange(step, reach, step), reach * np.exp(0.25j * np.pi * np.arange(8))[:, None] * [0, 1]
    lines = (*(size * turn for size in sizes), *rays)
    curves = [Curve(line.real, line.imag, "", GREY, width=0.5, alpha=0.5) for line in lines]
    ends = 0.97 * rays[:, 1]
    return [
        *curves,
        Curve(ends.real, ends.imag, "", GREY, "none", texts=[f"{angle}°" for angle in range(0, 360, 45)]),
        Curve(0 * sizes, sizes, "", GREY, "none", texts=[f"{size:g}" for size in sizes]),
    ]
