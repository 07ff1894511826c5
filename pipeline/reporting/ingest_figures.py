"""Figures of measured vibration, before any fit: Bode plots and orbits, a colour and a line style a run."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from pipeline.data.dataset import DIRECTIONS, VibrationDataset
from pipeline.data.operating import name_state
from pipeline.data.vibration_files import to_rpm
from pipeline.reporting.figures import BLACK, BLUE, GREEN, GREY, MARKERS, MICROMETRES, ORANGE, PURPLE, SKY, open_figure
from pipeline.reporting.state_figures import colour_states, pick_states

_COLOURS = (BLUE, ORANGE, GREEN, PURPLE, SKY, BLACK)
_LINES = ("-", "--", "-.", ":")
_ORBIT = np.linspace(0.0, 0.94, 200)
"""Parts of a turn, from the tacho pulse."""
_ARROW = 60
"""Where on the orbit its arrow head is."""


def _choose_looks(dataset: VibrationDataset, baseline: str | None) -> list[dict[str, Any]]:
    """Line properties by run: the baseline is thin and grey."""
    looks: list[dict[str, Any]] = []
    for run in dataset.runs:
        i = sum(look["color"] != GREY for look in looks)
        look = {"color": _COLOURS[i % len(_COLOURS)], "ls": _LINES[i % len(_LINES)], "lw": 1.6, "label": run}
        if run == baseline:
            look |= {"color": GREY, "ls": ":", "lw": 1.2, "label": f"{run} (baseline)"}
        looks.append(look)
    return looks


def _list_curves(dataset: VibrationDataset, baseline: str | None) -> list[tuple[int, np.ndarray, dict[str, Any]]]:
    """Run, points by ascending speed, and line properties of each curve: a run at a state of its conditions.

    With several states the colour is that of the state, the line that of the run.
    """
    looks, states = _choose_looks(dataset, baseline), pick_states(dataset.speeds, dataset.operating)
    colours, curves = colour_states(len(states)), []
    for r, look in enumerate(looks):
        for (label, points), colour in zip(states, colours, strict=True):
            measured = points[dataset.present[points, r]]
            state_look = {"color": colour, "label": f"{look['label']}, {label}"} if len(states) > 1 else {}
            if len(measured):
                curves.append((r, measured, look | state_look))
    return curves


def _place_legend(drawn: Any, axes: np.ndarray) -> None:
    every = {label: handle for ax in axes.flat for handle, label in zip(*ax.get_legend_handles_labels(), strict=True)}
    drawn.legend(every.values(), every.keys(), loc="outside upper center", ncols=min(4, len(every)))


def draw_bode(
    path: Path, dataset: VibrationDataset, baseline: str | None, probes: Mapping[str, tuple[int, float]]
) -> Path:
    """Bode plots of every probe and run, as an analyser shows them: peak-to-peak over phase lag.

    ``probes`` are node and angle (degrees) by name; the ``dataset`` has x and y of their nodes.
    """
    rows, rpm = (len(probes) + 1) // 2, to_rpm(dataset.speeds)
    ratios = {"height_ratios": [1.6, 1.0] * rows}
    few = "o" if len(rpm) <= MARKERS else None
    with open_figure(path, 2 * rows, 2, 10.5, 0.6 + 4.4 * rows, sharex=True, gridspec_kw=ratios) as axes:
        for i, (name, (node, angle)) in enumerate(probes.items()):
            above, below = axes[2 * (i // 2), i % 2], axes[2 * (i // 2) + 1, i % 2]
            seen = dataset.project(node, angle)  # (S, R)
            for r, points, look in _list_curves(dataset, baseline):
                mark = {"marker": few, "ms": 4, "mfc": "none"}
                above.plot(rpm[points], 2 * MICROMETRES * np.abs(seen[points, r]), **look, **mark)
                below.plot(rpm[points], find_lag(seen[points, r]), **look, **mark)
            above.set_title(f"{name}: node {node}, {angle:g}°", loc="left")
            above.set_ylabel("amplitude (µm pk-pk)")
            below.set_ylabel("phase lag (deg)")
            below.tick_params(labelbottom=True)
            below.set_xlabel("rotor speed (rpm)")
        for ax in axes[-2:, 1][: 2 * (len(probes) % 2)]:
            ax.set_visible(False)
        _place_legend(axes[0, 0].figure, axes)
    return path


def find_lag(vectors: np.ndarray) -> np.ndarray:
    """(S,) phase lag in degrees of V = A e^{-j lag}, without jumps, from 0 to 360 at the first speed."""
    lag = np.unwrap(-np.angle(vectors))
    return np.asarray(np.degrees(lag - 2 * np.pi * np.floor(lag[0] / (2 * np.pi))))


def draw_measured_orbits(path: Path, dataset: VibrationDataset, baseline: str | None) -> Path:
    """Orbits of every node at several speeds, that of the largest amplitude among them; a dot at the pulse.

    An arrow shows the sense in which each is run through; the rotor turns counterclockwise.
    """
    nodes = sorted({node for node, _ in dataset.channels})
    picked = pick_speeds(dataset)
    rpm = to_rpm(dataset.speeds)
    turn = np.exp(2j * np.pi * _ORBIT)
    width, height = max(5.0, 3.1 * len(picked)), 0.9 + 3.1 * len(nodes)
    with open_figure(path, len(nodes), len(picked), width, height) as axes:
        for n, node in enumerate(nodes):
            places = [dataset.channels.index((node, angle)) for angle in DIRECTIONS.values()]
            for s, at in enumerate(picked):
                ax = axes[n, s]
                for r, look in enumerate(_choose_looks(dataset, baseline)):
                    if not dataset.present[at, r]:
                        continue
                    x, y = (MICROMETRES * (dataset.displacement[at, place, r] * turn).real for place in places)
                    ax.plot(x, y, **look)
                    size = 4 if look["color"] == GREY else 5.5
                    ax.plot(x[:1], y[:1], ls="", marker="o", ms=size, color=look["color"])
                    arrow = {"arrowstyle": "-|>", "color": look["color"], "lw": 0, "mutation_scale": 17}
                    ax.annotate("", (x[_ARROW + 2], y[_ARROW + 2]), (x[_ARROW], y[_ARROW]), arrowprops=arrow)
                ax.locator_params(nbins=5)
                state = name_state({name: values[at] for name, values in dataset.operating.items()})
                ax.set_title(f"node {node}, {rpm[at]:.5g} rpm" + (f"\n{state}" if state else ""))
                if n == len(nodes) - 1:
                    ax.set_xlabel("x (µm)")
            axes[n, 0].set_ylabel("y (µm)")
        axes[0, 0].plot(
            [], [], ls="", marker="o", ms=5.5, color=BLACK, label="at the tacho pulse; the rotor turns counterclockwise"
        )
        _place_legend(axes[0, 0].figure, axes)
    return path


def pick_speeds(dataset: VibrationDataset) -> list[int]:
    """Up to four indices: first, last, the largest amplitude, and one half way along the longest gap."""
    count = len(dataset.speeds)
    peak = int(np.abs(dataset.displacement).max(axis=(1, 2)).argmax())
    picked = sorted({0, peak, count - 1})
    while len(picked) < min(4, count):
        gaps = np.diff(picked)
        widest = int(gaps.argmax())
        picked = sorted({*picked, picked[widest] + int(gaps[widest]) // 2})
    return picked


def draw_records(path: Path, dataset: VibrationDataset, probes: Sequence[str]) -> Path:
    """The vector of every record in the complex plane, a panel a probe (along) and speed (down); S, P, R as above."""
    rpm, (n_speeds, n_probes, _) = to_rpm(dataset.speeds), dataset.displacement.shape
    with open_figure(path, n_speeds, n_probes, 3.0 * n_probes, 0.4 + 3.0 * n_speeds) as axes:
        for s in range(n_speeds):
            for p, name in enumerate(probes):
                vectors, ax = MICROMETRES * dataset.displacement[s, p], axes[s, p]
                reach = 1.1 * MICROMETRES * np.abs(dataset.displacement[s]).max()
                ax.set(xlim=(-reach, reach), ylim=(-reach, reach), aspect="equal")
                ax.plot(vectors.real, vectors.imag, "o", ms=3, mfc="none", color=BLUE)
                ax.axhline(0.0, color=GREY, lw=0.6)
                ax.axvline(0.0, color=GREY, lw=0.6)
                ax.set_title(f"{name}, {rpm[s]:.0f} rpm", loc="left")
                ax.set_xlabel("real part (µm)")
            axes[s, 0].set_ylabel("imaginary part (µm)")
    return path
