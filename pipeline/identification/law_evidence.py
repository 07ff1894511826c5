"""What a fit says of its bearing laws: their numbers, where tables end, and how much a network corrects them."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING, Any

import numpy as np

from pipeline.identification.identified import PhysicalNumber

if TYPE_CHECKING:
    from pipeline.identification.output_error_fit import OutputErrorFit


def describe_laws(fit: OutputErrorFit, numbers: Sequence[PhysicalNumber]) -> dict[str, Any]:
    """Parts of ``metrics.json`` and ``training.json``; SI.

    ``physical_numbers`` by name; ``law`` says how many guesses were tried and how many ended at this answer, and the
    share of points beyond the table of each bearing; ``correction`` the root mean square of the network's correction
    over the data, and that of its standard deviation, in percent of each coefficient (of a cross-coupled one, of the
    size of the direct ones).
    """
    problem, start, laws = fit.problem, fit.start, fit.problem.measurement.laws
    assert laws is not None
    data, theta = problem.measurement.dataset, problem.theta(fit.weights)
    outside = laws.outside(theta, data.speeds, data.operating)[0]
    summary: dict[str, Any] = {
        "physical_numbers": {
            number.name: {
                "value": number.value,
                "deviation": number.deviation,
                "unit": number.unit,
                "guess": number.guess,
                "determined": number.determined,
            }
            for number in numbers
        },
        "law": {"outside_table": {str(node): float(share) for node, share in zip(laws.nodes, outside, strict=True)}},
    }
    if start.law is not None:
        summary["law"] |= {"starts": start.law.n_starts, "starts_at_this_answer": start.law.n_same}
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
        variance = np.einsum("sk,kl,sl->s", features, spread[columns, columns], features)
        size = {"percent": outputs[m, :, u] ** 2, "deviation_percent": variance}
        result.setdefault(str(problem.measurement.rotor.bearing_nodes[m]), {})[unknowns.names[u]] = {
            name: float(100 * np.sqrt(squares.mean())) for name, squares in size.items()
        }
    return result
