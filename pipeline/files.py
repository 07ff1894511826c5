"""Writing files so that none is ever seen half-written."""

from __future__ import annotations

import contextlib
import hashlib
import json
import os
import shutil
from collections.abc import Callable, Iterator, Mapping
from pathlib import Path
from typing import Any

from pipeline.errors import DataError, StorageError


def write_beside(path: Path, write: Callable[[Path], object]) -> Path:
    """Let ``write`` make the file under a temporary name in the same folder, then rename it to ``path``.

    Raises StorageError (full disk, read-only folder, a file where a folder should be); nothing is left
    behind.
    """
    beside = path.with_name(f".{path.stem}.{os.getpid()}{path.suffix}")
    try:
        with _explain_storage(path):
            path.parent.mkdir(parents=True, exist_ok=True)
            write(beside)
            with beside.open("rb+") as file:
                os.fsync(file.fileno())
            os.replace(beside, path)
    finally:
        # A folder that is missing, or is no folder, has been reported by the error above.
        with contextlib.suppress(OSError):
            beside.unlink(missing_ok=True)
    return path


def write_folder(path: Path, write: Callable[[Path], object]) -> Path:
    """Let ``write`` fill a folder under a temporary name, then put it in the place of ``path`` as a whole.

    Raises StorageError (full disk, read-only folder, a file in the way); the folder that was there stays then.
    """
    beside, old = (path.with_name(f".{path.name}.{os.getpid()}{ending}") for ending in ("", ".old"))
    try:
        with _explain_storage(path):
            if path.exists() and not path.is_dir():
                raise NotADirectoryError(0, "there is a file of that name")
            beside.mkdir(parents=True)
            write(beside)
            if path.exists():
                os.replace(path, old)
            os.replace(beside, path)
    finally:
        if old.exists() and not path.exists():
            os.replace(old, path)
        for folder in (beside, old):
            shutil.rmtree(folder, ignore_errors=True)
    return path


@contextlib.contextmanager
def _explain_storage(path: Path) -> Iterator[None]:
    try:
        yield
    except OSError as error:
        raise StorageError(
            f"'{path}' must be writable, but saving failed ({error.strerror or error}): "
            "free the disk or choose another folder with output=FOLDER"
        ) from error


def write_text(path: Path, text: str) -> Path:
    """Write ``text`` in UTF-8. Raises StorageError."""
    return write_beside(path, lambda beside: beside.write_text(text, encoding="utf-8"))


def write_json(path: Path, value: Mapping[str, Any]) -> Path:
    """Write JSON, indented; NaN and infinities are refused by ValueError. Raises StorageError."""
    return write_text(path, json.dumps(value, indent=2, allow_nan=False) + "\n")


def hash_file(path: Path) -> str:
    """Identity of a file's bytes; empty where there is no file."""
    return hashlib.sha256(path.read_bytes()).hexdigest()[:16] if path.is_file() else ""


def _refuse_constant(name: str) -> None:
    raise ValueError(f"{name} is no JSON number")


def read_json(path: Path, remedy: str = "make it again") -> dict[str, Any]:
    """Read a JSON object. Raises DataError with the ``remedy`` where the file is no JSON object."""
    try:
        value = json.loads(path.read_text(encoding="utf-8"), parse_constant=_refuse_constant)
    except FileNotFoundError:
        raise DataError(f"'{path}' must exist, but there is no such file") from None
    except (OSError, ValueError, RecursionError) as error:
        raise DataError(f"'{path}' must be readable as JSON, but it is not ({error}): {remedy}") from None
    if not isinstance(value, dict):
        raise DataError(f"'{path}' must hold a JSON object, but it holds a {type(value).__name__}: {remedy}")
    return value
