"""Modes of a levitated rotor with bands, and the stiffness of its magnetic bearings from a flexible model.

    python studies/levitated/levitated.py output=FOLDER [simulated=20] [draws=2000]

``examples/levitated`` has the responses, with credits. Modes: each band of frequencies is fitted at all channels at
once (:func:`pipeline.sweep.fit.fit_near`), over the drive of the sweep and over the current; halves of the lines and of
the channels are fitted apart; and ``simulated`` sweeps of known modes go the same way, noise and all.

Over the drive the poles are those of the rotor in its closed loop. Over the current of the left bearing they are those
of a rotor whose left bearing has no control: the current is the controller's, too.

Stiffness: shaft and discs are known to a tolerance, stiffness and damping of both bearings are not; the natural
frequencies with their bands tell them. ``draws`` of the posterior check its covariance. ``levitated.json`` has all.

Legend: S lines, P channels, K modes, T tolerances. SI, rad/s.
"""

from __future__ import annotations

import sys
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import yaml
from frequency_responses import CHANNELS, RATE, tabulate
from scipy.optimize import brentq, least_squares

from pipeline.config.rotor import RotorConfig
from pipeline.files import write_json
from pipeline.parameters.kind import ModelParameter
from pipeline.parameters.model import set_values, update_rotor
from pipeline.rotor.bearing_table import BearingTable
from pipeline.rotor.dynamic_stiffness import assemble_systems
from pipeline.rotor.model import RotorModel, translation_dof
from pipeline.rotor.stored import load_rotor
from pipeline.sweep.bias import respond_steadily
from pipeline.sweep.fit import ModalFit, RunUp, fit_near
from pipeline.twin.modes import find_modes

RIG = Path(__file__).resolve().parents[2] / "examples" / "levitated"
HZ = 2 * np.pi
BANDS = {
    (12.0, 22.0): ((16.3, 0.005),),
    (44.0, 71.0): ((51.4, 0.025), (56.0, 0.055)),
    (67.0, 82.0): ((74.0, 0.02),),
    (90.0, 112.0): ((100.4, 0.016),),
    (150.0, 178.0): ((162.5, 0.014),),
    (192.0, 228.0): ((204.0, 0.006), (211.7, 0.008)),
}
"""Hz: the modes that are looked for in each band, and their damping ratios."""
STATED = {16.0: 0, 51.0: 1, 100.0: 4, 162.0: 5, 204.0: 6, 212.0: 7}
"""What the authors read, Hz: which of the modes above, in turn. Their 59 Hz is the third."""
ONE_MODE = (52.013, 3.274)
"""Hz and kg, from which the authors have a stiffness: half the mass times the frequency squared."""


@dataclass(frozen=True, eq=False)
class Responses:
    """Accelerations at P channels over a reference."""

    frequencies: np.ndarray  # (S,) rad/s
    values: np.ndarray  # (S, P) complex
    deviations: np.ndarray  # (S, P) of each part
    current: np.ndarray  # (S,) complex, over the same reference

    def over_current(self) -> Responses:
        """The same over the current."""
        by = self.current[:, None]
        return replace(self, values=self.values / by, deviations=self.deviations / abs(by), current=self.current / by)

    def take(self, lines: slice, channels: slice) -> Responses:
        """Some of the lines and channels."""
        rest = self.values[lines, channels], self.deviations[lines, channels], self.current[lines]
        return Responses(self.frequencies[lines], *rest)


def read(table: pd.DataFrame) -> Responses:
    """The responses of a table that frequency_responses.py wrote."""
    values = {name: (table[f"{name}_re"] + 1j * table[f"{name}_im"]).to_numpy() for name in ("current", *CHANNELS)}
    deviations = np.stack([table[f"{name}_deviation"] for name in CHANNELS], axis=1)
    current = values.pop("current")
    return Responses(HZ * table.frequency_hz.to_numpy(), np.stack(list(values.values()), axis=1), deviations, current)


def fit_band(responses: Responses, first: float, last: float, near: Sequence[tuple[float, float]]) -> ModalFit:
    """The modes of the band from ``first`` to ``last`` Hz; each channel counts by its noise."""
    inside = (responses.frequencies >= HZ * first) & (responses.frequencies <= HZ * last)
    scale = np.median(responses.deviations[inside], axis=0)
    run = RunUp(responses.frequencies[inside], responses.values[inside] / scale, rate=0.0)
    fit = fit_near(run, [(HZ * hz, damping) for hz, damping in near])
    return replace(fit, amplitudes=fit.amplitudes * scale)


def fit_bands(responses: Responses) -> list[dict[str, Any]]:
    """The modes of all bands, by ascending frequency."""
    modes = []
    for (first, last), near in BANDS.items():
        fit = fit_band(responses, first, last, near)
        for w, z, (spread_w, spread_z), shape in zip(
            fit.frequencies, fit.dampings, fit.deviations, fit.amplitudes, strict=True
        ):
            shape = shape / shape[np.argmax(np.abs(shape))]
            modes.append(
                {
                    "hz": w / HZ,
                    "hz_deviation": spread_w / HZ,
                    "damping_ratio": z,
                    "damping_deviation": spread_z,
                    "shape": shape.real.round(3).tolist(),
                    "shape_imaginary": shape.imag.round(3).tolist(),
                    "misfit": fit.misfit,
                }
            )
    return modes


def score(modes: Sequence[dict[str, Any]], others: Sequence[dict[str, Any]]) -> np.ndarray:
    """(K, 2) differences of frequencies and damping ratios over the deviations of both; known modes have none."""
    names = (("hz", "hz_deviation"), ("damping_ratio", "damping_deviation"))
    return np.array(
        [
            [(a[name] - b[name]) / np.hypot(a[spread], b.get(spread, 0.0)) for name, spread in names]
            for a, b in zip(modes, others, strict=True)
        ]
    )


def compare_halves(responses: Responses) -> dict[str, Any]:
    """Even lines against odd ones, and the four channels of either end against each other."""
    every = slice(None)
    halves = {
        "lines": (slice(0, None, 2), every, slice(1, None, 2), every),
        "channels": (every, slice(0, 4), every, slice(4, None)),
    }
    return {
        name: score(fit_bands(responses.take(*cut[:2])), fit_bands(responses.take(*cut[2:]))).round(2).tolist()
        for name, cut in halves.items()
    }


def simulate(modes: Sequence[dict[str, Any]], count: int, noise: float = 0.4, hiss: float = 0.3) -> dict[str, Any]:
    """Root mean square of error over deviation, and share within 1.96 of them, of ``count`` sweeps of known modes.

    ``noise`` (V) drives the rotor beside the sweep; ``hiss`` (m/s^2) is that of the accelerometers.
    """
    samples = round(16 * RATE)
    time = np.arange(samples) / RATE
    drive = np.sin(np.pi * 500 / 16 * time**2)
    frequencies = HZ * np.fft.rfftfreq(samples, 1 / RATE)
    response = sum(
        respond_steadily(HZ * mode["hz"], mode["damping_ratio"], frequencies)[:, None]
        * np.array(mode["shape"])
        * mode["damping_ratio"]
        * 20  # as high as measured: some 10 m/s^2/V at each peak
        for mode in modes
    )
    rng, scores = np.random.default_rng(0), []
    for _ in range(count):
        driven = np.fft.rfft(drive + noise * rng.standard_normal(samples))[:, None]
        read_at = np.fft.irfft(response * driven, samples, axis=0)
        read_at = read_at + hiss * rng.standard_normal(read_at.shape)
        scores.append(score(fit_bands(read(tabulate(drive, drive, read_at))), modes))
    size = np.sqrt((np.array(scores) ** 2).mean(axis=0))
    return {"error_over_deviation": size.round(2).tolist(), "inside_95": float((np.abs(scores) < 1.96).mean())}


@dataclass(frozen=True, eq=False)
class Machine:
    """The flexible rotor, what may be off in it, and what was read of it."""

    rotor: RotorModel
    tolerances: tuple[ModelParameter, ...]
    hz: np.ndarray  # (K,) read, of the first modes of a plane
    spread: np.ndarray  # (K,) deviations of their logarithms
    damping: np.ndarray  # (2,) of the second and the third
    damping_spread: np.ndarray  # (2,)

    def modes(self, x: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Natural frequencies (K,) Hz and damping ratios (K,) at x: ln k and ln c of both bearings, and tolerances."""
        rotor = update_rotor(self.rotor, set_values(self.tolerances, x[4:]))
        bearings = tabulate_bearings(rotor, np.exp(x[:2]), np.exp(x[2:4]))
        values = find_modes(rotor, bearings, 2 * len(self.hz)).eigenvalues[0, ::2]  # x and y are alike
        return np.abs(values) / HZ, -values.real / np.abs(values)

    def residual(self, x: np.ndarray) -> np.ndarray:
        """What is read, and what is believed, in deviations."""
        hz, damping = self.modes(x)
        off = np.log(damping[1:3] / self.damping) * self.damping / self.damping_spread
        return np.concatenate([np.log(hz / self.hz) / self.spread, off, x[4:]])

    def fit(self, stiffness: Sequence[float]) -> tuple[np.ndarray, np.ndarray, float]:
        """x, its covariance and the sum of squares, from the ``stiffness`` (2,) N/m."""
        start = np.concatenate([np.log([*stiffness, 40.0, 20.0]), np.zeros(len(self.tolerances))])
        scale = np.concatenate([[0.05, 0.05, 0.2, 0.2], np.ones(len(self.tolerances))])
        answer = least_squares(self.residual, start, x_scale=scale)
        return answer.x, np.linalg.inv(answer.jac.T @ answer.jac), 2 * float(answer.cost)

    def sample(self, x: np.ndarray, covariance: np.ndarray, draws: int) -> tuple[np.ndarray, np.ndarray]:
        """Draws (D, ..) about the answer by its covariance, twice as wide a proposal, and their weights (D,)."""
        steps = np.random.default_rng(0).standard_normal((draws, len(x)))
        widened = x + np.sqrt(1.2) * steps @ np.linalg.cholesky(covariance).T
        squares = np.array([(self.residual(at) ** 2).sum() for at in widened])
        logs = ((steps**2).sum(axis=1) - squares) / 2
        weights = np.exp(logs - logs.max())
        return widened, weights / weights.sum()


def tabulate_bearings(rotor: RotorModel, stiffness: np.ndarray, damping: np.ndarray) -> BearingTable:
    """Bearings that are alike in x and y, at a standing rotor."""
    values = np.zeros((len(stiffness), 1, 8))
    values[:, 0, 0] = values[:, 0, 3] = stiffness
    values[:, 0, 4] = values[:, 0, 7] = damping
    return BearingTable(rotor.bearing_nodes, np.zeros(1), values)


def weigh_modes(rotor: RotorModel, stiffness: np.ndarray, count: int = 3) -> list[dict[str, float]]:
    """Of the first modes without damping: the share of the stiffness that is the shaft's bending, and the mass (kg)
    that a bearing sees, which is the modal mass over the sum of both bearings' squared motion."""
    from scipy.linalg import eigh

    mass, _, whole = assemble_systems(rotor, tabulate_bearings(rotor, stiffness, 0 * stiffness))
    plane = np.sort(np.concatenate([4 * np.arange(rotor.n_nodes), 4 * np.arange(rotor.n_nodes) + 3]))  # x and its slope
    squares, shapes = eigh(whole[0][np.ix_(plane, plane)], mass[np.ix_(plane, plane)])
    at = [int(np.searchsorted(plane, translation_dof(node, 0))) for node in rotor.bearing_nodes]
    return [
        {
            "hz": np.sqrt(square) / HZ,
            "shaft_share": 1 - float(stiffness @ shape[at] ** 2) / square,
            "mass_at_bearings": 1 / float((shape[at] ** 2).sum()),
            "left_over_right": float(shape[at[0]] / shape[at[1]]),
        }
        for square, shape in zip(squares[:count], shapes.T, strict=False)
    ]


def build_machine(modes: Sequence[dict[str, Any]], model: float = 0.005) -> Machine:
    """The machine of ``examples/levitated`` with usual tolerances, and ``model`` for what no tolerance stands for.

    Inertias are known to 10 %: nobody weighed what clamps the discs, or the accelerometers. The two readings near 204
    and 212 Hz have one shape, and the model one mode: it is between them.
    """
    rotor = load_rotor(RotorConfig.model_validate(yaml.safe_load((RIG / "rotor.yaml").read_text(encoding="utf-8"))))
    tolerances = [ModelParameter("youngs_modulus", 0.02, ""), ModelParameter("density", 0.01, "")]
    for kind, size in (("disc_mass", 0.01), ("disc_inertia", 0.1)):
        tolerances += [ModelParameter(kind, size, f"node {node}", node) for node in rotor.disc_nodes]
    pair = [modes[i]["hz"] for i in (6, 7)]
    kept = [modes[i] for i in (0, 1, 2, 4, 5)]
    hz = np.array([*(mode["hz"] for mode in kept), np.mean(pair)])
    spread = np.array([*(mode["hz_deviation"] for mode in kept), np.ptp(pair) / 2])
    damping, damping_spread = (np.array([modes[i][n] for i in (1, 2)]) for n in ("damping_ratio", "damping_deviation"))
    return Machine(rotor, tuple(tolerances), hz, np.hypot(spread / hz, model), damping, damping_spread)


def read_bearings(modes: Sequence[dict[str, Any]], first_over_current: dict[str, Any], draws: int) -> dict[str, Any]:
    """Stiffness and damping of both bearings, and what each choice changes of them."""
    machine = build_machine(modes)
    x, covariance, squares = machine.fit([1.2e5, 1.0e5])
    deviation, at = np.sqrt(np.diag(covariance)), np.exp(x[:4])
    drawn, weights = machine.sample(x, covariance, draws)
    sampled = weights @ drawn[:, :2]
    rotor = update_rotor(machine.rotor, set_values(machine.tolerances, x[4:]))
    mean = float(at[:2].mean())
    hz, mass = ONE_MODE
    single = (HZ * hz) ** 2 * mass / 2

    def miss(negative: float, off: float) -> float:
        """The first mode with no control at the left bearing, against that over the current, ``off`` deviations."""
        bearings = tabulate_bearings(rotor, np.array([-negative, at[1]]), np.array([0.0, at[3]]))
        values = find_modes(rotor, bearings, 4).eigenvalues[0]
        first = np.abs(values[values.imag > HZ * 5]).min() / HZ
        return float(first - first_over_current["hz"] - off * first_over_current["hz_deviation"])

    choices = {
        "model error of 1 %": build_machine(modes, 0.01),
        "the three lowest modes alone": replace(machine, hz=machine.hz[:3], spread=machine.spread[:3]),
        "inertias to 20 %": replace(
            machine,
            tolerances=tuple(replace(t, deviation=0.2) if t.kind == "disc_inertia" else t for t in machine.tolerances),
        ),
    }
    return {
        "stiffness": at[:2].tolist(),
        "stiffness_deviation": (at[:2] * deviation[:2]).tolist(),
        "mean_stiffness": mean,
        "mean_stiffness_deviation": float(np.sqrt(at[:2] @ covariance[:2, :2] @ at[:2]) / 2),
        "sampled_deviation": (at[:2] * np.sqrt(weights @ (drawn[:, :2] - sampled) ** 2)).tolist(),
        "sampled_stiffness": np.exp(sampled).tolist(),
        "effective_draws": float(1 / (weights**2).sum()),
        "damping": at[2:].tolist(),
        "damping_deviation": (at[2:] * deviation[2:4]).tolist(),
        "sum_of_squares": squares,
        "sum_of_squares_left_and_right_changed": machine.fit([1.0e5, 1.2e5])[2],
        "hz_read": machine.hz.tolist(),
        "hz_fitted": machine.modes(x)[0].tolist(),
        "tolerances": {t.name: float(value) for t, value in zip(machine.tolerances, x[4:], strict=True)},
        "other_choices": {name: np.exp(other.fit([1.2e5, 1.0e5])[0][:2]).tolist() for name, other in choices.items()},
        "modes": weigh_modes(rotor, at[:2]),
        "one_mode_and_half_the_mass": single,
        "over_the_mean": single / mean,
        "negative_stiffness_left": [brentq(miss, 0.0, 2e5, (off,)) for off in (0.0, -1.0, 1.0)],
    }


def main(arguments: list[str]) -> None:
    """Fit, check, and write."""
    given = {"simulated": "20", "draws": "2000"} | dict(each.split("=") for each in arguments)
    responses = read(pd.read_csv(RIG / "frequency_responses.csv"))
    modes, over_current = fit_bands(responses), fit_bands(responses.over_current())
    lower, upper = (np.array(modes[i]["shape"]) for i in (6, 7))
    report = {
        "over_drive": modes,
        "over_current": over_current,
        "off_stated_percent": {hz: 100 * (modes[i]["hz"] / hz - 1) for hz, i in STATED.items()},
        "halves": compare_halves(responses),
        "simulated": simulate(modes, int(given["simulated"])),
        "modal_assurance_of_the_upper_two": float((lower @ upper) ** 2 / (lower @ lower * (upper @ upper))),
        "bearings": read_bearings(modes, over_current[0], int(given["draws"])),
    }
    write_json(Path(given["output"]) / "levitated.json", report)


if __name__ == "__main__":
    main(sys.argv[1:])
