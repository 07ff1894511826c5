"""The measurement that a configuration asks about."""

from __future__ import annotations

from pipeline.config.schema import Config
from pipeline.data.conditions import gather_conditions
from pipeline.data.dataset import VibrationDataset, require_synchronous
from pipeline.data.noise import NoiseModel
from pipeline.laws.build import make_laws
from pipeline.problem.condition_noise import condition_noise, suffices, to_dataset
from pipeline.problem.measurement import Guess, Measurement
from pipeline.problem.model_parameters import model_parameters, usual_tolerances
from pipeline.rotor.bearing_table import BearingTable
from pipeline.rotor.model import RotorModel


def build_measurement(config: Config, rotor: RotorModel, dataset: VibrationDataset, known: BearingTable) -> Measurement:
    """From a data set that is at hand, and the ``known`` coefficients at its speeds."""
    require_synchronous(rotor, dataset)
    noise, model, identify = config.stated_noise, config.model, config.identify
    laws = config.machine.laws
    stated, drift = NoiseModel(noise.additive, noise.multiplicative, noise.drift), None
    if dataset.conditions is not None:
        conditions = gather_conditions(dataset)
        if suffices(conditions):
            drift = condition_noise(conditions, stated)
        else:
            stated = stated.with_drift()
        dataset = to_dataset(conditions)
    unknowns, stated_numbers = identify.unknowns_of(rotor.bearing_nodes), identify.model_parameters.deviations
    return Measurement(
        rotor,
        dataset,
        known,
        stated,
        unknowns,
        Guess(model.initial_stiffness, model.initial_damping, identify.known_within),
        drift=drift,
        laws=None if laws is None else make_laws(laws, rotor.bearing_nodes),
        parameters=model_parameters(stated_numbers, rotor, dataset, known, unknowns, identify.coupling_node),
        tolerances=usual_tolerances(stated_numbers, rotor, dataset, known, unknowns)
        if identify.usual_tolerances
        else (),
    )
