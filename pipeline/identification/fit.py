"""From a measurement to its coefficients: the one door of identification, and the losses behind it.

Nothing else asks which loss a configuration names. ``residual``: the residual of the equation of motion (paper, eq. 6).
``preconditioned``: the same, multiplied at each speed by the pseudo-inverse of its derivative by the unknowns.
``response``: the output error, predicted less measured displacements over the sensors' noise.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from pipeline.config.identification import (
    AdamConfig,
    LBFGSConfig,
    LevenbergMarquardtConfig,
    LossConfig,
    OptimizerConfig,
    TrainingConfig,
)
from pipeline.config.models import ConstantModelConfig, ModelConfig, NetworkModelConfig
from pipeline.identification.identified import Fit
from pipeline.identification.training import FitSetup, Progress, minimise
from pipeline.problem.diagnosis import Diagnosis, diagnose_residual, diagnose_response
from pipeline.problem.identifiability import require_identifiable
from pipeline.problem.law_information import require_temperatures
from pipeline.problem.measurement import Guess, Measurement
from pipeline.rotor.bearing_table import BearingTable
from pipeline.write_numbers import write_rough


def fit(
    measurement: Measurement,
    setup: FitSetup | None = None,
    progress: Progress | None = None,
    diagnosis: Diagnosis | None = None,
) -> Fit:
    """Identify the unknowns of a measurement.

    Args:
        setup: how; :func:`default_setup` where none is given.
        progress: shows the training while it runs.
        diagnosis: what is known of the measurement already, so that it is not worked out again.

    Raises:
        IdentifiabilityError: where the data do not determine the unknowns, unless ``setup.force``.
        DataError: where the sensors do not suffice for the loss.
        ConfigError: for held-out runs that the data lack.
    """
    chosen = default_setup(measurement.guess) if setup is None else setup
    return loss_of(chosen.loss).fit(measurement, chosen, progress, diagnosis)


def default_setup(guess: Guess, constant: bool = False, noise: str = "stated") -> FitSetup:
    """The output error to its minimum, of coefficients that are ``constant`` or smooth functions of the speed.

    ``noise`` is ``stated``, or ``estimated`` where its shape is known and its size is not.
    """
    shared = {
        "parametrisation": "log",
        "initialisation": "guess",
        "initial_stiffness": guess.stiffness,
        "initial_damping": guess.damping,
    }
    network = {"width": 24, "depth": 1, "activation": "tanh", "input_scaling": "log_rpm", "trend": True}
    model: ModelConfig = (
        ConstantModelConfig.model_validate(shared | {"kind": "constant"})
        if constant
        else NetworkModelConfig.model_validate(shared | network | {"kind": "network"})
    )
    return FitSetup(
        model,
        LossConfig.model_validate({"kind": "response", "scaling": "per_speed", "regularisation": 0.0, "noise": noise}),
        OptimizerConfig(
            adam=AdamConfig(steps=0, patience=1, learning_rate=0.01, final_rate_fraction=0.01),
            lbfgs=LBFGSConfig(steps=0, patience=1, history=50),
            levenberg_marquardt=LevenbergMarquardtConfig(steps=400, patience=3, initial_damping=1e-6),
        ),
        TrainingConfig(holdout_every=0, tolerance=1e-6),
    )


# --- losses ----------------------------------------------------------------------------------------------


class ResidualLoss:
    """The residual at the bearings, preconditioned or not: it asks for x and y at every bearing.

    Attributes:
        label: the axis of a figure of the loss, with its unit.
        weighs_noise: whether readings are weighed by their noise: then deviations are stated and any sensors will do.
    """

    weighs_noise = False

    def __init__(self, config: LossConfig) -> None:
        unscaled = config.kind == "residual" and config.scaling == "none"
        self.label = "root mean square residual (N)" if unscaled else _LABELS[config.kind]

    def diagnose(self, measurement: Measurement, setup: FitSetup) -> Diagnosis:
        """What the measurement determines before the fit, by least squares at each speed.

        Raises DataError for sensors that do not suffice.
        """
        return diagnose_residual(measurement, setup.constant)

    def expect(self, measurement: Measurement, setup: FitSetup, diagnosis: Diagnosis) -> BearingTable:
        """The coefficients before the fit, with the deviations of least squares at each speed by itself: the residual
        weighs no noise, so it promises no more. A constant takes the weighted mean of its speeds.
        """
        expected = diagnosis.expected
        if not setup.constant:
            return expected
        each = expected.spread
        with np.errstate(divide="ignore"):
            pooled = 1 / np.sqrt((each**-2.0).sum(axis=1, keepdims=True))
        return replace(expected, deviation=np.broadcast_to(pooled, each.shape), by="constants over all speeds")

    def fit(
        self,
        measurement: Measurement,
        setup: FitSetup,
        progress: Progress | None = None,
        diagnosis: Diagnosis | None = None,
    ) -> Fit:
        """Training, from a guess or from least squares. Raises as :func:`fit`."""
        from pipeline.identification.quality import residual_quality
        from pipeline.identification.residual_loss import initial_parameters, prepare_residual

        training = prepare_residual(measurement, setup)
        start = initial_parameters(training, setup, setup.seed)
        minimum = minimise(training.problem, start, setup, held_out=training.held_out, progress=progress)
        model = training.identified(minimum.parameters[0])
        return Fit(
            model=model,
            outcome=minimum.outcomes[0],
            loss=float(minimum.loss[0]),
            held_out_loss=None if minimum.held_out_loss is None else float(minimum.held_out_loss[0]),
            steps=minimum.steps,
            seconds=minimum.seconds,
            history=minimum.history,
            uncertainty=None,
            quality=residual_quality(measurement, model),
        )


class OutputErrorLoss:
    """The maximum-likelihood loss under the sensors' noise, from whatever sensors there are."""

    weighs_noise = True
    label = "root mean square deviation of the readings\nover their noise (-)"

    def diagnose(self, measurement: Measurement, setup: FitSetup) -> Diagnosis:
        """As :meth:`ResidualLoss.diagnose`, by least squares of the forces at the bearings, or by the model's own
        features, and bearings that explain the readings, where sensors are few.
        """

        def suppose(data: Measurement) -> tuple[np.ndarray, BearingTable]:
            from pipeline.identification.output_error_start import drawn_basis, find_likely

            start, points = find_likely(measurement, setup), data.dataset.points
            features = drawn_basis(setup, data, points).at(points).numpy()
            return np.asarray(features), start.problem.identified(start.weights).table(measurement.known)

        return diagnose_response(measurement, setup.constant, suppose)

    def expect(self, measurement: Measurement, setup: FitSetup, diagnosis: Diagnosis) -> BearingTable:
        """The deviations of the fit that will be made, at its likely start, for all functions of the model
        (:func:`pipeline.identification.uncertainty.expect_uncertainty`).
        """
        from pipeline.identification.output_error_start import find_likely
        from pipeline.identification.uncertainty import expect_uncertainty

        if not setup.model.has_laws and not diagnosis.solved:
            return diagnosis.expected
        start = find_likely(measurement, setup)
        kind = "constants over all speeds" if setup.constant else "smooth functions over all speeds"
        kind, precision = "bearing laws of few numbers" if setup.model.has_laws else kind, 1.0
        if start.searched and setup.loss.noise == "estimated":
            precision = start.searched.precision
            kind += f", whose readings show {write_rough(1 / precision)} times that noise"
        expected = expect_uncertainty(start, precision)
        return replace(expected.state(expected.identified.table(measurement.known)), by=kind)

    def fit(
        self,
        measurement: Measurement,
        setup: FitSetup,
        progress: Progress | None = None,
        diagnosis: Diagnosis | None = None,
    ) -> Fit:
        """The fit by its rounds of precisions; a ``diagnosis`` at hand is not made again. Raises as :func:`fit`."""
        from pipeline.identification.answer import conclude
        from pipeline.identification.output_error_fit import fit_output_error

        if not setup.force and setup.model.has_laws:
            require_temperatures(measurement.laws, measurement.dataset.operating)
        elif not setup.force:
            require_identifiable((diagnosis or self.diagnose(measurement, setup)).reports)
        return conclude(fit_output_error(measurement, setup, progress))


_LABELS = {
    "residual": "root mean square residual\nover bearing force (-)",
    "preconditioned": "root mean square distance of the unknowns\nover their scale (-)",
}


Loss = ResidualLoss | OutputErrorLoss
"""What a fit minimises, and what follows from that."""


def loss_of(config: LossConfig) -> Loss:
    """The loss that a configuration names."""
    return OutputErrorLoss() if config.kind == "response" else ResidualLoss(config)
