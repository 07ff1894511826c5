"""From a table of records to SI and back: every unit, sense and datum of angles."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from ingest.test_records import configure, write
from pipeline.config.measured import NoRecordingsConfig
from pipeline.ingest.conventions import SourceUnits


@pytest.mark.parametrize(
    "conventions",
    [
        {"length": "mil", "amplitude": "peak_to_peak", "phase": "lag", "speed": "rpm"},
        {"length": "um", "amplitude": "zero_to_peak", "phase": "lead", "speed": "rpm"},
        {"velocity": "mm/s", "amplitude": "rms", "phase": "lag", "speed": "rpm"},
    ],
)
@pytest.mark.parametrize("shaft_angle", ["with_rotation", "against_rotation", "from_x"])
def test_what_is_read_comes_back(conventions: dict[str, str], shaft_angle: str, tmp_path: Path) -> None:
    path = write(tmp_path / "records.csv", "one,1,1000,3,4,1,2,,\ntwo,1,1500,-3,0.5,0.25,-7,,\n")
    mounted = {"mounted": "shaft"} if "velocity" in conventions else {}
    probes = {"a": {"node": 1, "angle": "0 deg", "columns": {"real": "a_re", "imaginary": "a_im"}} | mounted}
    config = configure(path, conventions=conventions, shaft_angle=shaft_angle, probes=probes)
    records, source = config.read_records(), SourceUnits(config)
    np.testing.assert_allclose(source.vectors(records.displacement, records.speeds)[:, 0], [1 + 2j, 0.25 - 7j])
    np.testing.assert_allclose(source.weights(records.unbalance)[:, 0], [3 + 4j, -3 + 0.5j])
    assert source.unit == next(iter(conventions.values()))
    for angle in (0.0, 1.0, -2.0):
        unbalance = 1e-6 * np.exp(1j * np.array([source.recordings.angle_from_x(angle)]))
        np.testing.assert_allclose(source.weights(unbalance), np.exp(1j * np.array([angle])))


def test_without_a_table_of_records_it_is_micrometres_and_angles_from_x() -> None:
    source = SourceUnits(NoRecordingsConfig(format="none"))
    np.testing.assert_allclose(source.vectors(np.array([[2e-6j]]), np.ones(1)), [[2j]])
    np.testing.assert_allclose(source.weights(np.array([2e-6j])), [2j])
    assert (source.unit, source.probes) == ("um", ())
