"""Files of other formats, names and bytes: read to the same numbers, or refused by an error of ours."""

from __future__ import annotations

from collections.abc import Callable
from contextlib import suppress
from functools import partial
from pathlib import Path

import numpy as np
import pandas as pd
import pytest
from conftest import Run, known_names
from damaged import SMALL, SPEEDS, answers, damage, loaded, measured, stored

from pipeline.__main__ import main
from pipeline.config.schema import Config
from pipeline.data.coefficient_files import read_coefficients
from pipeline.data.dataset import VibrationDataset
from pipeline.data.tables import read_marks, write_table
from pipeline.data.vibration_files import read_dataset
from pipeline.errors import DataError, PipelineError
from pipeline.evaluation.thresholds import read_rules
from pipeline.files import read_json
from pipeline.identification.storage import load_model
from pipeline.rotor.bearing_table import BearingTable
from pipeline.rotor.ross_adapter import assemble

WAYS: dict[str, Callable[[pd.DataFrame, Path], Path]] = {
    "csv": lambda t, folder: stored(t, folder / "v.csv"),
    "csv of the upper case": lambda t, folder: stored(t, folder / "V.CSV"),
    "Parquet of somebody else": lambda t, folder: stored(t, folder / "v.parquet"),
    "more columns": lambda t, folder: stored(t.assign(comment="ü", quality=1), folder / "v.csv"),
    "columns in another order": lambda t, folder: stored(t[t.columns[::-1]], folder / "v.csv"),
    "channels in another order": lambda t, folder: stored(
        t.sort_values(["run", "speed_rpm", "direction", "node"], ascending=[True, True, False, False]),
        folder / "v.csv",
    ),
    "Excel's UTF-8": lambda t, folder: _bytes(folder / "v.csv", t, "utf-8-sig"),
    "Windows line ends": lambda t, folder: _bytes(folder / "v.csv", t, "utf-8", "\r\n"),
    "dictionary columns": lambda t, folder: stored(t.astype({"run": "category"}), folder / "v.parquet"),
}


def _bytes(path: Path, table: pd.DataFrame, encoding: str, line_end: str = "\n") -> Path:
    table.to_csv(path, index=False, encoding=encoding, lineterminator=line_end)
    return path


@pytest.mark.slow
@pytest.mark.parametrize("way", WAYS)
def test_the_same_numbers_in_another_file_give_the_same_bits(way: str, run: Run, base: Config, mine: Path) -> None:
    path = WAYS[way](pd.read_parquet(mine / "vibration.parquet"), mine)
    output = mine.parent / "Ausgabe mit Leerzeichen – ö"
    run("train", base, output, data=measured(mine, vibration=path))
    assert answers(output) == answers(mine)


@pytest.mark.slow
def test_relative_paths_with_spaces_and_letters_of_any_script(mine: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    folder = mine.parent / "Прибор 測定"
    mine.rename(folder)
    monkeypatch.chdir(folder.parent)
    given = [
        f"data.{key}='Прибор 測定/{name}'"
        for key, name in {
            "vibration": "vibration.parquet",
            "excitation": "excitation.csv",
            "known": "known_coefficients.csv",
        }.items()
    ]
    assert main([*SMALL, "stage=train", "output='new ordner/ä b'", *given]) == 0
    assert answers(Path("new ordner/ä b")) == answers(folder)


def test_speeds_of_any_number_of_digits(run: Run, base: Config, mine: Path) -> None:
    """A measured speed needs no round number: the same digits in both files are the same speed."""
    shift = 100.0 / 3e4 * np.sqrt(2.0)
    files = {}
    for key, name in {"vibration": "vibration.parquet", "known": "known_coefficients.csv"}.items():
        table = loaded(mine / name)
        files[key] = stored(table.assign(speed_rpm=table["speed_rpm"] + shift), mine / f"{key}_shifted.csv")
    run("train", base, mine.parent / "x", data=measured(mine, **files))
    assert (mine.parent / "x" / "training.json").exists()


def test_numbers_as_names_of_runs(base: Config, mine: Path) -> None:
    names = {"one": "007", "two": "NA"}
    vibration = pd.read_parquet(mine / "vibration.parquet").replace({"run": names})
    excitation = stored(pd.read_csv(mine / "excitation.csv").replace({"run": names}), mine / "e.csv")
    for ending in ("csv", "parquet"):
        path = stored(vibration, mine / f"v.{ending}")
        assert read_dataset(path, excitation, assemble(base.machine.rotor)).runs == ("007", "NA")


@pytest.fixture
def small(base: Config, mine: Path) -> Path:
    """The data set with two speeds and few bytes."""
    for name in ("vibration.parquet", "known_coefficients.csv"):
        table = loaded(mine / name)
        marks = {"rotor": assemble(base.machine.rotor).fingerprint, "origin": "origin"}
        write_table(mine / name, table[table["speed_rpm"] <= 1000], marks)
    stored(pd.read_parquet(mine / "vibration.parquet"), mine / "vibration.csv")
    rule = "- metric: coefficients.*.kxx.mean_error_percent\n  max: 1.0e-4\n  why: because it is so\n"
    (mine / "thresholds.yaml").write_text(rule)
    return mine


def _dataset(folder: Path, base: Config, vibration: str = "vibration.parquet") -> VibrationDataset:
    read_marks(folder / vibration)
    return read_dataset(folder / vibration, folder / "excitation.csv", assemble(base.machine.rotor))


READERS: dict[str, Callable[[Path, Config], object]] = {
    "vibration.parquet": _dataset,
    "vibration.csv": partial(_dataset, vibration="vibration.csv"),
    "excitation.csv": _dataset,
    "known_coefficients.csv": lambda folder, base: read_coefficients(
        folder / "known_coefficients.csv", (0, 2), SPEEDS[:2] * np.pi / 30, {0: known_names(base), 2: known_names(base)}
    ),
    "thresholds.yaml": lambda folder, base: read_rules(folder / "thresholds.yaml"),
    "training.json": lambda folder, base: read_json(folder / "training.json"),
    "model.json": lambda folder, base: load_model(folder).table(_known()),
    "model.safetensors": lambda folder, base: load_model(folder).table(_known()),
}


def _known() -> BearingTable:
    speeds = SPEEDS * np.pi / 30
    return BearingTable((0, 2), speeds, np.zeros((2, len(speeds), 8)))


@pytest.mark.slow
@pytest.mark.parametrize("name", READERS)
@pytest.mark.parametrize("seeds", [range(150)], ids=str)
def test_a_file_with_any_bytes_wrong_is_read_or_refused(name: str, seeds: range, base: Config, small: Path) -> None:
    """Whatever happened to a file on its way, its reader raises errors of ours only, and no warning."""
    path, whole = small / name, (small / name).read_bytes()
    READERS[name](small, base)
    for seed in seeds:
        path.write_bytes(damage(whole, seed))
        with suppress(PipelineError):
            READERS[name](small, base)


PANDAS_NOTES = {
    "no JSON": b"{",
    "another JSON": b"[1]",
    "no UTF-8": b"\xff",
    "an unknown type": b'{"index_columns": [], "column_indexes": [], "pandas_version": "3.1.1", "columns":'
    b' [{"name": "run", "field_name": "run", "pandas_type": "unicode", "numpy_type": "x"}]}',
    "nothing said": b"{}",
}


@pytest.mark.parametrize("case", PANDAS_NOTES)
def test_notes_of_pandas_in_a_parquet_file_do_not_matter(case: str, base: Config, small: Path) -> None:
    """What pandas notes in a Parquet file is not needed to read it, so damage there changes no number."""
    import pyarrow.parquet as parquet

    path = small / "vibration.parquet"
    before = _dataset(small, base).fingerprint
    table = parquet.read_table(path)
    marks = dict(table.schema.metadata) | {b"pandas": PANDAS_NOTES[case]}
    parquet.write_table(table.replace_schema_metadata(marks), path)
    with suppress(DataError):
        assert _dataset(small, base).fingerprint == before
