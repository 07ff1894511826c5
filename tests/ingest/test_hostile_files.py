"""Files of strangers: changed bytes, cut ends, bombs, names. Each is read as another reader reads it, or refused."""

from __future__ import annotations

import struct
import tempfile
from collections.abc import Callable, Iterable
from functools import cache, partial
from pathlib import Path
from typing import Any
from zipfile import ZIP_DEFLATED, ZipFile

import h5py
import nptdms
import numpy as np
import openpyxl
import pandas as pd
import pyarrow.parquet as parquet
import pytest
import pyuff
import scipy.io
from conftest import refused
from damaged import damage
from data.test_mat_files import write_new
from measured_files import table_config, uff_set, write_hdf5, write_tdms, write_uff
from reading import wide_runs, with_ingest
from scipy.io import wavfile

from pipeline.data.csv_format import CsvConfig
from pipeline.errors import DataError
from pipeline.ingest.recordings import read_recording
from pipeline.ingest.uff import read_uff
from pipeline.stages import run_stage

SIGNALS = {"a": np.sin(np.arange(60.0)), "b": np.cos(np.arange(60.0))}
TABLE = pd.DataFrame(SIGNALS)


def _select(content: Any) -> np.ndarray:
    return np.stack([np.ravel(content[name]) for name in SIGNALS], axis=1).astype(float)


def _uff(path: Path, binary: int) -> None:
    write_uff(
        path,
        [
            uff_set(np.arange(60) + 1.0, values + 0j, 1, 1, [name], binary=binary, abscissa_spacing=1)
            for name, values in SIGNALS.items()
        ],
    )


def _tdms(path: Path) -> np.ndarray:
    with nptdms.TdmsFile.open(path) as file:
        return _select({name: file["run"][name][:] for name in SIGNALS})


def _arrays(path: Path, read_by: Callable[[Path], Any]) -> np.ndarray:
    with read_by(path) as file:
        return _select({name: file[name][()] for name in SIGNALS})


def _sets(path: Path) -> np.ndarray:
    """A single set is no list for pyuff."""
    return np.stack([s["data"] for s in np.atleast_1d(pyuff.UFF(str(path)).read_sets()) if s["type"] == 58], axis=1)


_hdf5 = partial(_arrays, read_by=h5py.File)
KINDS: dict[str, tuple[str, Callable[[Path], object], Callable[[Path], Any]]] = {
    "csv": ("csv", partial(TABLE.to_csv, index=False), partial(pd.read_csv, dtype=str)),
    "excel": ("xlsx", partial(TABLE.to_excel, index=False), pd.read_excel),
    "parquet": ("parquet", TABLE.to_parquet, lambda path: parquet.read_table(path).to_pydict()),
    "npz": ("npz", lambda path: np.savez_compressed(path, **SIGNALS), partial(_arrays, read_by=np.load)),
    "wav": (
        "wav",
        partial(wavfile.write, rate=100, data=(1e4 * TABLE.to_numpy()).astype(np.int16)),
        lambda p: dict(zip("ab", wavfile.read(p)[1].T / 2.0**15, strict=True)),
    ),
    "hdf5": ("h5", lambda path: write_hdf5(path, SIGNALS), _hdf5),
    "zipped hdf5": (
        "h5",
        lambda path: write_hdf5(path, SIGNALS, compression="gzip", chunks=(20,), shuffle=True),
        _hdf5,
    ),
    "tdms": ("tdms", lambda path: write_tdms(path, SIGNALS), _tdms),
    "mat 4": ("mat", lambda path: scipy.io.savemat(path, SIGNALS, format="4"), scipy.io.loadmat),
    "mat 5": ("mat", lambda path: scipy.io.savemat(path, SIGNALS | {"run": {"x": [1.0]}}), scipy.io.loadmat),
    "zipped mat 5": ("mat", lambda path: scipy.io.savemat(path, SIGNALS, do_compression=True), scipy.io.loadmat),
    "mat 7.3": ("mat", lambda path: write_new(path, SIGNALS), _hdf5),
    "uff": ("uff", partial(_uff, binary=0), _sets),
    "binary uff": ("uff", partial(_uff, binary=1), _sets),
}
"""The ending of a file, how it is written, and what a reader that is not ours makes of it: (n, 2)."""
NAMES = {"wav": ("1", "2"), "tdms": ("run/a", "run/b")}


@cache
def whole(kind: str) -> bytes:
    """A good file."""
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / f"good.{KINDS[kind][0]}"
        KINDS[kind][1](path)
        return path.read_bytes()


def read(kind: str, path: Path) -> np.ndarray:
    """What we make of it: (n, 2)."""
    if path.suffix == ".uff":
        return np.stack([record.values for record in read_uff(path)[0]], axis=1)
    rate, names = None if kind == "wav" else 100.0, NAMES.get(kind, ("a", "b"))
    return np.stack(list(read_recording(path, names, CsvConfig(), rate=rate)[1].values()), axis=1)


@pytest.mark.filterwarnings("ignore:Chunk .non-data.")
@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize("seeds", [range(24)], ids=str)
def test_damaged_files(kind: str, seeds: range, tmp_path: Path) -> None:
    """A file that is accepted has the numbers that another reader finds in it; no error but ours."""
    ending, _, read_otherwise = KINDS[kind]
    path, content = tmp_path / f"some.{ending}", whole(kind)
    ends = (20, 200, len(content) // 3, -40, -4) if kind != "csv" else ()  # a text may end anywhere
    for cut in (b"", b"something else\n" * 9, *(content[:end] for end in ends)):
        path.write_bytes(cut)
        with refused(path.name, "must"):
            read(kind, path)
    for seed in (None, *seeds):
        path.write_bytes(content if seed is None else damage(content, seed))
        try:
            values = read(kind, path)
        except DataError:
            assert seed is not None
            continue
        other = read_otherwise(path)
        assert np.array_equal(values, other if isinstance(other, np.ndarray) else _select(other)), seed


def _pack(path: Path, size: int) -> None:
    TABLE.to_excel(path, index=False)
    with ZipFile(path, "a", ZIP_DEFLATED) as file:
        file.writestr("xl/media/image.png", bytes(size))


def _stretch(path: Path, rows: Iterable[int] = range(1, 800), column: int = 16384) -> None:
    book = openpyxl.Workbook()
    for row in rows:
        book.active.cell(row, column, 1.0)
    book.save(path)


def _space(path: Path) -> None:
    """A million rows without a cell."""
    TABLE.to_excel(path, index=False)
    with ZipFile(path) as file:
        parts = {name: file.read(name) for name in file.namelist()}
    rows = "".join(f'<row r="{row}"/>' for row in range(100, 1_000_000)).encode()
    parts[SHEET] = parts[SHEET].replace(b"</sheetData>", rows + b"</sheetData>")
    with ZipFile(path, "w", ZIP_DEFLATED) as file:
        for name, part in parts.items():
            file.writestr(name, part)


def _link(path: Path, link: Callable[[h5py.File], object]) -> None:
    write_hdf5(path.with_name("other.h5"), SIGNALS)
    with h5py.File(path, "w") as file:
        link(file)


VIRTUAL = h5py.VirtualLayout((60,), float)
VIRTUAL[:] = h5py.VirtualSource("other.h5", "a", (60,))
SHEET = "xl/worksheets/sheet1.xml"
UNWRITTEN = partial(write_hdf5, channels={"a": None}, dtype=float, shape=10**10, chunks=True)
BOMBS: dict[str, tuple[str, Callable[[Path], object], str]] = {
    "unpacked sheets": ("a.xlsx", partial(_pack, size=10**7), "must unpack to at most 30 times its"),
    "a cell in the last column": ("a.xlsx", _stretch, "must unpack to at most 100 times its"),
    "blank rows": ("a.xlsx", _space, "50,000 blank ones together, but row 50,062 is one more"),
    "the last row": ("a.xlsx", partial(_stretch, rows=[1, 2**20], column=1), "but row 50,002 is one more"),
    "zeros": ("a.npz", lambda path: np.savez_compressed(path, a=np.zeros(13 * 10**6)), "it asks for 104,000,128"),
    "values that nobody wrote": ("a.h5", UNWRITTEN, "it asks for 80,000,000,000"),
    "of MATLAB": ("a.mat", UNWRITTEN, "it asks for 80,000,000,000"),
    "another file": (
        "a.h5",
        partial(write_hdf5, channels={"a": None}, dtype=float, shape=1, external=[("/etc/hostname", 0, 8)]),
        "takes them from another",
    ),
    "a link": (
        "a.h5",
        partial(_link, link=lambda file: file.update({"a": h5py.ExternalLink("other.h5", "a")})),
        "takes them from another",
    ),
    "a virtual array": (
        "a.h5",
        partial(_link, link=lambda file: file.create_virtual_dataset("a", VIRTUAL)),
        "takes them from another",
    ),
    "one number": ("a.parquet", pd.DataFrame({"a": np.ones(13 * 10**6)}).to_parquet, "it asks for 104,000,000"),
    "a long header": ("a.csv", lambda path: path.write_text("a," * 9999 + "b\n" + "1\n" * 2000), "it asks for 160,"),
    "a long field": ("a.csv", lambda path: path.write_text(f"a,b\n1,{'1' * 60000}x\n2,3\n" + '"'), "must have finite"),
    "bits of a sample": (
        "a.wav",
        lambda path: path.write_bytes(whole("wav")[:34] + b"\2" + whole("wav")[35:]),  # SciPy reads each byte as one
        "must have 2 bits for each of 2 channels, but have 4 bytes",
    ),
    "a size": ("a.mat", lambda path: path.write_bytes(struct.pack("5i", 0, 2**30, 1, 0, 2) + b"a\0"), "MAT file"),
}


@pytest.mark.slow
@pytest.mark.parametrize("bomb", BOMBS)
def test_bombs(bomb: str, tmp_path: Path) -> None:
    """A few bytes that ask for more memory than the machine has: each is a sentence at once."""
    name, write, sentence = BOMBS[bomb]
    write(tmp_path / name)
    with refused(name, sentence):
        read_recording(tmp_path / name, ["a"], CsvConfig(), rate=100.0)


@pytest.mark.slow
def test_a_name_is_no_place(tmp_path: Path) -> None:
    """Whatever a run is called, its files lie in the folder of the experiment."""
    names = ("../../x", "=cmd|' /C calc'!A0 <!--<script>")
    runs = [run | {"name": name} for run, name in zip(wide_runs(tmp_path), names, strict=True)]
    before, output = set(tmp_path.rglob("*")), tmp_path / "deep" / "er"
    run_stage(with_ingest(table_config(runs), output=str(output)))
    assert {path.parent for path in {*tmp_path.rglob("*")} - before if path.is_file()} == {output, output / "figures"}
    assert pd.read_csv(output / "excitation.csv")["run"].tolist() == [names[0], f"'{names[1]}"]
