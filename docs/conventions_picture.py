"""Draws the conventions of angles, phases and runout: `python docs/conventions_picture.py`."""

from __future__ import annotations

import sys
from pathlib import Path
from typing import Any

import numpy as np

PICTURE = Path(__file__).resolve().parent / "figures" / "conventions.png"
BLUE, ORANGE, GREEN, PURPLE, GREY = "#0072B2", "#D55E00", "#009E73", "#CC79A7", "#555555"
PROBES = {"probe at 45°": 45.0, "probe at 135°": 135.0}
TACHO, WEIGHT = 0.0, 60.0
"""Degrees: the tacho probe from x, and a weight on the shaft from the mark, with the rotation."""
LAG = 110.0
"""Degrees from the pulse to the next positive peak of the probe at 45 degrees."""


def point(angle: float, radius: float) -> tuple[float, float]:
    """Where an angle in degrees from x towards y lies at a radius."""
    return radius * np.cos(np.radians(angle)), radius * np.sin(np.radians(angle))


def arrow(axes: Any, start: tuple[float, float], end: tuple[float, float], colour: str) -> None:
    """An arrow of one colour."""
    shape = {"arrowstyle": "-|>", "color": colour, "lw": 1.8, "shrinkA": 0, "shrinkB": 0, "mutation_scale": 14}
    axes.annotate("", xy=end, xytext=start, arrowprops=shape)


def arc(axes: Any, low: float, high: float, radius: float, colour: str) -> None:
    """An arc from one angle to another in degrees, with a head at its end."""
    along = np.linspace(low, high - 3, 60)
    axes.plot(*point(along, radius), color=colour, lw=1.8)  # type: ignore[arg-type]
    arrow(axes, point(high - 4, radius), point(high, radius), colour)


def draw_section(axes: Any) -> None:
    """The shaft as the last node sees it: axes, rotation, gravity, probes, tacho and weight."""
    from matplotlib.patches import Circle

    axes.add_patch(Circle((0, 0), 1.0, facecolor="#EEEEEE", edgecolor=GREY, lw=1.5))
    arrow(axes, (0, 0), (2.35, 0), GREY)
    arrow(axes, (0, 0), (0, 2.35), GREY)
    axes.text(2.4, -0.05, "x", ha="left", va="center", fontsize=13)
    axes.text(0, 2.42, "y", ha="center", va="bottom", fontsize=13)
    axes.plot(0, 0, "o", ms=5, color=GREY)
    axes.text(-0.1, -0.4, "z, towards you", ha="center", va="top", fontsize=9, color=GREY)
    arc(axes, 150, 260, 1.3, BLUE)
    axes.text(*point(200, 1.42), "rotation,\nfrom x to y", ha="right", va="center", color=BLUE, fontsize=9)
    for name, angle in PROBES.items():
        axes.plot(*zip(point(angle, 1.12), point(angle, 1.75), strict=True), color=GREEN, lw=8, solid_capstyle="butt")
        axes.text(*point(angle, 1.98), name, ha="center", va="bottom", color=GREEN, fontsize=9)
    axes.plot(*zip(point(TACHO, 1.12), point(TACHO, 1.75), strict=True), color=PURPLE, lw=8, solid_capstyle="butt")
    axes.text(1.15, -0.2, "tacho at T = 0°", ha="left", va="top", color=PURPLE, fontsize=9)
    axes.plot(*point(TACHO, 0.96), "s", ms=9, color=PURPLE)
    axes.text(0.9, -0.16, "mark", ha="right", va="top", color=PURPLE, fontsize=9)
    axes.plot(*point(TACHO + WEIGHT, 0.86), "o", ms=11, color=ORANGE)
    arc(axes, TACHO + 4, TACHO + WEIGHT - 8, 0.62, ORANGE)
    axes.text(*point(28, 0.76), "s", color=ORANGE, fontsize=12, ha="center", va="center")
    axes.text(0.08, 1.06, "weight", ha="left", va="bottom", color=ORANGE, fontsize=9)
    arrow(axes, (-2.3, -1.5), (-2.3, -2.2), GREY)
    axes.text(-2.15, -1.85, "gravity of ROSS's\nbearing models: -y", ha="left", va="center", color=GREY, fontsize=9)
    axes.text(
        0.2,
        -1.85,
        "p = T + s, from x\n(shaft_angle: with_rotation)",
        ha="left",
        va="center",
        color=ORANGE,
        fontsize=9,
    )
    axes.set(xlim=(-2.7, 2.7), ylim=(-2.3, 2.7), aspect="equal", title="Seen from the last node, at the pulse")
    axes.axis("off")


def draw_signals(axes: Any) -> None:
    """The tacho and one probe over two turns, with lag and lead."""
    turn = np.linspace(-180, 540, 1441)
    pulse = np.where(np.mod(turn, 360) < 40, 0.6, 0.0) + 1.6
    axes.plot(turn, pulse, color=PURPLE, lw=1.5)
    axes.plot(turn, np.cos(np.radians(turn - LAG)), color=GREEN, lw=1.8)
    axes.axhline(0, color="#CCCCCC", lw=0.8, zorder=0)
    for at in (0, 360):
        axes.axvline(at, color=PURPLE, lw=0.9, ls=":")
    for at, colour in ((LAG, ORANGE), (LAG - 360, BLUE), (LAG + 360, BLUE)):
        axes.axvline(at, color=colour, lw=0.9, ls=":")
    arrow(axes, (0, 1.2), (LAG, 1.2), ORANGE)
    axes.text(LAG / 2, 1.24, f"lag {LAG:.0f}°", ha="center", va="bottom", color=ORANGE, fontsize=10)
    arrow(axes, (360, -1.25), (LAG, -1.25), BLUE)
    axes.text((360 + LAG) / 2, -1.3, f"lead {360 - LAG:.0f}°", ha="center", va="top", color=BLUE, fontsize=10)
    axes.annotate("", xy=(LAG, 1), xytext=(LAG, 0), arrowprops={"arrowstyle": "<->", "color": GREY})
    axes.text(LAG + 4, 0.12, "A, zero-\nto-peak", color=GREY, ha="left", fontsize=9)
    axes.text(-170, 1.72, "tacho,\nedge: rising", color=PURPLE, fontsize=9, va="bottom")
    axes.text(-170, 0.55, "probe", color=GREEN, fontsize=9)
    axes.set(xlim=(-180, 540), ylim=(-1.75, 2.6), yticks=[], xlabel="rotation of the shaft, degrees from the pulse")
    axes.set_xticks(range(-180, 541, 180))
    axes.set_title("Phase: $V = A\\,e^{-j\\,lag} = A\\,e^{+j\\,lead}$")
    for side in ("left", "right", "top"):
        axes.spines[side].set_visible(False)


def draw_runout(axes: Any) -> None:
    """Vectors of one probe: what it reads is vibration and runout."""
    runout, vibration = np.array([0.75, 0.35]), np.array([0.6, -1.5])
    arrow(axes, (0, 0), tuple(runout), GREY)
    arrow(axes, tuple(runout), tuple(runout + vibration), GREEN)
    arrow(axes, (0, 0), tuple(runout + vibration), ORANGE)
    axes.text(0.3, 0.36, "runout: what it reads\nat slow roll", color=GREY, ha="center", va="bottom", fontsize=9)
    axes.text(1.1, -0.3, "vibration V\n(subtract slow_roll)", color=GREEN, ha="left", va="center", fontsize=9)
    axes.text(0.45, -0.75, "what the probe\nreads at speed", color=ORANGE, ha="right", va="center", fontsize=9)
    axes.axhline(0, color="#CCCCCC", lw=0.8, zorder=0)
    axes.axvline(0, color="#CCCCCC", lw=0.8, zorder=0)
    axes.set(xlim=(-0.9, 2.3), ylim=(-1.5, 1.1), aspect="equal", xlabel="real part", ylabel="imaginary part")
    axes.set(xticks=[], yticks=[], title="Runout of one probe")


def draw(path: Path) -> None:
    """Write the picture."""
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    drawn = Figure(figsize=(9.5, 9.2), layout="constrained")
    FigureCanvasAgg(drawn)
    places = drawn.subplot_mosaic([["section", "runout"], ["signals", "signals"]], width_ratios=[1.2, 1])
    draw_section(places["section"])
    draw_signals(places["signals"])
    draw_runout(places["runout"])
    path.parent.mkdir(parents=True, exist_ok=True)
    drawn.savefig(path, dpi=110)


if __name__ == "__main__":
    draw(Path(sys.argv[1]) if sys.argv[1:] else PICTURE)
