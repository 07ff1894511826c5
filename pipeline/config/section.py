"""The base of every part of a configuration."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from typing import Annotated, Any

from pydantic import AfterValidator, BaseModel, ConfigDict, Field, model_validator
from pydantic import NonNegativeInt as NonNegativeInt

Text = Annotated[str, Field(min_length=1)]
Share = Annotated[float, Field(ge=0, lt=1)]
"""A share: 0.01 is a percent."""


def _name_once(values: Any) -> Any:
    if len(set(values)) != len(values):
        raise ValueError(f"must name each once, but got {list(values)}")
    return values


Once = AfterValidator(_name_once)
"""What a list names, it names once."""


class Section(BaseModel):
    """A part of a configuration: a key that it does not know is refused, and nothing changes it once it is made."""

    model_config = ConfigDict(extra="forbid", frozen=True, strict=False)


def rule(check: Callable[[Any], Iterator[str]]) -> Any:
    """A method that yields a sentence for each law that its section breaks: the first is the section's error."""

    def validate(section: Any) -> Any:
        for sentence in check(section):
            raise ValueError(sentence)
        return section

    return model_validator(mode="after")(validate)


def ascending(low: str, high: str, strictly: bool = False) -> Any:
    """The rule that the number at one key is no larger than that at another, or smaller, where both are given."""

    def check(section: Any) -> Iterator[str]:
        below, above = getattr(section, low), getattr(section, high)
        if None not in (below, above) and (below > above or (strictly and below == above)):
            yield f"must have {low} {'<' if strictly else '<='} {high}, but got {below:g} and {above:g}"

    return rule(check)
