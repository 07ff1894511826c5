"""Results that cost much to make and little to keep: files under the hash of everything that they are made from.

All experiments share it. It lies in the checkout (``.cache/``), which git ignores; it may be deleted at any time, and
one that can't be written only costs time.
"""

from __future__ import annotations

import contextlib
import hashlib
from pathlib import Path

from pipeline.errors import StorageError
from pipeline.files import write_beside

FOLDER = Path(__file__).parents[1] / ".cache"
_MOST = 300
"""Entries of a kind; beyond, the oldest go."""


def hash_parts(*parts: bytes | str) -> str:
    """The hash of ``parts``, which are kept apart: ("ab", "c") and ("a", "bc") differ."""
    digest = hashlib.sha256()
    for part in parts:
        content = part.encode() if isinstance(part, str) else part
        digest.update(hashlib.sha256(content).digest())
    return digest.hexdigest()[:32]


def path_of(kind: str, key: str) -> Path:
    """Return the path of the entry ``key`` of a ``kind``, which may not be there."""
    return FOLDER / kind / key


def look_up(kind: str, key: str) -> bytes | None:
    """The content kept under ``key``; None where there is none."""
    try:
        return path_of(kind, key).read_bytes()
    except OSError:
        return None


def keep(kind: str, key: str, content: bytes) -> None:
    """Keep ``content`` under ``key``. Nothing is raised where that can't be done."""
    with contextlib.suppress(StorageError, OSError):
        write_beside(path_of(kind, key), lambda beside: beside.write_bytes(content))
        entries = sorted((FOLDER / kind).iterdir(), key=lambda entry: entry.stat().st_mtime)
        for entry in entries[:-_MOST]:
            entry.unlink(missing_ok=True)
