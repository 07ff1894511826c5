"""The section ``machine.laws`` and its laws: which numbers are known, and which are theta."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from functools import partial
from typing import Annotated

from pydantic import Field

from pipeline.config.guesses import GuessConfig
from pipeline.config.section import NonNegativeInt, Section, rule
from pipeline.errors import ConfigError
from pipeline.laws.ball import BallLawConfig
from pipeline.laws.journal import JournalTableLawConfig, ShortJournalLawConfig
from pipeline.laws.law_set import LawSet
from pipeline.laws.numbers import LawParameter, Number
from pipeline.laws.oil import OilConfig

AnyLawConfig = Annotated[ShortJournalLawConfig | JournalTableLawConfig | BallLawConfig, Field(discriminator="kind")]


class LawsConfig(Section):
    """Laws of the bearings by node. The oil is the same in all of them."""

    oil: OilConfig | None = None
    bearings: dict[NonNegativeInt, AnyLawConfig] = Field(min_length=1)

    @rule
    def _has_oil(self) -> Iterator[str]:
        journals = [node for node, law in self.bearings.items() if law.has_film]
        if journals and not self.oil:
            yield f"must have an oil for the journal bearing of node {journals[0]}, but it is missing"


def make_laws(config: LawsConfig, nodes: Sequence[int]) -> LawSet:
    """The laws of the bearings at ``nodes``, in that order; theta has the oil's unknown numbers first.

    Raises ConfigError: a node without a law, a table that is none, a preload that is missing or has no meaning.
    """
    without = [node for node in nodes if node not in config.bearings]
    if without:
        raise ConfigError(
            f"machine.laws.bearings must have a law for node {without[0]}, but it has "
            f"{', '.join(map(str, config.bearings))}: add it"
        )
    theta: list[LawParameter] = []
    films = any(config.bearings[node].has_film for node in nodes)
    oil = config.oil.make(partial(_make_number, theta, "oil", None)) if films and config.oil else None
    laws = [
        config.bearings[node].make(f"{node}", partial(_make_number, theta, f"{node}", member))
        for member, node in enumerate(nodes)
    ]
    return LawSet(tuple(nodes), tuple(laws), oil, tuple(theta))


def _make_number(theta: list[LawParameter], where: str, member: int | None, section: Section, name: str) -> Number:
    """The number ``name`` of a ``section``; an unknown one is added to ``theta``."""
    value = getattr(section, name)
    if not isinstance(value, GuessConfig):
        return Number(float(value))
    extra = type(section).model_fields[name].json_schema_extra
    unit = str(extra.get("unit", "")) if isinstance(extra, dict) else ""
    theta.append(LawParameter(f"{where}.{name}", unit, value.guess, value.within, member))
    return Number(value.guess, len(theta) - 1)


def known_number(section: Section, name: str) -> Number:
    """A number of a section that has no unknown ones (the oil of a modelled bearing)."""
    return Number(float(getattr(section, name)))
