"""A table of records: conventions against hand-made numbers, and the mistakes that it names."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from pipeline.data.conditions import gather_conditions
from pipeline.data.dataset import synchronous
from pipeline.data.excitation_files import write_excitation
from pipeline.data.vibration_files import read_measured, write_vibration
from pipeline.errors import DataError
from pipeline.ingest.records import RecordsConfig, find_speeds, to_dataset

HEADER = "condition,acq,rpm,U_re,U_im,a_re,a_im,b_re,b_im\n"
ROWS = (
    "base,1,1000,0,0,0.1,0.2,0,0.1\n"
    "base,1,1204,0,0,0.1,0.2,0,0.1\n"
    "base,2,1002,0,0,0.1,0.2,0,0.1\n"
    "base,2,1200,0,0,0.1,0.2,0,0.1\n"
    "trial,1,1001,0,30,1,2,0,0.5\n"
    "trial,1,1201,0,30,1,2,0,0.5\n"
)
BLANK = "x,1,1000,,,1,2,0,0.5\n"


def configure(path: Path, **changed: object) -> RecordsConfig:
    given = {
        "format": "records",
        "file": str(path),
        "conventions": {"length": "mil", "amplitude": "peak_to_peak", "phase": "lag", "speed": "rpm"},
        "columns": {"speed": "rpm", "condition": "condition", "record": "acq"},
        "probes": {
            "a": {"node": 1, "angle": "0 deg", "columns": {"real": "a_re", "imaginary": "a_im"}},
            "b": {"node": 1, "angle": "90 deg", "columns": {"real": "b_re", "imaginary": "b_im"}},
        },
        "weights": [{"node": 3, "unit": "g mm", "columns": {"real": "U_re", "imaginary": "U_im"}}],
        "shaft_angle": "against_rotation",
        "tacho": {"angle": "30 deg"},
    }
    return RecordsConfig.model_validate(given | changed)


def write(path: Path, rows: str = ROWS) -> Path:
    path.write_text(HEADER + rows, encoding="utf-8")
    return path


def test_conventions_units_and_conditions(tmp_path: Path) -> None:
    dataset = to_dataset(configure(write(tmp_path / "a table.csv")).read_records())
    assert (dataset.runs, dataset.conditions) == (("base.1", "base.2", "trial.1"), ("base", "base", "trial"))
    # Half of 1 + 2j mil, conjugated: a lag.
    assert dataset.displacement[0, 0, 2] == pytest.approx(25.4e-6 / 2 * (1 - 2j))
    trial = dataset.excitation_of(2)[0]
    assert (trial.magnitude, np.degrees(trial.phase) % 360) == pytest.approx((30e-6, (30 - 90) % 360))  # p = T - s
    assert dataset.speeds == pytest.approx(np.array([1001.0, 3605.0 / 3]) * np.pi / 30)
    assert dataset.frequencies[1, 0] == pytest.approx(1204 * np.pi / 30)


def test_files_give_back_the_data_set(tmp_path: Path) -> None:
    dataset = to_dataset(configure(write(tmp_path / "a.csv")).read_records())
    again = read_measured(write_vibration(tmp_path / "v.csv", dataset), write_excitation(tmp_path / "e.csv", dataset))
    assert (again.runs, again.conditions, again.displacement, again.frequencies) == (
        dataset.runs,
        dataset.conditions,
        pytest.approx(dataset.displacement, rel=1e-12),
        pytest.approx(dataset.frequencies, rel=1e-12),
    )
    assert synchronous(again.frequencies, again.speeds[:, None]).all()


def test_blank_weights_are_kept_for_who_asks_for_them(tmp_path: Path) -> None:
    assert np.isnan(configure(write(tmp_path / "a.csv", BLANK)).read_records().unbalance).all()


@pytest.mark.parametrize(
    ("rows", "law"),
    [
        (ROWS + "trial,1,1001,0,30,1,2,0,0.5\n", "'trial.1' is there 2 times near 100"),
        (ROWS + "trial,2,1001,0,31,1,2,0,0.5\ntrial,2,1200,0,31,1,2,0,0.5\n", "same weights in all records"),
        (ROWS.replace(",1000,", ",-1000,"), "speeds above zero"),
        (ROWS.replace("0.1,0.2", ",0.2"), "the vector of every probe"),
        (BLANK, "must have the weights of every plane in every row, but row 1"),
        (
            "".join(f"x,{i},{1000 + i},0,30,1,2,0,0\n" for i in range(1001)),
            "1,001 records are of 1,001 runs at 1,001 sp",
        ),
    ],
)
def test_mistakes_in_the_table(tmp_path: Path, rows: str, law: str) -> None:
    with pytest.raises(DataError, match=law):
        to_dataset(configure(write(tmp_path / "a.csv", rows)).read_records())


def test_a_record_may_be_at_some_speeds_alone(tmp_path: Path) -> None:
    dataset = to_dataset(configure(write(tmp_path / "a.csv", ROWS + "trial,2,1003,0,30,3,4,0,0.7\n")).read_records())
    assert dataset.present.tolist() == [[True] * 4, [True, True, True, False]]
    conditions = gather_conditions(dataset)
    assert (conditions.displacement[1, 0, 0], conditions.own_speeds[1]) == (
        pytest.approx(25.4e-6 / 2 * (2 - 3j)),
        pytest.approx(np.array([1002.0, 1201.0]) * np.pi / 30),
    )


def test_records_over_a_range_wider_than_a_nominal_speed_stand_each_for_itself() -> None:
    close, wide = np.array([100.5, 100.0]), np.linspace(110.0, 220.0, 400)
    speeds, group = find_speeds(np.concatenate([wide[::-1], close]))
    assert speeds == pytest.approx([100.25, *wide])
    assert group.tolist() == [*range(400, 0, -1), 0, 0]


@pytest.mark.parametrize(
    ("changed", "law"),
    [
        ({"shaft_angle": None}, "must say in shaft_angle"),
        ({"tacho": {}}, "must give tacho.angle"),
        ({"baseline": "base"}, "must have no baseline"),
        ({"file": None}, "must name the file"),
        ({"weights": [{"node": 3, "unit": "kg", "columns": {"real": "a", "imaginary": "b"}}]}, "must convert to kg"),
    ],
)
def test_mistakes_in_the_configuration(tmp_path: Path, changed: dict[str, object], law: str) -> None:
    with pytest.raises(ValueError, match=law):
        configure(tmp_path / "a.csv", **changed)
