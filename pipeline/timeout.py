"""A limit on the time of what has none of its own."""

from __future__ import annotations

import threading
from collections.abc import Callable
from concurrent.futures import Future
from typing import TypeVar

_T = TypeVar("_T")


def run_within(seconds: float, function: Callable[[], _T]) -> _T:
    """Return what ``function`` returns, or raise what it raises; after ``seconds``, raise :class:`TimeoutError`.

    The thread of a function that takes too long is left to itself.
    """
    answer: Future[_T] = Future()

    def work() -> None:
        try:
            answer.set_result(function())
        except Exception as error:
            answer.set_exception(error)

    # Not an executor's thread, which the interpreter would wait for at its end.
    threading.Thread(target=work, name="within", daemon=True).start()
    try:
        return answer.result(seconds)
    except TimeoutError:
        if answer.done():
            raise  # the function's own
        raise TimeoutError(f"no answer within {seconds:g} s") from None
