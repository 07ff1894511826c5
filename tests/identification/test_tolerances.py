"""What tolerances that are not fitted do to the deviations, held to fits that have them among their parameters."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from running import composed
from small_rotor import DIRECT, FITTED, small_machine

from pipeline.identification.fit import fit
from pipeline.identification.training import setup_of
from pipeline.parameters.model import USUAL, usual_tolerances
from pipeline.problem.measurement import Measurement

SETUP = setup_of(composed(*FITTED))
SPEEDS = np.linspace(60.0, 300.0, 9)


def tolerant(stated: tuple[str, ...] = ()) -> Measurement:
    """A machine whose shaft, weights and probes are known as well as they usually are."""
    measurement, _ = small_machine(DIRECT, (0.3, 0.3), SPEEDS)
    given = usual_tolerances(stated, measurement.rotor, measurement.dataset, measurement.known, measurement.unknowns)
    return replace(measurement, tolerances=given)


def deviation_of(measurement: Measurement) -> np.ndarray:
    return np.asarray(fit(measurement, SETUP).deviation(SPEEDS))[:, 0, [0, 3, 4, 7]]


@pytest.mark.slow
def test_a_coefficient_is_known_as_well_as_if_they_were_fitted() -> None:
    """The same information is inverted; what the readings tell of a tolerance is told in both ways."""
    measurement = tolerant()
    alone = deviation_of(replace(measurement, tolerances=()))
    unfitted = deviation_of(measurement)
    together = deviation_of(replace(measurement, parameters=measurement.tolerances, tolerances=()))
    assert (unfitted > 1.5 * alone).all()
    np.testing.assert_allclose(unfitted, together, rtol=0.3)


def test_the_answer_stays_as_it_is() -> None:
    measurement = tolerant()
    exact, wide = (fit(one, SETUP).model.values(SPEEDS) for one in (replace(measurement, tolerances=()), measurement))
    np.testing.assert_array_equal(exact, wide)


def test_each_kind_is_a_part_of_the_whole() -> None:
    """One kind alone is that of a machine where no other is uncertain."""
    measurement = tolerant()
    whole = fit(measurement, SETUP)
    assert whole.uncertainty.unfitted.names == list(USUAL)
    assert len(whole.uncertainty.unfitted.select("probe_gain").kinds) == len(measurement.dataset.channels)
    assert (
        np.linalg.eigvalsh(whole.uncertainty.without_tolerances).min()
        > -1e-9 * np.abs(whole.uncertainty.without_tolerances).max()
    )


def test_what_is_stated_is_not_counted_twice() -> None:
    assert {one.kind for one in tolerant(("density", "probe_gain")).tolerances} == USUAL.keys() - {
        "density",
        "probe_gain",
    }
    assert tolerant(tuple(USUAL)).tolerances == ()


@pytest.mark.parametrize("share", [0.5, 2.0])
def test_wider_tolerances_move_in_proportion_where_the_readings_tell_nothing(share: float) -> None:
    """Density hardly shows: its part of the deviation grows as it does."""
    measurement = tolerant(tuple(name for name in USUAL if name != "density"))
    tiny = replace(measurement.tolerances[0], deviation=1e-5)
    parts = []
    for one in (tiny, replace(tiny, deviation=1e-5 * share)):
        found = fit(replace(measurement, tolerances=(one,)), SETUP)
        covariance = found.uncertainty.unfitted.covariance()
        parts.append(found.uncertainty.deviation(SPEEDS, covariance=covariance)[:, 0, [0, 3]])
    np.testing.assert_allclose(parts[1], share * parts[0], rtol=1e-3)
