"""Methods of the speed alone on data at several operating conditions."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from comparing import FILM, machine, options, task

from pipeline.comparison.cases import Case
from pipeline.methods.catalogue import METHODS
from pipeline.problem.measurement import Measurement
from pipeline.rotor.bearing_table import BearingTable

CASE = Case(0.01, "all", 12)
COLD, WARM = 318.15, 338.15


def _join(cold: Measurement, warm: Measurement) -> Measurement:
    """The readings of both, as if they were of two oil temperatures."""
    first, second = cold.dataset, warm.dataset
    at = {"oil_temperature": np.repeat([COLD, WARM], len(first.speeds))}
    speeds = np.tile(first.speeds, 2)
    displacement = np.concatenate([first.displacement, second.displacement])
    data = replace(first, speeds=speeds, displacement=displacement, operating=at)
    values = np.concatenate([cold.known.values, warm.known.values], axis=1)
    return replace(cold, dataset=data, known=BearingTable(cold.known.nodes, speeds, values, at))


@pytest.mark.parametrize("method", ["least_squares", "smoothed"])
def test_each_condition_is_answered_by_itself(method: str) -> None:
    parts = [task(replace(CASE, data_set=i), *FILM) for i in range(2)]
    both = METHODS[method].identify(_join(*parts), options(*FILM))
    alone = [METHODS[method].identify(part, options(*FILM)) for part in parts]
    assert not np.array_equal(alone[0].coefficients.values, alone[1].coefficients.values)
    joined = np.concatenate([of.coefficients.values for of in alone], axis=1)
    np.testing.assert_array_equal(both.coefficients.values, joined)
    stated = [of.coefficients.deviation for of in alone]
    np.testing.assert_array_equal(both.coefficients.deviation, np.concatenate(stated, axis=1))
    assert "each of 2 conditions" in both.words


def test_points_are_answered_from_the_runs_that_were_measured_there() -> None:
    """A run that the warm state lacks is no run of zeros."""
    parts = [task(replace(CASE, data_set=i), *FILM) for i in range(2)]
    both = _join(*parts)
    count = len(parts[0].dataset.speeds)
    present = np.ones((2 * count, len(both.dataset.runs)), dtype=bool)
    present[count:, 0] = False
    data = replace(both.dataset, present=present, displacement=both.dataset.displacement * present[:, None])
    found = METHODS["least_squares"].identify(replace(both, dataset=data), options(*FILM)).coefficients.values
    fewer = parts[1].select(None, np.arange(1, len(both.dataset.runs)))
    alone = [METHODS["least_squares"].identify(part, options(*FILM)) for part in (parts[0], fewer)]
    np.testing.assert_array_equal(found, np.concatenate([of.coefficients.values for of in alone], axis=1))


def test_a_case_of_few_speeds_has_them_at_each_condition() -> None:
    whole = machine(*FILM)
    count = len(whole.vibration.speeds)
    at = {"oil_temperature": np.repeat([COLD, WARM], count)}
    two = replace(whole, vibration=replace(whole.vibration, speeds=np.tile(whole.vibration.speeds, 2), operating=at))
    assert two.n_speeds == count
    one = whole.speeds(CASE)
    np.testing.assert_array_equal(two.speeds(CASE), np.concatenate([one, one + count]))
