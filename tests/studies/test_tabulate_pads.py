"""Reynolds' equation and the packaged tables against publications, the short bearing, and finite differences."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from reynolds import PadBearing, film_forces, tabulate_bearing
from tabulate_pads import main

from pipeline.laws.short_bearing import short_coefficients, short_eccentricity
from pipeline.laws.table import FOLDER, packaged_tables, read_film_table

LUND = np.loadtxt(FOLDER / "lund_thomsen_two_axial_groove.csv", delimiter=",", skiprows=5)
TWO = (0.0, np.pi)


def far(found: np.ndarray, wanted: np.ndarray) -> float:
    """The largest difference of coefficients (n, 8), over the largest of the row's stiffness or damping."""
    size = np.abs(wanted.reshape(len(wanted), 2, 4)).max(axis=2, keepdims=True)
    return float((np.abs(found - wanted).reshape(len(wanted), 2, 4) / size).max())


@pytest.mark.slow
def test_a_plain_bearing_is_the_published_one() -> None:
    """Two pads of 160 degrees, L/D = 0.5: Lund and Thomsen 1978, who printed three digits at most."""
    found = tabulate_bearing(PadBearing(TWO, np.radians(160), 0.0, 0.5, elements=(96, 8)), LUND[[1, 13], 0])
    assert far(found, LUND[[1, 13], 1:]) < 0.02


def test_the_derivatives_of_the_forces_are_those_of_differences() -> None:
    bearing, place = PadBearing(TWO, np.radians(150), 0.3, 0.5, elements=(40, 5)), np.array([0.2, 0.3])
    _, stiffness, damping = film_forces(bearing, place)
    ends = [[film_forces(bearing, place + sign * 1e-5 * one)[0] for one in np.eye(2)] for sign in (1, -1)]
    np.testing.assert_allclose(stiffness, (np.array(ends[0]) - ends[1]).T / 2e-5, rtol=1e-3, atol=1e-4)
    np.testing.assert_allclose(damping[0, 1], damping[1, 0], rtol=1e-6)  # a film at rest is reciprocal


@pytest.mark.slow
def test_a_very_short_bearing_is_the_closed_form() -> None:
    """L/D = 0.03, one pad all round: Friswell et al. 2010, page 177."""
    numbers = np.array([0.1, 0.5])
    found = tabulate_bearing(PadBearing((0.0,), 2 * np.pi, 0.0, 0.03, elements=(480, 8)), numbers / 0.03**2)
    assert far(found, short_coefficients(short_eccentricity(numbers))) < 0.02


def test_the_packaged_elliptical_table_without_preload_is_the_published_plain_one() -> None:
    """At every published number; between its rows, too. A film that breaks on a grid has a ragged edge."""
    table = read_film_table("elliptical")
    assert table.preloads[0] == 0
    assert far(table.tabulate(np.log(LUND[:, 0]), 0.0), LUND[:, 1:]) < 0.02


@pytest.mark.slow
@pytest.mark.parametrize(
    ("name", "bearing"),
    [
        ("elliptical", PadBearing(TWO, np.radians(160), 0.5, 0.5, elements=(160, 10))),
        (
            "tilting_pad",
            PadBearing(
                tuple(np.radians([36.0, 108.0, 180.0, 252.0, 324.0])), np.radians(60), 0.45, 0.5, True, elements=(60, 8)
            ),
        ),
    ],
)
def test_a_packaged_table_is_what_its_command_makes(name: str, bearing: PadBearing) -> None:
    """On a coarser grid, between the rows and between the preloads."""
    numbers = np.array([0.1, 0.7, 5.0])
    table = read_film_table(name)
    assert bearing.preload not in table.preloads
    assert far(table.tabulate(np.log(numbers), bearing.preload), tabulate_bearing(bearing, numbers)) < 0.03


def test_every_packaged_table_is_smooth_and_says_where_it_comes_from() -> None:
    assert {"elliptical", "lund_thomsen_two_axial_groove", "tilting_pad"} <= set(packaged_tables())
    for name in packaged_tables():
        head = (FOLDER / f"{name}.csv").read_text(encoding="utf-8").splitlines()[:5]
        assert any("Made by" in line or "pages" in line for line in head)
        for curve in read_film_table(name).curves:
            damping = curve.columns[:, 4:].reshape(-1, 2, 2)
            assert (np.linalg.eigvalsh((damping + damping.swapaxes(1, 2)) / 2) > 0).all()  # it takes energy


@pytest.mark.slow
def test_the_command_writes_a_table_that_can_be_read(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    path = tmp_path / "own.csv"
    sizes = ["--span", "0.2", "2", "--rows", "4", "--elements", "24", "4"]
    assert main([str(path), "--preloads", "0.3", "0.5", *sizes]) == 0
    table = read_film_table(str(path))
    np.testing.assert_array_equal(table.preloads, [0.3, 0.5])
    np.testing.assert_allclose(np.exp(table.curves[0].nodes), np.geomspace(0.2, 2, 4), rtol=1e-4)
    assert "tabulate_pads.py own.csv --preloads 0.3 0.5" in path.read_text(encoding="utf-8")
    with pytest.raises(SystemExit):
        main([str(path), "--pads", "5", "--arc", "80"])
    assert "pads that fit into a turn" in capsys.readouterr().err
