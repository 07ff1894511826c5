"""The schema of bearing laws: what is known of bearings and oil, and guesses of the numbers that a fit finds. SI."""

from __future__ import annotations

import math
from typing import Annotated, Literal

from pydantic import Field, PositiveInt, model_validator

from pipeline.config.guesses import CONDITION, AngleNumber, ForceNumber, LengthNumber, LoadNumber, PureNumber, middle
from pipeline.config.oil import OilConfig
from pipeline.config.quantities import ShaftAngle
from pipeline.config.section import NonNegativeInt, Section

_ALONG_MINUS_Y = -math.pi / 2


class _JournalLawConfig(Section):
    """What every journal bearing has."""

    journal_diameter: LengthNumber
    length: LengthNumber
    radial_clearance: LengthNumber
    static_load: LoadNumber
    load_share: PureNumber = 1.0

    @model_validator(mode="after")
    def _turns_in_its_bore(self) -> _JournalLawConfig:
        radius, clearance = middle(self.journal_diameter) / 2, middle(self.radial_clearance)
        if clearance >= radius:
            raise ValueError(
                f"radial_clearance must be smaller than the journal's radius, but it is {1e3 * clearance:g} mm and "
                f"the radius {1e3 * radius:g} mm: correct the unit of the one that is wrong"
            )
        return self

    @model_validator(mode="after")
    def _shares_a_condition(self) -> _JournalLawConfig:
        if self.static_load != CONDITION and self.load_share != 1.0:
            raise ValueError("load_share must be left out where static_load is not `condition`, but it is given")
        return self


class ShortJournalLawConfig(_JournalLawConfig):
    """A short journal bearing in closed form (Friswell et al. 2010, page 177), as the modelled ``cylindrical``."""

    kind: Literal["short_journal"]
    load_angle: ShaftAngle = _ALONG_MINUS_Y


class JournalTableLawConfig(_JournalLawConfig):
    """A journal bearing from a table over the Sommerfeld number, packaged (by its name) or a CSV file.

    A table with a column ``preload`` needs a ``preload``.
    """

    kind: Literal["journal_table"]
    table: str
    preload: PureNumber | None = None
    load_angle: ShaftAngle = 0.0

    @model_validator(mode="after")
    def _is_a_preload(self) -> JournalTableLawConfig:
        if self.preload is not None and middle(self.preload) >= 1:
            raise ValueError(f"preload must be between 0 and 1, but got {middle(self.preload):g}")
        return self


class BallLawConfig(Section):
    """A ball bearing: Hertzian contacts (Friswell et al. 2010, pages 182-185), as the modelled ``ball``."""

    kind: Literal["ball"]
    n_balls: PositiveInt
    ball_diameter: LengthNumber
    contact_angle: AngleNumber
    load: ForceNumber
    load_angle: ShaftAngle = _ALONG_MINUS_Y


AnyLawConfig = Annotated[ShortJournalLawConfig | JournalTableLawConfig | BallLawConfig, Field(discriminator="kind")]


class LawsConfig(Section):
    """Laws of the bearings by node. The oil is the same in all of them."""

    oil: OilConfig | None = None
    bearings: dict[NonNegativeInt, AnyLawConfig] = Field(min_length=1)

    @model_validator(mode="after")
    def _has_oil(self) -> LawsConfig:
        journals = [node for node, law in self.bearings.items() if law.kind != "ball"]
        if journals and self.oil is None:
            raise ValueError(f"must have an oil for the journal bearing of node {journals[0]}, but it is missing")
        return self
