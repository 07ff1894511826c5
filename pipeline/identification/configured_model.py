"""From a configuration to the coefficient model that it describes."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace

import numpy as np

from pipeline.coefficients import CoefficientName
from pipeline.config.models import ModelConfig
from pipeline.errors import ConfigError
from pipeline.identification.inputs import SPEED, varying
from pipeline.identification.model import CoefficientModel


def coefficient_model(
    config: ModelConfig, unknowns: tuple[CoefficientName, ...], points: Mapping[str, np.ndarray], scale: np.ndarray
) -> CoefficientModel:
    """The model that a configuration describes, for data at ``points``: name -> (S,), the speed in rad/s.

    ``scale`` (M, U) is the size of each unknown, N/m and N s/m. Operating conditions that vary are inputs beside the
    speed. Raises ConfigError for such conditions where the model is made of functions of the speed alone.
    """
    rows = tuple(tuple(float(v) for v in row) for row in scale)
    constant = CoefficientModel(
        unknowns=unknowns, inputs=(SPEED,), parametrisation=config.parametrisation, scale=rows, hidden=None
    )
    if not config.varies:
        return constant
    inputs = varying(points)
    if config.of_speed_alone and len(inputs) > 1:
        raise ConfigError(
            f"model.kind={config.kind} is made of functions of the speed alone, but the data have {inputs[1]}, too: "
            "choose model=network_operating"
        )
    ranges = tuple((float(points[name].min()), float(points[name].max())) for name in inputs)
    return replace(constant, **{"inputs": inputs, "ranges": ranges, "input_scaling": "log_rpm"} | config.shape)
