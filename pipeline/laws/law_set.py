"""The laws of all bearings together: coefficients and their slopes over theta, the unknown numbers' logarithms; and
the section ``machine.laws`` that says which numbers are known.

Legend: G members (fits beside each other), B bearings, S operating points, 8 coefficients, Th unknown numbers. SI
units, temperatures in K. ``theta = ln(number / guess)``.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass
from functools import partial
from typing import TYPE_CHECKING, Annotated, Any

import numpy as np
from pydantic import Field

from pipeline.config.operating import column_of
from pipeline.config.quantities import GuessConfig
from pipeline.config.section import NonNegativeInt, Section, rule
from pipeline.errors import ConfigError, DataError
from pipeline.laws.ball import BallLaw, BallLawConfig
from pipeline.laws.journal import JournalLaw, JournalTableLawConfig, ShortJournalLawConfig
from pipeline.laws.numbers import OIL_TEMPERATURE, LawParameter, Number, Points
from pipeline.laws.oil import Oil, OilConfig

if TYPE_CHECKING:
    import torch

_LAWS: dict[str, type[JournalLaw | BallLaw]] = {
    "short_journal": JournalLaw,
    "journal_table": JournalLaw,
    "ball": BallLaw,
}


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


@dataclass(frozen=True, eq=False)
class LawSet:
    """One law a bearing, the oil that they share, and the numbers that are unknown."""

    nodes: tuple[int, ...]  # B
    laws: tuple[JournalLaw | BallLaw, ...]  # B
    oil: Oil | None  # None where no bearing has a film
    parameters: tuple[LawParameter, ...]  # Th

    def __bool__(self) -> bool:
        """Whether any bearing has a law."""
        return bool(self.laws)

    @property
    def inputs(self) -> tuple[str, ...]:
        """Names of the operating conditions that it needs besides the speed."""
        oil = {OIL_TEMPERATURE} if self.oil and self.oil.needs_temperature else set()
        return tuple(sorted(oil.union(*(law.inputs for law in self.laws))))

    def numbers(self, theta: np.ndarray) -> np.ndarray:
        """(.., Th) the unknown numbers in SI at ``theta`` (.., Th)."""
        return np.array([parameter.guess for parameter in self.parameters]) * np.exp(theta)

    def coefficients(
        self, theta: torch.Tensor, speeds: np.ndarray, operating: Mapping[str, np.ndarray]
    ) -> tuple[torch.Tensor, torch.Tensor]:
        """(G, B, S, 8) in N/m and N s/m, and (G, B, S, 8, Th) slopes, at ``theta`` (G, Th).

        ``speeds`` (S,) are in rad/s; ``operating`` has (S,) values of the :attr:`inputs`, and may have others. Raises
        DataError where one is missing, where a load is not above zero, or a speed.
        """
        import torch

        points = self._place(theta, speeds, operating)
        values, slopes = zip(*(law.evaluate(theta, points) for law in self.laws), strict=True)
        return torch.stack(values, 1), torch.stack(slopes, 1)

    def outside(self, theta: torch.Tensor, speeds: np.ndarray, operating: Mapping[str, np.ndarray]) -> np.ndarray:
        """(G, B) the share of points whose Sommerfeld number or preload lies beyond the rows of the bearing's table.

        The law goes on smoothly there, but nobody computed it. Raises as :meth:`coefficients`.
        """
        theta = theta.detach()
        points = self._place(theta, speeds, operating)
        return np.stack([law.outside(theta, points).mean(axis=1) for law in self.laws], axis=1)

    def _place(self, theta: torch.Tensor, speeds: np.ndarray, operating: Mapping[str, np.ndarray]) -> Points:
        import torch

        for name in self.inputs:
            if name not in operating:
                raise DataError(
                    f"the bearing laws need the operating condition {name}, but the data have "
                    f"{', '.join(operating) or 'none'}: add the column {column_of(name).column}"
                )
        given = {name: torch.from_numpy(np.array(operating[name], dtype=float)) for name in self.inputs}
        for what, values in (("speeds", speeds), *((name, operating[name]) for name in self.inputs)):
            if not (np.asarray(values) > 0).all():
                raise DataError(f"the bearing laws need {what} above zero, but got {np.min(values):g} (SI, K)")
        log_viscosity, slopes = theta.new_zeros(len(theta), len(speeds)), theta.new_zeros(1, 1, theta.shape[1])
        if self.oil:
            temperature = given.get(OIL_TEMPERATURE, torch.full((len(speeds),), self.oil.reference).double())
            log_viscosity, slopes = self.oil.log_viscosity(theta, temperature)
        return Points(torch.from_numpy(np.array(speeds, dtype=float)), given, log_viscosity, slopes)

    def to_record(self) -> dict[str, Any]:
        """A JSON-able twin, the rows of its tables included."""
        return {
            "nodes": list(self.nodes),
            "oil": self.oil and self.oil.to_record(),
            "laws": [law.to_record() for law in self.laws],
            "parameters": [asdict(parameter) for parameter in self.parameters],
        }

    @classmethod
    def from_record(cls, record: Mapping[str, Any]) -> LawSet:
        """The laws of :meth:`to_record`."""
        return cls(
            nodes=tuple(record["nodes"]),
            laws=tuple(_LAWS[entry["kind"]].from_record(entry) for entry in record["laws"]),
            oil=Oil.from_record(record["oil"]) if record["oil"] else None,
            parameters=tuple(LawParameter(**parameter) for parameter in record["parameters"]),
        )


NO_LAWS = LawSet((), (), None, ())
"""The laws of a machine whose bearings have none."""


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
