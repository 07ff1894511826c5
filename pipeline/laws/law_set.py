"""The laws of all bearings together: coefficients and their slopes over theta, the unknown numbers' logarithms.

Legend: G members (fits beside each other), B bearings, S operating points, 8 coefficients, Th unknown numbers. SI
units, temperatures in K. ``theta = ln(number / guess)``.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import asdict, dataclass
from typing import TYPE_CHECKING, Any

import numpy as np

from pipeline.errors import DataError
from pipeline.laws.ball import BallLaw
from pipeline.laws.journal import JournalLaw
from pipeline.laws.numbers import LawParameter
from pipeline.laws.oil import Oil
from pipeline.laws.points import LOAD, OIL_TEMPERATURE, Points

if TYPE_CHECKING:
    import torch

_COLUMNS = {OIL_TEMPERATURE: "oil_temperature_degC", LOAD: "load_N"}
_LAWS: dict[str, type[JournalLaw | BallLaw]] = {
    "short_journal": JournalLaw,
    "journal_table": JournalLaw,
    "ball": BallLaw,
}


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
                    f"{', '.join(operating) or 'none'}: add the column {_COLUMNS[name]}"
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
