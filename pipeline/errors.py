"""Errors that a user can cause, each a sentence: the law, what came, the next step."""

from __future__ import annotations

import difflib
import re
from collections.abc import Iterable


class PipelineError(Exception):
    """A mistake in what the user gave. ``str(error)`` is shown as it is; the exit code is 2."""


class ConfigError(PipelineError):
    """A configuration that breaks a law of :mod:`pipeline.config`."""


class DataError(PipelineError):
    """A data file that can't be read as what it should be."""


class IdentifiabilityError(PipelineError):
    """The measurement has fewer equations than the unknowns need."""


class StorageError(PipelineError):
    """A result that can't be written; nothing was left half-written."""


# SQLAlchemy takes a password with "/" and more; in an http address, what follows the port may hold an "@".
_PASSWORDS = (
    (re.compile(r"(?<!http)(?<!https)(://[^\s:/@]*):\S*@"), r"\1:***@"),
    (re.compile(r"(\w://[^\s:/@]*):[^\s/@]+@"), r"\1:***@"),
    (re.compile(r"([?&]password=)[^\s&'\"]*"), r"\1***"),
)


def without_password(text: str) -> str:
    """``text`` with the password of every ``scheme://user:password@host`` in it replaced by ``***``."""
    for pattern, masked in _PASSWORDS:
        text = pattern.sub(masked, text)
    return text


def nearest(name: str, candidates: Iterable[str]) -> str:
    """The words that follow an unknown name: the nearest candidate, and all of them."""
    known = sorted(candidate if len(candidate) <= 40 else f"{candidate[:37]}..." for candidate in candidates)
    close = difflib.get_close_matches(name, known, n=1, cutoff=0.5)
    hint = f"did you mean '{close[0]}'? " if close else ""
    return f"{hint}(known: {', '.join(known)})"
