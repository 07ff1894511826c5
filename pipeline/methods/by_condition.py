"""Methods that know no operating conditions, used at each of them by itself: what one does without such a model."""

from __future__ import annotations

from dataclasses import replace
from typing import TYPE_CHECKING

import numpy as np

from pipeline.data.operating import split_states
from pipeline.data.operating_points import group_rows
from pipeline.problem.measurement import Measurement

if TYPE_CHECKING:
    from collections.abc import Callable

    from pipeline.methods.method import Estimate


def solve_each(solve: Callable[[Measurement], Estimate], measurement: Measurement) -> Estimate:
    """The answers of ``solve`` at each operating condition, put together. Raises the first Refusal.

    Points of a condition that were not measured in the same runs are answered apart, each with its own runs.
    """
    data, values = measurement.dataset, np.array(measurement.known.values)
    states = [
        points[rows]
        for _, points in split_states(data.speeds, data.operating)
        for rows in group_rows(data.present[points])
    ]
    answers = [(points, solve(_alone(measurement, points))) for points in states]
    deviations = [answer.deviation for _, answer in answers]
    together = None if any(deviation is None for deviation in deviations) else np.full(values.shape, np.nan)
    for points, answer in answers:
        values[:, points] = answer.coefficients.values
        if together is not None and answer.deviation is not None:
            together[:, points] = answer.deviation
    looked_at = [len(points) if estimate.n_speeds is None else estimate.n_speeds for points, estimate in answers]
    return replace(
        answers[0][1],
        coefficients=replace(measurement.known, values=values),
        deviation=together,
        words=f"each of {len(states)} conditions by itself; the first: {answers[0][1].words}",
        doubt=next((answer.doubt for _, answer in answers if answer.doubt), ""),
        n_speeds=None if all(estimate.n_speeds is None for _, estimate in answers) else sum(looked_at),
    )


def _alone(measurement: Measurement, points: np.ndarray) -> Measurement:
    """The measurement at the ``points`` (indices) in the runs that have them, as if it had no operating conditions."""
    state = measurement.select(points, np.flatnonzero(measurement.dataset.present[points[0]]))
    data = replace(state.dataset, operating={})
    return replace(state, dataset=data, known=replace(state.known, operating={}))
