"""Figures of data with operating conditions: a line a state, and no line that has a speed twice."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from warm_rotor import CELSIUS, SPEEDS, warm_bearings, warm_machine

from pipeline.reporting import ingest_figures, state_figures
from pipeline.reporting.ingest_figures import draw_bode
from pipeline.reporting.state_figures import draw_states, pick_states

SPEED_RPM = SPEEDS * 30 / np.pi
NAMES = [["kxx", "kyy", "cxx"], ["kxx", "cyy"]]


@pytest.fixture
def drawn(monkeypatch: pytest.MonkeyPatch) -> list[np.ndarray]:
    """The axes of the figures that are opened."""
    seen: list[np.ndarray] = []
    opened = state_figures.open_figure

    @contextmanager
    def watch(*arguments: Any, **options: Any) -> Iterator[np.ndarray]:
        with opened(*arguments, **options) as axes:
            seen.append(axes)
            yield axes

    for module in (state_figures, ingest_figures):
        monkeypatch.setattr(module, "open_figure", watch)
    return seen


def lines_of(axes: np.ndarray) -> list[np.ndarray]:
    """What each line has along x."""
    return [np.asarray(line.get_xdata(), dtype=float) for ax in axes.flat for line in ax.lines]


def table() -> Any:
    return warm_bearings(np.tile(SPEEDS, 3), np.repeat(CELSIUS, len(SPEEDS)))


@pytest.mark.slow
def test_each_state_has_a_line_of_ascending_speed(drawn: list[np.ndarray], tmp_path: Path) -> None:
    bearings = table()
    draw_states(tmp_path / "a.png", bearings, None, NAMES, 0.1 * np.abs(bearings.values))
    lines = lines_of(drawn[0])
    assert len(lines) == 5 * len(CELSIUS)
    for line in lines:
        np.testing.assert_allclose(line, SPEED_RPM)
    legend = drawn[0][0, 0].figure.legends[0]
    assert [text.get_text() for text in legend.get_texts()] == ["45 degC", "55 degC", "65 degC", "nominal 95 %"]


@pytest.mark.slow
def test_one_letter_has_the_errors_below(drawn: list[np.ndarray], tmp_path: Path) -> None:
    bearings = table()
    modelled = replace(bearings, values=1.02 * bearings.values)
    draw_states(tmp_path / "k.png", bearings, modelled, NAMES, None, "k")
    assert drawn[0].shape == (2, 3)  # three stiffnesses, and their errors
    for ax in drawn[0][1]:
        for line in ax.lines:
            np.testing.assert_allclose(line.get_ydata(), 100 * (1 - 1 / 1.02))
    draw_states(tmp_path / "c.png", bearings, modelled, [["kxx"], ["kyy"]], None, "c")
    titles = [ax.get_title() for ax in drawn[1].flat]
    assert titles == [f"{name}, node {node}, known" for node in (0, 5) for name in ("cxx", "cyy")]


def test_of_many_states_some_are_drawn_the_first_and_last_among_them() -> None:
    celsius = np.repeat(np.arange(20.0, 60.0, 2.0), 2)
    states = pick_states(np.tile([1.0, 2.0], 20), {"oil_temperature": celsius + 273.15})
    assert len(states) == state_figures.MOST_STATES
    assert states[0][0] == "20 degC"
    assert states[-1][0] == "58 degC"


@pytest.mark.slow
def test_bode_plots_have_a_line_a_run_and_state_where_it_was_measured(drawn: list[np.ndarray], tmp_path: Path) -> None:
    data = warm_machine()[0].dataset
    channels = tuple((node, angle) for node in (0, 5) for angle in (0.0, 90.0))
    present = np.ones((len(data.speeds), 2), dtype=bool)
    present[: len(SPEEDS), 1] = False  # the second run was not made at 45 degC
    data = replace(data, channels=channels, present=present)
    draw_bode(tmp_path / "bode.png", data, None, {"left": (0, 30.0)})
    above = drawn[0][0, 0]
    assert [line.get_label() for line in above.lines] == [
        *(f"a, {state}" for state in ("45 degC", "55 degC", "65 degC")),
        *(f"b, {state}" for state in ("55 degC", "65 degC")),
    ]
    for line in above.lines:
        np.testing.assert_allclose(line.get_xdata(), SPEED_RPM)
