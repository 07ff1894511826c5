"""Variables of MATLAB files (.mat, all versions) by name: ``speed``, ``run1.amplitude`` of a struct, ``x(:,2)``.

And what a library says of a damaged file, as a sentence.
"""

from __future__ import annotations

import re
from collections.abc import Iterable, Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np

from pipeline.errors import DataError, nearest

_COLUMN = re.compile(r"(.+?)\(:, ?(\d+)\)")


def require_file(path: Path) -> None:
    """Raise DataError where there is no such file, with the nearest of those beside it."""
    if not path.is_file():
        beside = [other.name for other in path.parent.glob("*")] if path.parent.is_dir() else []
        hint = nearest(path.name, beside).partition("(known")[0].strip()
        raise DataError(f"'{path}' must exist, but there is no such file{hint and ': '}{hint}")


@contextmanager
def open_measured(path: Path, kind: str) -> Iterator[None]:
    """Raise a DataError for whatever a library raises in the block while it reads a file of the ``kind``."""
    require_file(path)
    try:
        yield
    except DataError:
        raise
    except Exception as error:  # scipy, h5py, nptdms, pyuff and openpyxl raise many kinds
        raise DataError(
            f"'{path}' must be a complete {kind}, but it can't be read as one ({write_reason(error)}): copy it again"
        ) from None


def write_reason(error: Exception) -> str:
    """The first line of what a library says."""
    return (str(error).splitlines() or [type(error).__name__])[0][:200]


def read_mat(path: Path, names: Iterable[str]) -> dict[str, np.ndarray]:
    """The variables ``names``, each a row (n,) of numbers or of texts.

    Raises DataError: no such file, a damaged one, no such variable, a matrix where one of its columns is needed.
    """
    from h5py import is_hdf5
    from scipy.io import loadmat

    with open_measured(path, "MAT file"):
        # Every variable of numbers or texts, fields of structs by dotted names.
        every = dict(_walk(_open_hdf5(path) if is_hdf5(path) else loadmat(path, simplify_cells=True)))
    return {name: _take(path, every, name) for name in names}


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


def _open_hdf5(path: Path) -> dict[str, Any]:
    """The content of a file of version 7.3, as ``loadmat`` gives older ones."""
    import h5py

    with h5py.File(path, "r") as file:

        def read(item: Any) -> Any:
            """An item of the file, with all that lies in it."""
            if isinstance(item, h5py.Group):
                return {name: read(inside) for name, inside in item.items() if not name.startswith("#")}
            kind = item.attrs.get("MATLAB_class", b"double")
            values = item[()]
            if kind == b"char":
                return "".join(chr(code) for code in np.asarray(values).T.reshape(-1))
            if kind == b"cell":
                return np.array([read(file[reference]) for reference in np.asarray(values).T.reshape(-1)], dtype=object)
            return np.asarray(values).T  # MATLAB counts down the columns

        content: dict[str, Any] = read(file)
        return content
