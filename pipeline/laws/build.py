"""From the section ``machine.laws`` to its laws: which numbers are known, and which are theta."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

from pipeline.config.guesses import CONDITION, GuessConfig
from pipeline.config.laws import BallLawConfig, JournalTableLawConfig, LawsConfig, ShortJournalLawConfig
from pipeline.config.oil import ConstantOilConfig, ExponentialOilConfig, VogelOilConfig
from pipeline.errors import ConfigError
from pipeline.laws.ball import BallLaw
from pipeline.laws.files import read_film_table
from pipeline.laws.journal import JournalLaw
from pipeline.laws.law_set import LawSet
from pipeline.laws.numbers import LawParameter, Number
from pipeline.laws.oil import Oil
from pipeline.laws.short_bearing import short_table
from pipeline.laws.table import FilmTable

_ABSENT = Number(1.0)
_ROOM_TEMPERATURE = 293.15  # K; a constant viscosity has no other


class _Collector:
    """Collects the unknown numbers in the order in which they are asked for."""

    def __init__(self) -> None:
        self.found: list[LawParameter] = []

    def number(self, section: Any, name: str, where: str, member: int | None) -> Number:
        """The number ``name`` of a ``section`` of the configuration."""
        value = getattr(section, name)
        if not isinstance(value, GuessConfig):
            return Number(float(value))
        unit = (type(section).model_fields[name].json_schema_extra or {}).get("unit", "")
        self.found.append(LawParameter(f"{where}.{name}", unit, value.guess, value.within, member))
        return Number(value.guess, len(self.found) - 1)


def make_laws(config: LawsConfig, nodes: Sequence[int]) -> LawSet:
    """The laws of the bearings at ``nodes``, in that order; theta has the oil's unknown numbers first.

    Raises ConfigError: a node without a law, a table that is none, a preload that is missing or has no meaning.
    """
    collector, laws = _Collector(), []
    without = [node for node in nodes if node not in config.bearings]
    if without:
        raise ConfigError(
            f"machine.laws.bearings must have a law for node {without[0]}, but it has "
            f"{', '.join(map(str, config.bearings))}: add it"
        )
    journals = any(config.bearings[node].kind != "ball" for node in nodes)
    oil = make_oil(config.oil, collector.number) if journals and config.oil is not None else None
    for member, node in enumerate(nodes):
        law = config.bearings[node]
        laws.append(
            _make_ball(law, f"{node}", member, collector)
            if isinstance(law, BallLawConfig)
            else _make_journal(law, f"{node}", member, collector)
        )
    return LawSet(tuple(nodes), tuple(laws), oil, tuple(collector.found))


def make_oil(config: ConstantOilConfig | ExponentialOilConfig | VogelOilConfig, number: Any) -> Oil:
    """The oil of a section, its numbers made by ``number(section, name, where, member)``."""
    names = [name for name in ("viscosity", "slope", "b", "c") if name in type(config).model_fields]
    made = {name: number(config, name, "oil", None) for name in names}
    reference = getattr(config, "reference", _ROOM_TEMPERATURE)
    return Oil(config.law, reference, **{name: made.get(name, _ABSENT) for name in ("viscosity", "slope", "b", "c")})


def _make_ball(law: BallLawConfig, where: str, member: int, collector: _Collector) -> BallLaw:
    names = ("ball_diameter", "contact_angle", "load")
    numbers = {name: collector.number(law, name, where, member) for name in names}
    return BallLaw(n_balls=law.n_balls, load_angle=law.load_angle, **numbers)


def _make_journal(
    law: ShortJournalLawConfig | JournalTableLawConfig, where: str, member: int, collector: _Collector
) -> JournalLaw:
    def number(name: str) -> Number:
        return collector.number(law, name, where, member)

    loaded = law.static_load == CONDITION
    table = short_table() if isinstance(law, ShortJournalLawConfig) else _read_table(law, where)
    return JournalLaw(
        kind=law.kind,
        table=table,
        diameter=number("journal_diameter"),
        length=number("length"),
        clearance=number("radial_clearance"),
        load=_ABSENT if loaded else number("static_load"),
        share=number("load_share") if loaded else _ABSENT,
        preload=number("preload") if table.has_preload else _ABSENT,
        loaded=loaded,
        load_angle=law.load_angle,
    )


def _read_table(law: JournalTableLawConfig, where: str) -> FilmTable:
    table = read_film_table(law.table)
    if table.has_preload == (law.preload is not None):
        return table
    span = f"from {table.preloads[0]:g} to {table.preloads[-1]:g}" if table.has_preload else "none"
    verb = "give" if table.has_preload else "leave out"
    raise ConfigError(
        f"machine.laws.bearings.{where} must have a preload where its table has some, but '{law.table}' has {span}: "
        f"{verb} preload"
    )


def known_number(section: Any, name: str, where: str, member: int | None) -> Number:
    """A number of a section that has no unknown ones (``make_oil`` of a modelled bearing)."""
    return Number(float(getattr(section, name)))
