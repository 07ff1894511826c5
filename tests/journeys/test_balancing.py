"""A balancing engineer's afternoon on the measured rig: unbalance, screws, own tables, and mistakes in them."""

from __future__ import annotations

import csv
from pathlib import Path

import numpy as np
import pytest
from conftest import DATA, Artifacts, assert_says
from running import ROOT, composed, strict_json

from pipeline.balance import fitted
from pipeline.errors import ConfigError, DataError
from pipeline.stages import run_stage

pytestmark = pytest.mark.slow
RECORDS = ROOT / "examples" / "rk4" / "records.csv"
Rows = list[dict[str, str]]


def _read(path: Path) -> Rows:
    with path.open(encoding="utf-8") as file:
        return list(csv.DictReader(file))


def _write(path: Path, rows: Rows, without: str = " ") -> Path:
    names = [name for name in rows[0] if not name.startswith(without)]
    with path.open("w", newline="", encoding="utf-8") as file:
        writer = csv.DictWriter(file, names, extrasaction="ignore")
        writer.writeheader()
        writer.writerows(rows)
    return path


@pytest.fixture(scope="module")
def folder(artifacts: Artifacts, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """With what the graph read of the rig's records."""
    return artifacts.copied("rk4", DATA - {"modelled_coefficients.csv"}, tmp_path_factory.mktemp("rk4"))


def _run(folder: Path, stage: str, *overrides: str) -> None:
    run_stage(composed("experiment=rk4", "tracking=none", f"output={folder}", f"stage={stage}", *overrides))


def _some(*conditions: str) -> Rows:
    return [row for row in _read(RECORDS) if row["condition"] in conditions]


def test_screws_are_told_from_records_without_labels(folder: Path, tmp_path: Path) -> None:
    """One speed, one record a condition, a probe less: the screws lie within the circles, and the sheet holds."""
    rows = [r for r in _some("A007", "B009", "B020") if r["acq"] == "2" and r["speed_id"] == "N2"]
    file = _write(tmp_path / "given.csv", [{k: v for k, v in r.items() if "plane1_x" not in k} for r in rows], "U")
    _run(folder, "balance", f"balance.records={file}", "balance.condition=B009", "balance.remove=condition")
    found = _read(folder / "balance.csv")
    assert {row["vectors"] for row in found} == {"3"}
    assert {row["known_g_mm"] for row in found if "known_g_mm" in row} <= {""}
    screws = {("A007", "8"): 48, ("B009", "8"): -24j, ("B020", "20"): -24}
    for row in found:
        value = complex(float(row["unbalance_re_g_mm"]), float(row["unbalance_im_g_mm"]))
        assert abs(value - screws.get((row["condition"], row["node"]), 0)) < float(row["circle_g_mm"])
        assert float(row["magnitude_low_g_mm"]) <= abs(value) <= float(row["magnitude_high_g_mm"])
    sheet = strict_json(folder / "balance.json")["sheet"]
    assert sheet["planes"][0]["remaining_g_mm"] < 2
    # 24 g mm at 270 degrees are held by 0.8 g opposite, in hole 5 of 16 (90 degrees).
    assert any(w["hole"] in (4, 5, 6) for w in sheet["planes"][0]["weights"])
    assert (folder / "figures" / "balance.png").stat().st_size > 10_000


def test_the_machines_own_unbalance_goes_away(folder: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """The sheet's weights, by the same coefficients, leave a tenth of the vibration."""
    file = _write(tmp_path / "base.csv", _some("BASE"))
    _run(folder, "balance", f"balance.records={file}")
    assert "would fewer do?" in capsys.readouterr().out
    sheet = strict_json(folder / "balance.json")["sheet"]
    before, after = (np.array([one[k] for one in sheet["vibration"]]) for k in ("before", "after"))
    assert np.linalg.norm(after) < 0.1 * np.linalg.norm(before)
    assert {one["unit"] for one in sheet["vibration"]} == {"mil"}
    assert [of["verdict"] for of in sheet["tolerance"]] == ["met", "met"]


def test_known_weights_foretell_the_vibration(folder: Path, tmp_path: Path) -> None:
    """Predictions need no vectors; with vectors beside them, most lie in their circles."""
    rows = _some("A003", "A020", "B005", "BASE")
    _run(folder, "predict", f"predict.records={_write(tmp_path / 'known.csv', rows, 'plane')}")
    blind = _read(folder / "predicted_records.csv")
    assert [r["condition"] for r in blind] == [r["condition"] for r in rows]
    assert not any("off" in name or "within" in name for name in blind[0])
    _run(folder, "predict", f"predict.records={_write(tmp_path / 'seen.csv', rows)}")
    seen = _read(folder / "predicted_records.csv")
    probes = ("plane1_x", "plane1_y", "plane2_x", "plane2_y")
    assert np.mean([int(r[f"{p}_within_95"]) for r in seen for p in probes]) > 0.8
    for one, other, given in zip(blind, seen, rows, strict=True):
        for p in probes:
            column = f"{p}_re_mil"
            assert one[column] == other[column]
            assert float(other[column]) + float(other[f"{column}_off"]) == pytest.approx(float(given[column]), abs=1e-9)
            assert 0 < float(one[f"{column}_std"]) < float(one[f"{column}_band"])


def test_mistakes_in_a_table_are_named(folder: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Each in a table of its own, before anything is fitted."""
    monkeypatch.setattr(fitted, "find_contradictions", lambda _: pytest.fail("fitted before the mistake was said"))
    rows = _some("A003")
    fast = _write(tmp_path / "fast.csv", [r | {"rpm": "1400"} for r in rows])
    without = _write(tmp_path / "without.csv", [{k: v for k, v in r.items() if k != "condition"} for r in rows])
    bare = _write(tmp_path / "bare.csv", rows, "plane")
    for stage, key, file, words in (
        ("predict", "predict.records", fast, "within 1 % of those that influence coefficients are known at"),
        ("balance", "balance.records", without, "column 'condition'"),
        ("balance", "balance.records", bare, "vibration of at least one probe"),
        ("predict", "predict.records", _write(tmp_path / "loose.csv", rows, "U"), "weights of every plane"),
        ("predict", "predict.records", tmp_path / "none.csv", "no such file"),
    ):
        with pytest.raises(DataError, match=words):
            _run(folder, stage, f"{key}={file}")
    given, absent = f"balance.records={_write(tmp_path / 'good.csv', rows)}", "but got 'A0003': did you mean 'A003'"
    for error, words, overrides in (
        (ConfigError, "did you mean 'A003'", ("balance.condition=A0003", "balance.remove=both")),
        (ConfigError, r"balance\.method must be a method with a fit", ("balance.method=magic",)),
        (DataError, f"must be a condition of the records, {absent}", ("balance.reference=A0003",)),
        (ConfigError, "name a condition", ("balance.remove=both",)),
        (ConfigError, r"grade of ISO 21940-11 such as G2\.5", ("machine.balance.tolerance.grade=2.5",)),
    ):
        with pytest.raises(error, match=words):
            _run(folder, "balance", given, *overrides)


def test_three_runs_over_many_speeds_have_no_bands(
    artifacts: Artifacts, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """Recordings of another kind: their weights come back, what can't be known is blank, and the baseline is gone."""
    holes = ",".join(
        f"{{node: {node}, holes: 12, first_angle: 0 deg, numbering: with_rotation, radius: 80 mm}}" for node in (2, 4)
    )
    tolerance = "{grade: G2.5, service_speed_rpm: 3000}"
    folder = artifacts.copied("measured_demo", DATA, tmp_path / "x")
    given = ["experiment=measured_demo", "tracking=none", f"output={folder}", "stage=balance"]
    given.append(f"+machine.balance={{planes: [{holes}], masses: any, tolerance: {tolerance}}}")
    with pytest.raises(ConfigError, match=r"data\.baseline=as_found"):
        run_stage(composed(*given))
    run_stage(composed(*given, "balance.condition=both_discs", "balance.remove=condition"))
    sheet = strict_json(folder / "balance.json")["sheet"]
    for plane, hole in zip(sheet["planes"], (11, 5), strict=True):
        (weight,) = plane["weights"]
        assert weight["hole"] == hole  # 150 g mm at 120 and 300 degrees, opposite
        assert weight["mass_g"] == pytest.approx(150 / 80, rel=1e-6)
        assert plane["remaining_at_most_g_mm"] is None
    assert {of["verdict"] for of in sheet["tolerance"]} == {"open"}
    said = " ".join(capsys.readouterr().out.split())
    assert_says(said, "may or may not be met", "influence was fitted to these conditions themselves")
