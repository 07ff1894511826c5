"""A rotor with one disc on two bearings with constant coefficients, and four probes: what a fit takes a second for."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from pipeline.config.rotor import RotorConfig
from pipeline.config.schema import Config
from pipeline.data.dataset import Excitation, VibrationDataset
from pipeline.data.sensors import NoiseModel
from pipeline.data.simulate import add_noise
from pipeline.identification.output_error_fit import OutputErrorFit, fit_output_error
from pipeline.identification.training import setup_of
from pipeline.problem.configured import build_measurement, model_machine, read_probes
from pipeline.problem.measurement import Guess, Measurement
from pipeline.rotor.bearing_table import BearingTable
from pipeline.rotor.model import RotorModel
from pipeline.rotor.stored import load_rotor
from pipeline.unknowns import tie, unknown_set

NOISE = 2e-7
DIRECT = (2e6, 0.0, 0.0, 1.2e6, 900.0, 0.0, 0.0, 600.0)
STEEL = {"density": 7810.0, "youngs_modulus": 211e9, "shear_modulus": 81.2e9}
DISC = {"mass": 10.0, "diametral_inertia": 0.05, "polar_inertia": 0.09}
SPEEDS = np.linspace(60.0, 260.0, 6)
FITTED = (
    "experiment=ball_bearing",
    "tuned=false",
    "model.parametrisation=log",
    "loss=response",
    "optimizer=levenberg_marquardt",
    "optimizer.levenberg_marquardt.steps=60",
    "optimizer.levenberg_marquardt.patience=3",
    "training=to_the_minimum",
    "tracking=none",
)
"""Overrides: constants, by Levenberg-Marquardt alone."""


def steel_rotor(
    shaft: tuple[float, float, int],
    discs: Sequence[dict[str, float]],
    bearing_nodes: Sequence[int],
    shear: bool = True,
) -> RotorModel:
    """A rotor whose shaft has a length (m), a diameter (m) and a number of elements."""
    of_shaft = dict(zip(("length", "outer_diameter", "elements"), shaft, strict=True)) | {"inner_diameter": 0.0}
    config = {"material": STEEL, "shaft": [of_shaft], "discs": discs, "bearing_nodes": bearing_nodes}
    return load_rotor(RotorConfig.model_validate(config | {"shear_effects": shear}))


def small_machine(
    eight: tuple[float, ...],
    angles: tuple[float, float] = (0.3, 2.0),
    speeds: np.ndarray = SPEEDS,
    noise: float = NOISE,
) -> tuple[Measurement, BearingTable]:
    """Readings of probes at 20 and 110 degrees of a rotor with one disc, and its bearings; direct ones are unknown."""
    model = steel_rotor((1.0, 0.03, 5), [DISC | {"node": 2}], (0, 5))
    bearings = BearingTable((0, 5), speeds, np.tile(eight, (2, len(speeds), 1)))
    channels = tuple((node, angle) for node in (0, 5) for angle in (20.0, 110.0))
    weights = tuple(Excitation(run, "unbalance", 2, 5e-4, angle) for run, angle in zip("ab", angles, strict=True))
    data = VibrationDataset(speeds, ("a", "b"), channels, np.ones((len(speeds), 4, 2), complex), weights)
    unknowns = unknown_set(dict.fromkeys((0, 5), tie(("kxx", "kyy", "cxx", "cyy"))))
    made = Measurement(model, data, bearings, NoiseModel(NOISE, 0.0), unknowns, Guess(1e6, 1e3))
    exact = replace(data, displacement=made.response.predict(bearings))
    deviation = np.full(exact.displacement.shape, noise)
    return replace(made, dataset=add_noise(exact, deviation, np.random.default_rng(5))), bearings


def with_weights(data: VibrationDataset, *acting: tuple[str, float, float]) -> VibrationDataset:
    """The data set with a run a weight at the disc, of run, size (kg m) and angle (rad); nothing is read yet."""
    weights = tuple(Excitation(run, "unbalance", 2, size, angle) for run, size, angle in acting)
    unread = np.ones((*data.displacement.shape[:2], len(acting)), dtype=complex)
    return replace(data, runs=tuple(run for run, _, _ in acting), excitations=weights, displacement=unread)


def fitted_beside_truth(config: Config, seed: int) -> tuple[OutputErrorFit, np.ndarray]:
    """The fit of a simulated machine, and the true unknowns (S, A)."""
    rotor, truth, complete = model_machine(config, seed)
    measurement = build_measurement(config, rotor, read_probes(config, rotor, complete, seed), truth)
    leading = measurement.unknowns.leading(truth.values)
    fit = fit_output_error(measurement, setup_of(config))
    return fit, np.stack([leading[m, :, u] for m, u in measurement.unknowns.active], axis=-1)
