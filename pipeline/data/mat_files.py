"""The door for files of strangers: what a library says of one is a sentence, and none asks for more than it has.

And variables of MATLAB files (.mat, all versions) by name: ``speed``, ``run1.amplitude`` of a struct, ``x(:,2)``.
"""

from __future__ import annotations

import json
import re
from collections.abc import Collection, Iterable, Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from typing import Any
from zipfile import ZipFile

import numpy as np

from pipeline.errors import DataError, name_beside, nearest
from pipeline.processes import ask_aside

_COLUMN = re.compile(r"(.+?)\(:, ?(\d+)\)")


@contextmanager
def open_measured(path: Path, kind: str, next_step: str = "copy it again") -> Iterator[None]:
    """Raise a DataError for whatever a library raises in the block while it reads a file of the ``kind``, and where
    there is no such file, with the nearest of those beside it.
    """
    if not path.is_file():
        what = "it is a folder" if path.is_dir() else "there is no such file"
        raise DataError(f"'{path}' must exist, but {what}{name_beside(path)}")
    try:
        yield
    except (DataError, ImportError):
        raise
    except Exception as error:  # scipy, h5py, nptdms, pyuff, pyarrow and openpyxl raise many kinds
        reason = (str(error).splitlines() or [type(error).__name__])[0][:200]
        raise DataError(f"'{path}' must be a {kind}, but it can't be read as one ({reason}): {next_step}") from None


def require_names(path: Path, what: str, names: Iterable[str], known: Iterable[str]) -> None:
    """Raise DataError for the first of ``names`` that a file lacks; it has the ``known``."""
    every = list(known)
    for name in names:
        if name not in every:
            raise DataError(f"'{path}' must have the {what} '{name}', but it has not: {nearest(name, every)}")


def require_lengths(path: Path, what: str, columns: Mapping[str, np.ndarray]) -> None:
    """Raise DataError where the ``columns`` of a file have not as many ``what``."""
    if len({len(values) for values in columns.values()}) > 1:
        text = ", ".join(f"'{name}' {len(values)}" for name, values in columns.items())
        raise DataError(f"'{path}' must have as many {what}, but it has {text}")


def require_room(path: Path, asked: float, most: float = 1e8, times: float = 100.0) -> None:
    """Raise DataError where a file asks for more bytes than ``most`` and than so many ``times`` its own.

    Real measurements pack to a tenth; what packs better is made to fill the memory, or damaged.
    """
    size = path.stat().st_size
    if asked > max(most, times * size):
        raise DataError(
            f"'{path}' must unpack to at most {times:g} times its {size:,} bytes, but it asks for {asked:,.0f}: copy "
            "it again, or write it without compression and without empty cells"
        )


def require_unpacked(path: Path, most: float = 1e8, times: float = 100.0) -> None:
    """:func:`require_room` for all that is in a zip archive, such as a workbook or a file of numpy's."""
    with ZipFile(path) as archive:
        require_room(path, sum(entry.file_size for entry in archive.infolist()), most, times)


def read_mat(path: Path, names: Collection[str]) -> dict[str, np.ndarray]:
    """The variables ``names``, each a row (n,) of numbers or of texts.

    Raises DataError: no such file, a damaged one, no such variable, a matrix where one of its columns is needed.
    """
    from h5py import is_hdf5

    with open_measured(path, "complete MAT file"):
        every = _open_hdf5(path, names) if is_hdf5(path) else _open_old(path, names)
    return {name: _take(path, every, name) for name in names}


def list_mat(path: Path) -> dict[str, tuple[int, ...]]:
    """The shape of each variable of numbers. Raises DataError for a damaged file."""
    from h5py import is_hdf5

    with open_measured(path, "complete MAT file"):
        every = _open_hdf5(path, ()) if is_hdf5(path) else _open_old(path)
    return {name: values.shape for name, values in every.items() if values.dtype.kind in "iuf"}


def _open_old(
    path: Path, wanted: Iterable[str] = (), seconds: float = 10.0, memory: float = 1e9, times: float = 20.0
) -> dict[str, np.ndarray]:
    """The variables of a file before version 7.3, fields of structs by dotted names: those ``wanted`` and empty ones
    for the others' names, or all.

    A changed bit in such a file ends the interpreter that reads it, so another one does: within so many bytes of
    ``memory`` and ``times`` those of the file, and so many ``seconds`` and one for each 10 MB.
    """
    from safetensors.numpy import load

    size, firsts = path.stat().st_size, sorted({re.split(r"[.(]", name)[0] for name in wanted})
    content = load(
        ask_aside(
            f"{__name__}:pack_old",
            json.dumps([str(path.absolute()), firsts]),
            seconds + size / 1e7,
            memory + times * size,
        )
    )
    names, texts = json.loads(content["#"].tobytes())  # safetensors gives them in any order
    return {name: content[name] for name in names} | {
        name: np.array(values, dtype=object) for name, values in texts.items()
    }


def pack_old(question: str) -> bytes:
    """The variables of a MAT file as safetensors; the texts as JSON, which are none of its kinds."""
    from safetensors.numpy import save
    from scipy.io import loadmat, whosmat

    path, firsts = json.loads(question)
    known = [name for name, *_ in whosmat(path) if not name.startswith("__")]
    # With the last variable, since a file that is cut lacks some of it.
    content = loadmat(path, variable_names=[*firsts, *known[-1:]] if firsts else None, simplify_cells=True)
    every = dict.fromkeys(set(known) - set(content), np.empty(0)) | dict(_walk(content))
    texts = {name: every.pop(name).tolist() for name in list(every) if every[name].dtype.kind in "UO"}
    every["#"] = np.frombuffer(json.dumps([list(every), texts], default=str).encode(), np.uint8)
    return save({name: np.ascontiguousarray(values) for name, values in every.items()})  # it takes the rows as they lie


def _walk(content: Mapping[str, Any], before: str = "") -> Iterable[tuple[str, Any]]:
    for name, value in content.items():
        if name.startswith(("__", "#")):
            continue
        if isinstance(value, Mapping):
            yield from _walk(value, f"{before}{name}.")
        elif (array := np.asarray(value)).dtype.kind in "biufUO" and array.dtype.names is None:
            yield f"{before}{name}", array


def _take(path: Path, every: Mapping[str, Any], name: str) -> np.ndarray:
    match = _COLUMN.fullmatch(name)
    asked, column = (match[1], int(match[2])) if match else (name, None)
    if asked not in every:
        raise DataError(
            f"'{path}' must have the variable '{asked}', but it has not: {nearest(asked, every)}; a table or "
            "timetable of MATLAB is saved as a struct by table2struct(T, 'ToScalar', true)"
        )
    array = np.asarray(every[asked])
    if column is not None:
        if array.ndim != 2 or not 1 <= column <= array.shape[1]:
            raise DataError(f"'{path}' must have the column {column} of '{asked}', but its shape is {array.shape}")
        return array[:, column - 1]
    if sum(size != 1 for size in array.shape) > 1:
        raise DataError(
            f"'{path}' must have one row of values in '{asked}', but its shape is {array.shape}: name a column, such "
            f"as '{asked}(:,1)'"
        )
    return array.reshape(-1)


def _open_hdf5(path: Path, wanted: Iterable[str]) -> dict[str, np.ndarray]:
    """The variables of a file of version 7.3; those that are not ``wanted`` have their shape alone."""
    import h5py

    asked = {_COLUMN.sub(r"\1", name) for name in wanted}
    with h5py.File(path, "r") as file:
        every: dict[str, Any] = {}
        # Each object once, by one of its names, and no link to another file.
        file.visititems(lambda name, item: every.update({name.replace("/", "."): item}))

        def read(item: Any) -> Any:
            """A text, the texts of a cell array (empty for what else lies there), or numbers."""
            require_values(path, item)
            kind, values = item.attrs.get("MATLAB_class", b"double"), np.asarray(item[()]).T  # columns first
            if kind == b"char":
                return "".join(chr(code) for code in values.reshape(-1))
            if values.dtype == h5py.ref_dtype:
                cells = [file[reference] for reference in values.reshape(-1)]
                return np.array(
                    [read(cell) if hasattr(cell, "dtype") and cell.dtype != h5py.ref_dtype else "" for cell in cells],
                    dtype=object,
                )
            return values

        def stand_in(item: Any) -> Any:
            """As many zeros, without their memory; a text for texts."""
            numbers = item.dtype.kind in "iuf" and item.attrs.get("MATLAB_class") != b"char"
            return np.broadcast_to(0.0 if numbers else "", item.shape[::-1])

        return {
            name: np.asarray(read(item) if name in asked else stand_in(item))
            for name, item in every.items()
            if isinstance(item, h5py.Dataset) and not name.startswith("#")
        }


def require_values(path: Path, dataset: Any) -> None:
    """Raise DataError for a dataset of HDF5 that asks for more memory than a file of its size, or for another file."""
    require_room(path, dataset.nbytes)
    if dataset.external or dataset.is_virtual or dataset.file.filename != str(path):
        raise DataError(f"'{path}' must hold its values, but '{dataset.name}' takes them from another file: copy them")
