"""Vibration that training never saw, from identified and from modelled coefficients (paper, Figure 6)."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from pipeline.data.dataset import DIRECTIONS, Excitation, VibrationDataset
from pipeline.data.simulate import solve_response
from pipeline.identification.identified import IdentifiedModel
from pipeline.identification.uncertainty import Uncertainty
from pipeline.problem.measurement import Measurement
from pipeline.problem.model_parameters import of_machine_alone
from pipeline.problem.reference_response import response_equations, response_variations
from pipeline.problem.response import derive_by_parameters, respond
from pipeline.rotor.bearing_table import BearingTable
from pipeline.rotor.model import TRANSLATIONS, RotorModel, translation_dof


@dataclass(frozen=True, eq=False)
class PredictedVibration:
    """Displacement of one node over speed, complex zero-to-peak amplitudes of q(t) = Re(Q e^{jwt})."""

    node: int
    speeds: np.ndarray  # (S,) rad/s
    displacement: np.ndarray  # (S, 2) complex, m, of x and y
    deviation: np.ndarray | None = None  # (S, 2) standard deviation of the amplitude, m, where it is known

    def error_percent(self, reference: PredictedVibration) -> np.ndarray:
        """(S, 2) |Q - Q_reference| / |Q_reference| in percent: amplitude and phase together."""
        return 100.0 * np.abs(self.displacement - reference.displacement) / np.abs(reference.displacement)


def predict(
    rotor: RotorModel, bearings: BearingTable, unbalances: tuple[Excitation, ...], node: int
) -> PredictedVibration:
    """The response of ``node`` to ``unbalances`` (one run) at the speeds of ``bearings``."""
    runs = (unbalances[0].run,)
    response = solve_response(rotor, bearings, unbalances, runs)
    places = [translation_dof(node, direction) for direction in range(TRANSLATIONS)]
    return PredictedVibration(node, bearings.speeds, response[:, places, 0])


def add_deviation(
    predicted: PredictedVibration,
    measurement: Measurement,
    bearings: BearingTable,
    unbalances: tuple[Excitation, ...],
    identified: IdentifiedModel,
    uncertainty: Uncertainty,
) -> PredictedVibration:
    """The same with the deviation that the covariance of coefficients and model parameters implies, to first order.

    ``measurement`` is at the fitted model parameters. The prediction has no probes, and its weights are exact.
    """
    channels = tuple((predicted.node, angle) for angle in DIRECTIONS.values())
    runs = (unbalances[0].run,)
    dataset = VibrationDataset(bearings.speeds, runs, channels, predicted.displacement[..., None], unbalances)
    stiffness = float(np.median(np.abs(bearings.values[..., 0])))
    equations = response_equations(measurement.updated_rotor, dataset, stiffness)
    by_coefficient = equations.sensitivity(bearings)[:, :, 0]  # (S, 2, B, 8)
    by_number = uncertainty.sensitivity(identified, bearings.speeds, bearings.operating)  # (B, S, 8, A (K + L))
    slopes = np.einsum("sdbc,bscz->sdz", by_coefficient, by_number)
    if measurement.parameters:
        rotor, parameters = measurement.rotor, of_machine_alone(measurement.parameters)
        values = measurement.parameter_values
        (variation,) = response_variations(rotor, dataset, stiffness, (), parameters, values)
        change = equations.change(bearings, equations.blocks[0])
        response = respond(equations.blocks[0], change)
        by_model = derive_by_parameters(variation, response, change[None], None)[0, :, :, 0]  # (S, 2, T)
        by_model = by_model + np.einsum("sdbc,sbct->sdt", by_coefficient, measurement.known_variation)
        slopes = np.concatenate([slopes, by_model], axis=-1)
    direction = predicted.displacement.conj() / np.abs(predicted.displacement)
    in_phase = (direction[..., None] * slopes).real
    variance = np.einsum("sdz,zy,sdy->sd", in_phase, uncertainty.machine_covariance, in_phase, optimize=True)
    return replace(predicted, deviation=np.sqrt(np.maximum(variance, 0.0)))


def sample_motion(
    displacement: np.ndarray, speed: float, turns: float = 2.0, points: int = 400
) -> tuple[np.ndarray, np.ndarray]:
    """Times (T,) in s and displacements (T, 2) in m of x and y at ``speed`` (rad/s), from amplitudes (2,)."""
    time = np.linspace(0.0, turns * 2.0 * np.pi / speed, points)
    return time, np.real(displacement[None, :] * np.exp(1j * speed * time)[:, None])
