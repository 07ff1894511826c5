"""Errors that a user can cause, each a sentence: the law, what came, the next step; and how they end a command."""

from __future__ import annotations

import difflib
import errno
import os
import re
import sys
import traceback
from collections.abc import Callable, Iterable
from pathlib import Path


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


def nearest(name: str, candidates: Iterable[str], most: int = 100) -> str:
    """The words that follow an unknown name: the nearest candidate, and all of them, or the first ``most``."""
    known = sorted(candidate if len(candidate) <= 40 else f"{candidate[:37]}..." for candidate in candidates)
    lower = {candidate.lower(): candidate for candidate in known}
    close = difflib.get_close_matches(name.lower(), lower, n=1, cutoff=0.5)
    hint = f"did you mean '{lower[close[0]]}'? " if close else ""
    more = f" and {len(known) - most:,} more" if len(known) > most else ""
    return f"{hint}(known: {', '.join(known[:most])}{more})"


def name_beside(path: Path) -> str:
    """What follows a path that is no file: the nearest file beside it, where one is near."""
    if path.is_dir():
        return ": name a file in it"
    beside = [other.name for other in path.parent.glob("*")] if path.parent.is_dir() else []
    hint = nearest(path.name, beside).partition("(known")[0].strip()
    return f": {hint}" if hint else ""


# --- the end of a command ----------------------------------------------------------------------------

MISTAKE, BUG, INTERRUPTED, CLOSED_PIPE = 2, 70, 130, 141

# What a disk, a folder's rights or a path of the user cause; other OSErrors are bugs.
_STORAGE = {
    *(errno.ENOSPC, errno.EDQUOT, errno.EFBIG, errno.EIO, errno.EROFS, errno.EACCES, errno.EPERM),
    *(errno.ENOENT, errno.EEXIST, errno.EISDIR, errno.ENOTDIR, errno.ENAMETOOLONG),
}


class JobFailed(Exception):
    """A job of a multirun that has said itself why it failed.

    ``args`` holds its exit code, and the folder of the files that it spoke into where that was not the terminal.
    """


def exit_code(action: Callable[[], None]) -> int:
    """Run ``action``, say what went wrong, and return the exit code."""
    try:
        action()
        sys.stdout.flush()
        return 0
    except SystemExit as stop:
        return stop.code if isinstance(stop.code, int) else say_and_return(stop.code, MISTAKE) if stop.code else 0
    except JobFailed as failure:
        code, folder = failure.args
        return say_and_return(f"what the jobs said is in '{folder}'", code) if folder else int(code)
    except PipelineError as error:
        return say_and_return(error, MISTAKE)
    except KeyboardInterrupt:
        return say_and_return("interrupted; run the same command again to start over", INTERRUPTED)
    except BrokenPipeError:
        _drop_output()
        return CLOSED_PIPE
    except Exception as error:
        if isinstance(error, OSError) and error.errno in _STORAGE:
            _drop_output()
            place = f"'{error.filename}'" if error.filename else "the files of a run"
            sentence = (
                f"{place} must be readable or writable, but got: {error.strerror}; "
                "free or change that place, or write elsewhere with output=FOLDER"
            )
            return say_and_return(sentence, MISTAKE)
        traceback.print_exc()
        return say_and_return(
            "internal error: this is a bug of the pipeline; please report it with the lines above", BUG
        )


def say_and_return(words: object, code: int) -> int:
    """Say ``words`` on stderr; the exit ``code``."""
    print(words, file=sys.stderr, flush=True)
    return code


def _drop_output() -> None:
    """Let Python's last flush of an unwritable stdout succeed, or it would replace the exit code."""
    try:
        sys.stdout.flush()
    except OSError:
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
