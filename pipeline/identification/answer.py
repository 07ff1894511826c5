"""The answer of a fit by the output error: everything that follows from its minimum, under one covariance."""

from __future__ import annotations

from dataclasses import replace
from typing import TYPE_CHECKING, Any

import numpy as np

from pipeline.identification.blocks import Basis, Prior
from pipeline.identification.identified import Fit
from pipeline.identification.output_error_fit import OutputErrorFit
from pipeline.identification.problem import OutputError, output_error
from pipeline.identification.quality import output_error_quality
from pipeline.identification.uncertainty import Uncertainty, measure_uncertainty
from pipeline.parameters.kind import ModelParameter
from pipeline.parameters.model import set_values
from pipeline.problem.law_information import LawInformation
from pipeline.problem.measurement import Measurement
from pipeline.problem.slopes import deviate

if TYPE_CHECKING:
    import torch


def conclude(fit: OutputErrorFit) -> Fit:
    """The model, how well it explains the readings, and how well everything in it is known."""
    quality = output_error_quality(fit)
    uncertainty = measure_uncertainty(fit, quality)
    parameters = _list_parameters(fit, uncertainty)
    summary: dict[str, Any] = dict(quality.summary)
    if fit.start.starts[0]:
        summary["fit"] |= {"starts": dict(zip(("fitted", "at_this_answer"), fit.start.starts, strict=True))}
    if fit.start.searched:
        nodes, kinds = fit.start.measurement.rotor.bearing_nodes, fit.start.searched.kinds
        summary["fit"] |= {
            "kinds": [
                {"share": share, "of": dict(zip(map(str, nodes), several, strict=True))}
                for several, share in kinds.items()
            ]
        }
    if uncertainty.places.n_numbers:
        summary |= _describe_laws(fit, uncertainty)
    if parameters:
        summary["model_parameters"] = {
            parameter.name: {
                "prior_deviation": parameter.deviation,
                "value": parameter.shift,
                "deviation": parameter.left * parameter.deviation,
                **parameter.number,
            }
            for parameter in parameters
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
        parameters=parameters,
    )


def restore(measurement: Measurement, uncertainty: Uncertainty) -> tuple[OutputError, torch.Tensor]:
    """The problem of a fit at the readings of ``measurement``, and the fit's weights (1, 1, Z): those of the functions
    are deviations from the answer. So priors of functions say how far these may go, and nothing of where they aim.

    ``measurement`` is at the fitted model parameters; it may have other speeds and runs than the fit.
    """
    import torch

    identified = uncertainty.identified
    (n_active, count), precision = uncertainty.precision.shape, torch.as_tensor(uncertainty.precision)
    told = np.diag(uncertainty.covariance)[uncertainty.places.coefficients].reshape(n_active, -1)[:, :count] > 0
    rows, aims = map(torch.as_tensor, uncertainty.functions)
    basis = Basis(identified.model, identified.parameters, torch.as_tensor(uncertainty.weights), 0)
    measurement = replace(measurement, laws=identified.laws, as_found=tuple(uncertainty.as_found.tolist()))
    made = output_error(measurement, basis, uncertainty.plane_scale)
    functions = Prior(rows, torch.zeros_like(aims))
    problem = replace(made, kept=torch.as_tensor(told), precision=precision, functions=functions)
    unbalance = torch.as_tensor(uncertainty.residual_unbalance / uncertainty.plane_scale)
    weights = problem.weigh(
        numbers=identified.theta,
        planes=torch.view_as_real(unbalance).flatten(),
        parameters=torch.as_tensor(uncertainty.parameters),
    )
    return problem, weights


def _list_parameters(fit: OutputErrorFit, uncertainty: Uncertainty) -> tuple[ModelParameter, ...]:
    """T, each with its posterior."""
    spread = np.sqrt(np.diag(uncertainty.covariance)[uncertainty.places.parameters])
    fitted = set_values(fit.problem.measurement.parameters, uncertainty.parameters)
    return tuple(replace(parameter, left=float(after)) for parameter, after in zip(fitted, spread, strict=True))


def _describe_laws(fit: OutputErrorFit, uncertainty: Uncertainty) -> dict[str, Any]:
    """Parts of ``metrics.json`` and ``training.json``; SI.

    ``physical_numbers`` by name; ``law`` says the share of points beyond the table of each bearing; ``correction`` the
    root mean square of the network's correction over the data, and that of its standard deviation, in percent of each
    coefficient (of a cross-coupled one, of the size of the direct ones).
    """
    problem, laws = fit.problem, fit.problem.measurement.laws
    data, theta, numbers = problem.measurement.dataset, problem.theta(fit.weights), uncertainty.places.numbers
    outside = laws.outside(theta, data.speeds, data.operating)[0]
    told = LawInformation(laws.parameters, uncertainty.covariance[numbers, numbers])
    values = laws.numbers(theta[0].numpy())
    summary: dict[str, Any] = {
        "physical_numbers": {
            number.name: {
                "value": float(values[i]),
                "deviation": float(values[i] * told.deviation[i]),
                "unit": number.unit,
                "guess": number.guess,
                "determined": bool(told.determined[i]),
            }
            for i, number in enumerate(laws.parameters)
        },
        "law": {"outside_table": {str(node): float(share) for node, share in zip(laws.nodes, outside, strict=True)}},
    }
    if fit.start.by_evidence:
        summary["correction"] = _correction(fit)
    return summary


def _correction(fit: OutputErrorFit) -> dict[str, dict[str, dict[str, float]]]:
    """Node -> coefficient -> percent and its deviation."""
    problem, unknowns = fit.problem, fit.problem.measurement.unknowns
    outputs, spread = problem.outputs(fit.weights)[0].numpy(), fit.covariance()
    count = problem.features.shape[-1]
    result: dict[str, dict[str, dict[str, float]]] = {}
    for a, (m, u) in enumerate(problem.active):
        features, columns = problem.features[m].numpy(), slice(a * count, (a + 1) * count)
        size = {"percent": outputs[m, :, u], "deviation_percent": deviate(features, spread[columns, columns])}
        result.setdefault(str(problem.measurement.rotor.bearing_nodes[m]), {})[unknowns.names[u]] = {
            name: float(100 * np.sqrt((values**2).mean())) for name, values in size.items()
        }
    return result
