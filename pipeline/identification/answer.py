"""The answer of a fit by the output error: everything that follows from its minimum, under one covariance."""

from __future__ import annotations

from dataclasses import replace
from typing import TYPE_CHECKING, Any

import numpy as np

from pipeline.identification.basis import Basis
from pipeline.identification.identified import Fit, FittedParameter, IdentifiedModel, PhysicalNumber
from pipeline.identification.law_evidence import describe_laws
from pipeline.identification.output_error_fit import OutputErrorFit
from pipeline.identification.problem import OutputError, output_error
from pipeline.identification.quality import output_error_quality
from pipeline.identification.uncertainty import Uncertainty, measure_uncertainty
from pipeline.problem.measurement import Measurement

if TYPE_CHECKING:
    import torch


def conclude(fit: OutputErrorFit) -> Fit:
    """The model, how well it explains the readings, and how well everything in it is known."""
    quality = output_error_quality(fit)
    uncertainty = measure_uncertainty(fit, quality)
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


def restore(
    measurement: Measurement, identified: IdentifiedModel, uncertainty: Uncertainty
) -> tuple[OutputError, torch.Tensor]:
    """The problem of a fit at the readings of ``measurement``, and the fit's weights (1, 1, Z).

    ``measurement`` is at the fitted model parameters; it may have other speeds and runs than the fit.
    """
    import torch

    to_features = torch.as_tensor(uncertainty.weights)  # (M, F, K)
    basis = Basis(identified.model, identified.parameters, to_features, 0)
    made = output_error(measurement, basis, uncertainty.plane_scale)
    places, (member, unknown) = uncertainty.places, uncertainty.active.T.tolist()
    count = to_features.shape[-1]
    told = np.diag(uncertainty.covariance)[places.coefficients].reshape(len(member), -1)[:, :count] > 0
    kept, precision = torch.as_tensor(told), torch.as_tensor(uncertainty.precision)
    problem = replace(made, kept=kept, precision=precision)
    output = identified.parameters[:, -to_features.shape[1] * len(identified.unknowns.names) :]
    output = output.unflatten(-1, (to_features.shape[1], -1))  # (M, F, U)
    coordinates = (torch.linalg.pinv(to_features) @ output)[member, :, unknown] * kept
    weights = torch.zeros(1, 1, problem.size, dtype=torch.float64)
    weights[0, 0, problem.places.coefficients] = coordinates.flatten()
    if identified.theta is not None:
        weights[0, 0, problem.places.numbers] = identified.theta
    unbalance = torch.as_tensor(uncertainty.residual_unbalance / uncertainty.plane_scale)
    weights[0, 0, problem.places.planes] = torch.view_as_real(unbalance).flatten()
    weights[0, 0, problem.places.parameters] = torch.as_tensor(uncertainty.parameters)
    return problem, weights


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
