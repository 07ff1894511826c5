"""Questions that an interpreter beside this one answers."""

from __future__ import annotations

import pytest

from pipeline.processes import ask_aside


@pytest.mark.parametrize(
    ("question", "answer"),
    [
        ("__import__('os').abort()", "crash"),
        ("__import__('time').sleep(9)", "longer than 1 s"),
        ("bytes(10**10)", "Memory"),
        ("1 / 0", "division by zero"),
    ],
)
def test_an_interpreter_beside_this_one_may_end(question: str, answer: str) -> None:
    """What it says, or that it ended; the next question has its own answer."""
    with pytest.raises(RuntimeError, match=answer):
        ask_aside("builtins:eval", question, 1.0, 2e9)
    assert ask_aside("builtins:eval", "b'content'", 9.0, 2e9) == b"content"
