"""The answer of a fit by the output error: everything that follows from its minimum, under one covariance."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np

from pipeline.identification.identified import Fit, FittedParameter, PhysicalNumber
from pipeline.identification.law_evidence import describe_laws
from pipeline.identification.output_error_fit import OutputErrorFit
from pipeline.identification.quality import output_error_quality
from pipeline.identification.uncertainty import Uncertainty, uncertainty_of


def conclude(fit: OutputErrorFit) -> Fit:
    """The model, how well it explains the readings, and how well everything in it is known."""
    quality = output_error_quality(fit)
    uncertainty = uncertainty_of(fit, quality)
    numbers, parameters = _list_numbers(fit, uncertainty), _list_parameters(fit, uncertainty)
    summary: dict[str, Any] = dict(quality.summary)
    if numbers:
        summary |= describe_laws(fit, numbers)
    if parameters:
        summary["model_parameters"] = {
            number.parameter.name: {
                "prior_deviation": number.parameter.deviation,
                "value": number.value * number.parameter.deviation,
                "deviation": number.deviation * number.parameter.deviation,
            }
            for number in parameters
        }
    return Fit(
        model=fit.identified,
        outcome=fit.minimum.outcomes[0],
        loss=float(fit.problem.loss(fit.weights)),
        held_out_loss=None,
        steps=fit.minimum.steps,
        seconds=fit.minimum.seconds,
        history=fit.minimum.history,
        uncertainty=uncertainty,
        quality=replace(quality, summary=summary),
        numbers=numbers,
        parameters=parameters,
    )


def _list_numbers(fit: OutputErrorFit, uncertainty: Uncertainty) -> tuple[PhysicalNumber, ...]:
    """The numbers of the bearing laws; none without laws."""
    laws = fit.problem.measurement.laws
    if laws is None:
        return ()
    spread = np.sqrt(np.diag(uncertainty.covariance)[uncertainty.places.numbers])
    values = laws.numbers(fit.problem.theta(fit.weights)[0].numpy())
    return tuple(
        PhysicalNumber(
            parameter.name, float(value), float(value * share), parameter.unit, parameter.guess, parameter.within
        )
        for parameter, value, share in zip(laws.parameters, values, spread, strict=True)
    )


def _list_parameters(fit: OutputErrorFit, uncertainty: Uncertainty) -> tuple[FittedParameter, ...]:
    """T, each with its posterior."""
    every = zip(
        fit.problem.measurement.parameters, uncertainty.parameters, uncertainty.parameter_deviation(), strict=True
    )
    return tuple(FittedParameter(parameter, float(value), float(spread)) for parameter, value, spread in every)
