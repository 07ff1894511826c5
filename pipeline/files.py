"""Writing files so that none is ever seen half-written; and results that cost much to make and little to keep.

These are files under the hash of everything that they are made from. All experiments share them. They lie in the
checkout (``.cache/``), which git ignores; they may be deleted at any time, and one that can't be written only costs
time.
"""

from __future__ import annotations

import contextlib
import hashlib
import json
import os
import platform
import shutil
from collections.abc import Callable, Iterator, Mapping
from pathlib import Path
from typing import Any

from pipeline.errors import DataError, StorageError


def write_beside(path: Path, write: Callable[[Path], object], mode: int = 0o666) -> Path:
    """Let ``write`` make the file under a temporary name in the same folder, then rename it to ``path``.

    Nobody has more rights than ``mode`` says.

    Raises StorageError (full disk, read-only folder, a file where a folder should be); nothing is left
    behind.
    """
    beside = path.with_name(f".{path.stem}{_MARK}{os.getpid()}{path.suffix}")
    try:
        with _explain_storage(path):
            path.parent.mkdir(parents=True, exist_ok=True)
            _clear(path.parent)
            beside.touch(mode)
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
    beside, old = (path.with_name(f".{path.name}{_MARK}{os.getpid()}{ending}") for ending in ("", ".old"))
    try:
        with _explain_storage(path):
            if path.exists() and not path.is_dir():
                raise NotADirectoryError(0, "there is a file of that name")
            beside.mkdir(parents=True)
            _clear(path.parent)
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


_MARK = f".writing-{platform.node()}-"
"""In the hidden name of what this machine writes, before the number of the process."""


def _clear(folder: Path) -> None:
    """Remove what writers that were killed left in ``folder``."""
    for entry in folder.glob(f".*{_MARK}*") if os.name == "posix" else ():
        with contextlib.suppress(OSError, ValueError):
            try:
                os.kill(int(entry.name.rpartition(_MARK)[2].partition(".")[0]), 0)
            except ProcessLookupError:
                shutil.rmtree(entry) if entry.is_dir() else entry.unlink()


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


def render(template: Path, **values: Any) -> str:
    """The text that a template of Jinja makes of the ``values``; in HTML each is escaped."""
    from jinja2 import Environment, FileSystemLoader

    environment = Environment(
        loader=FileSystemLoader(template.parent),
        autoescape=template.suffix == ".html",
        trim_blocks=True,
        lstrip_blocks=True,
        keep_trailing_newline=True,
    )
    return environment.get_template(template.name).render(values)


def hash_json(value: object, length: int = 16) -> str:
    """Identity of a value of JSON, whatever the order of its keys, in so many letters."""
    return hashlib.sha256(json.dumps(value, sort_keys=True).encode()).hexdigest()[:length]


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


# --- what is kept ------------------------------------------------------------------------------------

CACHE = Path(__file__).parents[1] / ".cache"


def hash_parts(*parts: bytes | str) -> str:
    """The hash of ``parts``, which are kept apart: ("ab", "c") and ("a", "bc") differ."""
    digests = (hashlib.sha256(part.encode() if isinstance(part, str) else part).digest() for part in parts)
    return hashlib.sha256(b"".join(digests)).hexdigest()[:32]


def look_up(kind: str, key: str) -> bytes | None:
    """The content kept under ``key``; None where there is none, or a damaged entry."""
    try:
        entry = (CACHE / kind / key).read_bytes()
    except OSError:
        return None
    return entry[32:] if entry[:32] == hash_parts(key, entry[32:]).encode() else None


def keep(kind: str, key: str, content: bytes, most: int = 300) -> None:
    """Keep ``content`` under ``key``, its hash before it, with at ``most`` so many entries of its kind: beyond, the
    oldest go.

    Nothing is raised where that can't be done.
    """
    with contextlib.suppress(StorageError, OSError):
        entry = hash_parts(key, content).encode() + content
        path = write_beside(CACHE / kind / key, lambda beside: beside.write_bytes(entry), 0o600)
        for oldest in sorted(path.parent.iterdir(), key=lambda path: path.stat().st_mtime)[:-most]:
            oldest.unlink(missing_ok=True)
