"""Numbers that other people published, reached through this project's own configuration and functions.

Sources: the paper (Table 1); Friswell, Penny, Garvey and Lees, "Dynamics of Rotating Machines", Cambridge
University Press 2010 (pages 177 and 182-185, examples 5.5.1 and 5.9.6), as ROSS 2.3 documents and tests it;
the compressor rotor of courses 41514 and 41524 at DTU (project sheets by I. F. Santos and C. Casarotto) on a
journal bearing with two axial grooves (Lund and Thomsen 1978; Someya, Journal-Bearing Databook).
"""

from __future__ import annotations

import numpy as np
import pytest
from scipy.interpolate import CubicSpline

from pipeline.coefficients import COEFFICIENTS
from pipeline.config.compose import compose_config
from pipeline.config.rotor import RotorConfig
from pipeline.data.dataset import Excitation
from pipeline.data.simulate import solve_response
from pipeline.rotor.bearing_table import BearingTable
from pipeline.rotor.bearings import CylindricalBearingConfig
from pipeline.rotor.model import translation_dof
from pipeline.rotor.ross_adapter import assemble, bearing_table
from pipeline.twin.modes import find_modes, measure_stability
from pipeline.units import RAD_S_PER_RPM


@pytest.mark.slow
def test_ball_bearing_stiffness() -> None:
    """Paper, Table 1 (Friswell, pages 182-185): 464.16883e5 and 1009.06269e5 N/m, cut after that digit."""
    config = compose_config(["experiment=ball_bearing"])
    table = bearing_table(config.machine.rotor, config.machine.bearings, np.array([10.0, 600.0]))
    np.testing.assert_array_equal(np.floor(table.coefficient("kxx")), 464.16883e5)
    np.testing.assert_array_equal(np.floor(table.coefficient("kyy")), 1009.06269e5)
    assert not table.coefficient("kxy").any()
    assert not table.coefficient("kyx").any()


FRISWELL_BEARING = CylindricalBearingConfig.model_validate(
    {
        "kind": "cylindrical",
        "journal_diameter": "100 mm",
        "length": "30 mm",
        "radial_clearance": "0.1 mm",
        "oil_viscosity": "0.1 Pa s",
        "static_load": "525 N",
    }
)
FRISWELL_ROTOR = RotorConfig.model_validate(
    {
        "shaft": [{"length": "1.5 m", "outer_diameter": "50 mm", "elements": 6}],
        "material": {"density": 7810.0, "youngs_modulus": "211 GPa", "shear_modulus": "81.2 GPa"},
        "discs": [
            {"node": 2, "width": "70 mm", "inner_diameter": "50 mm", "outer_diameter": "280 mm"},
            {"node": 4, "width": "70 mm", "inner_diameter": "50 mm", "outer_diameter": "350 mm"},
        ],
        "bearing_nodes": [0, 6],
    }
)


@pytest.mark.slow
def test_fluid_film_coefficients() -> None:
    """Friswell, example 5.5.1 at 1500 rpm: MN/m and kN s/m, all digits (of the damping, in ROSS's tests)."""
    speeds = np.array([1500.0, 2000.0]) * RAD_S_PER_RPM
    values = bearing_table(FRISWELL_ROTOR, FRISWELL_BEARING, speeds).values[0, 0]
    np.testing.assert_allclose(values[:4] / 1e6, [12.808, 16.394, -25.060, 8.815], rtol=0, atol=5.1e-4)
    np.testing.assert_allclose(values[4:] / 1e3, [232.9, -81.92, -81.92, 294.9], rtol=0, atol=5.1e-2)


def test_friswells_rotor_is_unstable_from_2100_rpm() -> None:
    """Friswell et al. 2010, example 5.9.6: oil whirl makes it unstable from 2100 rpm on.

    The book's static load of 525 N is half of the rotor's weight, which tells that the rotor is the book's.
    """
    rotor = assemble(FRISWELL_ROTOR)
    assert rotor.total_mass * 9.81 / 2 == pytest.approx(525, abs=0.5)
    speeds = np.array([500.0, 1000, 1500, 2000, 2050, 2100, 2200, 3000]) * RAD_S_PER_RPM
    modes = find_modes(rotor, bearing_table(FRISWELL_ROTOR, FRISWELL_BEARING, speeds))
    assert (modes.growth > 0).tolist() == [False] * 5 + [True] * 3
    assert not measure_stability(modes).stable


SHAFT_MM = [
    *[(25, 30), (40, 65), (35, 70), (40, 70), (50, 70), (50, 70), (55, 90), (60, 99.6), (60, 99.6)],
    *[(62.5, 90)] * 10,
    *[(35, 70), (11.5, 50), (11.5, 50), (52, 40)],
]
DTU_ROTOR = RotorConfig.model_validate(
    {
        "shaft": [{"length": length / 1e3, "outer_diameter": d / 1e3} for length, d in SHAFT_MM],
        "material": {"density": 7800.0, "youngs_modulus": 2.0e11, "shear_modulus": 0.77e11},
        "discs": [{"node": 5, "mass": 45.9033, "diametral_inertia": 0.266539, "polar_inertia": 0.555647}],
        "bearing_nodes": [8, 21],
        "shear_effects": False,
    }
)
# Two axial grooves, L/D = 0.5: S, Kxx, Kxy, Kyx, Kyy, Bxx, Bxy = Byx, Byy; k = K W/C and c = B W/(w C).
LUND_THOMSEN_SOMEYA = np.array(
    [
        [0.042, 11.45, 5.23, 0.92, 1.60, 9.48, 1.80, 0.82],
        [0.086, 7.51, 4.42, 0.47, 1.59, 8.03, 1.79, 1.03],
        [0.116, 6.36, 4.17, 0.30, 1.60, 7.59, 1.79, 1.15],
        [0.126, 6.07, 4.11, 0.25, 1.60, 7.48, 1.79, 1.18],
        [0.133, 5.89, 4.07, 0.22, 1.60, 7.41, 1.79, 1.20],
        [0.151, 5.48, 3.98, 0.15, 1.61, 7.26, 1.79, 1.27],
        [0.194, 4.78, 3.84, 0.01, 1.62, 7.03, 1.80, 1.40],
        [0.244, 4.21, 3.74, -0.13, 1.64, 6.87, 1.82, 1.54],
        [0.378, 3.33, 3.64, -0.43, 1.68, 6.76, 1.87, 1.89],
        [0.580, 2.67, 3.70, -0.78, 1.75, 6.96, 1.94, 2.40],
        [0.917, 2.12, 4.01, -1.30, 1.85, 7.70, 2.06, 3.23],
        [1.656, 1.69, 5.06, -2.20, 1.95, 9.93, 2.15, 4.80],
        [2.030, 1.65, 5.67, -2.50, 1.93, 11.18, 2.07, 5.33],
        [2.634, 1.61, 6.74, -3.01, 1.91, 13.36, 2.00, 6.28],
        [3.937, 1.57, 9.27, -4.20, 1.89, 18.44, 1.93, 8.58],
        [6.430, 1.55, 14.41, -6.60, 1.88, 28.75, 1.89, 13.31],
    ]
)
LOAD, CLEARANCE = 892.7, 0.1e-3  # N, m
LENGTH, BORE = 49.9e-3, 99.8e-3  # m


def dtu_bearings(rpm: np.ndarray) -> BearingTable:
    """Bearing A from the table, by splines over the logarithm of the speed; bearing B isotropic, 1e9 N/m."""
    sommerfeld, pure = LUND_THOMSEN_SOMEYA[:, 0], LUND_THOMSEN_SOMEYA[:, [1, 2, 3, 4, 5, 6, 6, 7]]
    turns = sommerfeld / (
        0.0277 * np.exp(0.034 * (40 - 55)) * LENGTH * BORE / LOAD * (BORE / 2 / CLEARANCE) ** 2
    )  # 1/s
    rows = pure * LOAD / CLEARANCE
    rows[:, 4:] /= 2 * np.pi * turns[:, None]
    values = np.zeros((2, len(rpm), len(COEFFICIENTS)))
    values[0] = CubicSpline(np.log(60 * turns), rows)(np.log(rpm))
    values[1][:, [0, 3]] = 1e9
    return BearingTable((8, 21), rpm * RAD_S_PER_RPM, values)


def test_compressor_rotor_response() -> None:
    """DTU: |x| and |y| in micrometres at the disc and at the journal for 160 g mm on the disc.

    The published digits at 600 and 1500 rpm are met; from 3000 rpm on the rows of the table lie far apart,
    and the way to interpolate between them decides about 0.1 %.
    """
    rotor = assemble(DTU_ROTOR)
    assert rotor.total_mass == pytest.approx(95.277, abs=1e-3)
    table = dtu_bearings(np.array([600.0, 1500.0, 3000.0, 6000.0]))
    q = solve_response(rotor, table, (Excitation("a", "unbalance", 5, 1.6e-4, 0.0),), ("a",))
    found = 1e6 * np.abs(q[:, [translation_dof(node, direction) for node in (5, 8) for direction in (0, 1)], 0])
    published = [
        [0.0594, 0.0976, 0.0425, 0.0749],
        [0.3836, 0.5203, 0.2757, 0.3998],
        [1.3025, 1.5414, 0.9459, 1.1944],
        [2.4911, 2.5595, 1.8672, 2.0806],
    ]
    np.testing.assert_allclose(found[:2], published[:2], rtol=0, atol=1.01e-4)
    np.testing.assert_allclose(found[2:], published[2:], rtol=2e-3)


def test_compressor_rotor_stability() -> None:
    """DTU: the rotor on one journal bearing becomes unstable near 6700 rpm.

    Above 1e6 rad/s its modes hardly move in that bearing: their growth is zero to rounding.
    """
    modes = find_modes(assemble(DTU_ROTOR), dtu_bearings(np.array([6000.0, 6500.0, 6900.0, 7500.0])))
    assert (modes.growth > 1e-6).tolist() == [False, False, True, True]


def test_rounding_makes_no_rotor_unstable() -> None:
    """DTU: at 3000 rpm, less than half of its threshold, the rotor is stable."""
    margin = measure_stability(find_modes(assemble(DTU_ROTOR), dtu_bearings(np.array([3000.0]))))
    assert margin.smallest_logarithmic_decrement > 1
    assert margin.stable
