"""Each method on a case where its own literature says that it works, against a truth that was modelled otherwise."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from comparing import FILM, answer, errors, machine, options, task
from scipy.linalg import expm

from pipeline.comparison.cases import Case
from pipeline.data.dataset import Excitation, VibrationDataset
from pipeline.data.sensors import list_directions
from pipeline.data.simulate import solve_response
from pipeline.methods.catalogue import METHODS
from pipeline.problem.measurement import Measurement
from pipeline.rotor.model import RotorModel, translation_dof

pytestmark = pytest.mark.slow

BACKWARD = ("experiment=all_coefficients_backward", "machine.speeds.step_rpm=200")
FORWARD = ("experiment=all_coefficients", "machine.speeds.step_rpm=200")
BALLS = ("experiment=ball_bearing",)
BLOWS = ("experiment=impulses", "machine.speeds.step_rpm=500")


@pytest.mark.parametrize(
    ("method", "case", "modelled", "bar"),
    [
        # Tiwari, Lees and Friswell (2002): runs of both senses of rotation make the equations well conditioned.
        *(
            (name, Case(0.0, "all", 30), BACKWARD, 1e-10)
            for name in ("least_squares", "tikhonov", "total_least_squares")
        ),
        # Kang et al. (2020): a filter from one location is within 2 % at 0.1 % noise.
        ("kalman", Case(0.001, "location", 591), ("experiment=hydrostatic_stiffness",), 2),
        # Han, Guo and Gao (2013): kriging and differential evolution find constant bearings, robustly under noise;
        # Pavlenko et al. (2018): critical speeds give the stiffness within 5 %, also from one location. Clean data of
        # all nodes are those of tests/comparison/test_cases.py.
        ("kriging", Case(0.01, "all", 60), BALLS, 0.4),
        ("critical_speeds", Case(0.0, "location", 591), BALLS, 5),
    ],
)
def test_a_method_does_what_its_literature_says(method: str, case: Case, modelled: tuple[str, ...], bar: float) -> None:
    """The largest error of a coefficient, percent."""
    assert errors(answer(method, case, *modelled), case, *modelled).max() < bar


def test_regularisation_helps_where_the_orbits_are_nearly_dependent() -> None:
    """The same unknowns from forward whirl alone: the plain answer is lost in the noise, several times its size."""

    def error(method: str) -> float:
        case = Case(0.001, "all", 30)
        return float(np.median(errors(answer(method, case, *FORWARD), case, *FORWARD)))

    assert 3 * error("tikhonov") < error("least_squares")


def test_total_least_squares_is_consistent_where_least_squares_is_not() -> None:
    """De Troyer et al. (2012): the mean of many data sets comes to the truth, that of least squares beside it."""

    def bias(method: str) -> float:
        found = []
        for i in range(30):
            case = Case(0.03, "bearings", 60, i)
            found.append(answer(method, case, *FILM).coefficients.coefficient("kyy"))
        return float(np.abs(np.median(np.mean(found, axis=0) / machine(*FILM).truth(case).coefficient("kyy") - 1)))

    assert bias("total_least_squares") < 0.5 * bias("least_squares")


def test_a_spline_knows_of_the_neighbouring_speeds() -> None:
    """Its error is a part of that of least squares, which knows of one speed alone."""
    case = Case(0.01, "bearings", 60)
    spline, plain = (errors(answer(method, case, *FILM), case, *FILM).mean() for method in ("spline", "least_squares"))
    assert spline < plain / 2


SPEED_RPM = 3100.0
LENGTH, RATE = 2.0, 8000.0  # s, 1/s
PULSE = 0.004  # s
TIME = np.arange(int(LENGTH * RATE)) / RATE  # s
BLOW = np.where(TIME < PULSE, np.sin(np.pi * TIME / PULSE), 0.0)  # N
UNBALANCE = 4e-5 * np.exp(0.9j)  # kg m at node 2: nobody knows of it


def _blown(rotor: RotorModel, impedance: np.ndarray, speed: float, node: int, direction: int) -> np.ndarray:
    """(T, n) displacement after a half sine of 1 N at a node, exact for a piecewise linear force."""
    stiffness, damping = rotor.stiffness.copy(), rotor.damping + speed * rotor.gyroscopic
    for b, bearing in enumerate(rotor.bearing_nodes):
        place = [translation_dof(bearing, 0), translation_dof(bearing, 1)]
        stiffness[np.ix_(place, place)] += impedance[b].real
        damping[np.ix_(place, place)] += impedance[b].imag / speed
    n = rotor.n_dof
    inverse = np.linalg.inv(rotor.mass)
    system = np.block([[np.zeros((n, n)), np.eye(n)], [-inverse @ stiffness, -inverse @ damping]])
    drive = np.concatenate([np.zeros(n), inverse[:, translation_dof(node, direction)]])
    # Force and its slope as states: exponentials then step the whole exactly.
    whole = np.zeros((2 * n + 2, 2 * n + 2))
    whole[: 2 * n, : 2 * n], whole[: 2 * n, 2 * n], whole[2 * n, 2 * n + 1] = system, drive, 1.0
    step = expm(whole / RATE)
    slope = np.diff(BLOW, append=0.0) * RATE
    state, seen = np.zeros(2 * n), np.empty((len(TIME), n))
    for t in range(len(TIME)):
        seen[t] = state[:n]
        state = (step @ np.concatenate([state, [BLOW[t], slope[t]]]))[: 2 * n]
    return seen


def test_impulse_records_give_all_coefficients_and_the_unbalance() -> None:
    """Qiu and Tieu (1997); Tiwari and Chakravarthy (2006): spectra of records in the time domain, at one speed."""
    whole = machine(*BLOWS)
    rotor = whole.rotor
    # A shaft with some damping of its own: what a record of two seconds holds has then died away.
    rotor = replace(rotor, damping=rotor.damping + 2e-5 * rotor.stiffness)
    s = int(np.abs(whole.modelled.speeds * 30 / np.pi - SPEED_RPM).argmin())
    speed, truth = float(whole.modelled.speeds[s]), whole.modelled.at(np.array([s]))
    impedance = truth.impedance()[:, 0]
    lines = 2 * np.pi * np.array([35.0, 60.0, 85.0, 110.0])
    channels = list_directions(rotor.bearing_nodes)
    sensors = VibrationDataset(np.array([speed]), (), channels, np.zeros((1, 4, 0)), ()).sensor_matrix(rotor)
    runs, columns, acting = [], [], []
    for direction in (0, 1):
        record = _blown(rotor, impedance, speed, 2, direction) @ sensors.T  # (T, P)
        for w in lines:
            wave = np.exp(-1j * w * TIME) / RATE
            size = complex(wave @ BLOW)
            name = f"{direction} {w:.0f}"
            runs.append(name)
            columns.append(wave @ record)
            # A force along one direction is half a forward and half a backward one.
            for whirl, sign in (("forward", 1), ("backward", -1)):
                acting.append(
                    Excitation(name, "force", 2, abs(size) / 2, np.angle(size * 1j ** (sign * direction)), whirl)
                )
    runs.append("weight")
    known = Excitation("weight", "unbalance", 4, 1e-4, 0.3)
    hidden = Excitation("weight", "unbalance", 2, abs(UNBALANCE), float(np.angle(UNBALANCE)))
    columns.append(sensors @ solve_response(rotor, truth, (known, hidden), ("weight",))[0, :, 0])
    dataset = VibrationDataset(
        np.array([speed]),
        tuple(runs),
        channels,
        np.stack(columns, axis=1)[None],
        (*acting, known),
        np.array([[*lines, *lines, speed]]),
    )
    template = task(Case(0.001, "bearings", 12), *BLOWS)
    own = Measurement(
        rotor,
        dataset,
        replace(truth, values=np.zeros_like(truth.values)),
        template.noise,
        replace(template.unknowns, planes=(2,)),
        template.guess,
    )
    found = METHODS["multi_frequency"].identify(own, options(*BLOWS))
    np.testing.assert_allclose(found.coefficients.values, truth.values, rtol=0.005)
    assert "40 g mm at node 2" in found.words
