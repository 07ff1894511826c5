"""A section's rules: the first that is broken is its error."""

from __future__ import annotations

from collections.abc import Iterator

import pytest
from pydantic import ValidationError

from pipeline.config.section import Section, rule


class _Span(Section):
    low: float
    high: float

    @rule
    def _ascending(self) -> Iterator[str]:
        if self.low > self.high:
            yield f"must have low <= high, but got {self.low:g} and {self.high:g}"
        if self.low < 0:
            yield "must have low of zero or more"


class _Inner(_Span):
    @rule
    def _narrow(self) -> Iterator[str]:
        if self.high > 10:
            yield "must have high of ten at most"


@pytest.mark.parametrize(
    ("low", "high", "sentence"),
    [(2, 1, "must have low <= high, but got 2 and 1"), (-1, -2, "must have low <= high"), (1, 11, "ten at most")],
)
def test_the_first_broken_rule_is_told(low: float, high: float, sentence: str) -> None:
    with pytest.raises(ValidationError, match=sentence) as caught:
        _Inner(low=low, high=high)
    assert len(caught.value.errors()) == 1


def test_a_section_that_keeps_its_rules_is_made() -> None:
    assert _Inner(low=1, high=2).model_dump() == {"low": 1, "high": 2}
