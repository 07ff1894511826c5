"""From a measurement to its coefficients: the one door of identification."""

from __future__ import annotations

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
from pipeline.identification.losses import loss_of
from pipeline.identification.training import FitSetup, Progress
from pipeline.problem.diagnosis import Diagnosis
from pipeline.problem.measurement import Guess, Measurement


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
    model: ModelConfig
    if constant:
        model = ConstantModelConfig.model_validate(shared | {"kind": "constant"})
    else:
        model = NetworkModelConfig.model_validate(shared | network | {"kind": "network"})
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
