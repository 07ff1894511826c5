"""Figures of data with operating conditions: a line a state, and no line that has a speed twice."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from warm_rotor import CELSIUS, SPEEDS, warm_bearings, warm_machine

from pipeline.reporting import coefficient_figures, measured_figures
from pipeline.reporting.blocks import Curve, Figure
from pipeline.reporting.coefficient_figures import BAND, Coefficients, draw_coefficients, pick_states
from pipeline.reporting.matplotlib_figures import write_figure
from pipeline.reporting.measured_figures import draw_bode

SPEED_RPM = SPEEDS * 30 / np.pi
NAMES = [["kxx", "kyy", "cxx"], ["kxx", "cyy"]]


@pytest.fixture
def drawn(monkeypatch: pytest.MonkeyPatch) -> list[Figure]:
    """The figures that are written."""
    seen: list[Figure] = []

    def write(path: Path, figure: Figure) -> Path:
        seen.append(figure)
        return write_figure(path, figure)

    for module in (coefficient_figures, measured_figures):
        monkeypatch.setattr(module, "write_figure", write)
    return seen


def lines_of(figure: Figure, row: int = 0) -> list[Curve]:
    """What is drawn as a line or as markers in the axes of this row of each panel."""
    curves = [curve for panel in figure.panels for curve in panel.axes[row].curves if curve.shown and len(curve.x)]
    return [curve for curve in curves if curve.dash != "none" or curve.marker]


def table() -> Any:
    return warm_bearings(np.tile(SPEEDS, 3), np.repeat(CELSIUS, len(SPEEDS)))


@pytest.mark.slow
def test_each_state_has_a_line_of_ascending_speed(drawn: list[Figure], tmp_path: Path) -> None:
    bearings = replace(table(), deviation=0.1 * np.abs(table().values))
    draw_coefficients(tmp_path / "a.png", Coefficients(bearings, None, NAMES))
    lines = lines_of(drawn[0])
    assert len(lines) == 5 * len(CELSIUS)
    for line in lines:
        np.testing.assert_allclose(line.x, SPEED_RPM)
    assert [key.label for key in drawn[0].legend()] == ["45 degC", "55 degC", "65 degC", BAND]


@pytest.mark.slow
def test_one_letter_has_the_errors_below(drawn: list[Figure], tmp_path: Path) -> None:
    bearings = table()
    modelled = replace(bearings, values=1.02 * bearings.values)
    draw_coefficients(tmp_path / "k.png", Coefficients(bearings, modelled, NAMES), "k")
    assert [len(panel.axes) for panel in drawn[0].panels] == [2, 2, 2]  # three stiffnesses, and their errors
    errors = lines_of(drawn[0], 1)
    assert len(errors) == 3 * len(CELSIUS)
    for line in errors:
        np.testing.assert_allclose(line.y, 100 * (1 - 1 / 1.02))
    draw_coefficients(tmp_path / "c.png", Coefficients(bearings, modelled, [["kxx"], ["kyy"]]), "c")
    assert [panel.title for panel in drawn[1].panels] == [
        f"{name}, node {node}, known" for node in (0, 5) for name in ("cxx", "cyy")
    ]


@pytest.mark.parametrize("lost", [slice(0, 3), slice(None)])
def test_where_a_coefficient_is_not_determined_its_band_is_drawn_alone(lost: slice) -> None:
    bearings = table()
    deviation = 0.1 * np.abs(bearings.values)
    deviation[0, lost, 0] *= 4  # kxx is zero to within 2.5 deviations
    shown = Coefficients(replace(bearings, deviation=deviation), None, NAMES)
    band, _, drawn, _ = shown.draw(0, "kxx", "kxx identified", ("blue", "o"), 1.0, 99)
    assert np.isfinite(band.deviation).all()
    np.testing.assert_array_equal(drawn.x[np.isfinite(drawn.y)], np.delete(shown.rpm, lost))


def test_of_many_states_some_are_drawn_the_first_and_last_among_them() -> None:
    celsius = np.repeat(np.arange(20.0, 60.0, 2.0), 2)
    states = pick_states(np.tile([1.0, 2.0], 20), {"oil_temperature": celsius + 273.15})
    assert (len(states), states[0][0], states[-1][0]) == (8, "20 degC", "58 degC")


@pytest.mark.slow
def test_bode_plots_have_a_line_a_run_and_state_where_it_was_measured(drawn: list[Figure], tmp_path: Path) -> None:
    data = warm_machine()[0].dataset
    present = np.ones((len(data.speeds), 2), dtype=bool)
    present[: len(SPEEDS), 1] = False  # the second run was not made at 45 degC
    data = replace(data, channels=((0, 0.0), (0, 90.0), (5, 0.0), (5, 90.0)), present=present)
    draw_bode(tmp_path / "bode.png", data, None, {"left": (0, 30.0)})
    above = lines_of(drawn[0])
    assert [line.label for line in above] == [
        *(f"a, {state}" for state in ("45 degC", "55 degC", "65 degC")),
        *(f"b, {state}" for state in ("55 degC", "65 degC")),
    ]
    for line in above:
        np.testing.assert_allclose(line.x, SPEED_RPM)
