"""What ISO 21940-11 lets remain: the chart's eccentricity, and levers and the centre of mass by statics."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from benchmarks.machines import Machine
from pipeline.balance.sheet import find_centre, share_tolerance
from pipeline.config.balance import ToleranceConfig
from pipeline.errors import ConfigError


def test_the_permissible_eccentricity_is_that_of_the_standards_chart() -> None:
    """G6.3 at 3000 rpm allows 20 um, G2.5 at 3600 rpm 6.6 um."""
    for grade, rpm, micrometres in (("G6.3", 3000, 20.05), ("G 2.5", 3600, 6.631)):
        tolerance = ToleranceConfig.model_validate({"grade": grade, "service_speed_rpm": rpm})
        assert tolerance.permissible(7.0) / 7.0 == pytest.approx(1e-6 * micrometres, rel=1e-3)


def test_what_remains_is_shared_by_the_lever(hydrostatic: Machine) -> None:
    rotor = hydrostatic.rotor
    first, second = rotor.bearing_nodes
    shared = share_tolerance(rotor, (first, second), 1.0)
    np.testing.assert_allclose(shared.remaining(np.array([2.0, 3j])), [2.0, 3j], atol=1e-12)
    middle = share_tolerance(rotor, (first + 1,), 1.0)
    begin, end = rotor.positions[[first, second]]
    share = (rotor.positions[first + 1] - begin) / (end - begin)
    np.testing.assert_allclose(middle.remaining(np.array([1.0])), [1 - share, share])
    np.testing.assert_allclose(middle.circle(np.array([[4.0]]), np.array([3.0])), [3 * (1 - share), 3 * share])
    assert shared.permissible.sum() == pytest.approx(1.0)


def test_the_centre_of_mass_is_that_of_its_parts(hydrostatic: Machine) -> None:
    """Cylinders of the shaft with their centres, and discs at their nodes, from the configuration alone."""
    given, rotor = hydrostatic.config.machine.rotor, hydrostatic.rotor
    parts, begin = [], 0.0
    for piece in given.shaft:
        area = np.pi / 4 * (piece.outer_diameter**2 - piece.inner_diameter**2)
        parts.append((given.material.density * area * piece.length, begin + piece.length / 2))
        begin += piece.length
    for disc in given.discs:
        area = np.pi / 4 * (disc.outer_diameter**2 - disc.inner_diameter**2)
        parts.append((given.material.density * area * disc.width, rotor.positions[disc.node]))
    masses, places = np.array(parts).T
    assert find_centre(rotor) == pytest.approx(masses @ places / masses.sum(), rel=1e-6)
    assert find_centre(rotor) != pytest.approx(rotor.positions[-1] / 2, rel=1e-3)


def test_a_rotor_on_one_bearing_is_refused(hydrostatic: Machine) -> None:
    with pytest.raises(ConfigError, match="two bearings"):
        share_tolerance(replace(hydrostatic.rotor, bearing_nodes=(1,)), (2,), 1.0)
