"""The schema of bearings: one class for each kind. SI."""

from __future__ import annotations

import itertools
from typing import Annotated, Literal

from pydantic import Field, PositiveInt, model_validator

from pipeline.config.guesses import ModelledLoad
from pipeline.config.oil import ModelledViscosity
from pipeline.config.quantities import Angle, AnyDamping, AnyStiffness, Length, ShaftAngle
from pipeline.config.section import NonNegativeInt, Section


class BallBearingConfig(Section):
    """ROSS ``BallBearingElement`` (Friswell et al. 2010, pages 182-185)."""

    kind: Literal["ball"]
    n_balls: PositiveInt
    ball_diameter: Length
    static_load: ModelledLoad
    contact_angle: Angle


class CylindricalBearingConfig(Section):
    """ROSS ``CylindricalBearing``, a short fluid-film bearing (Friswell et al. 2010, page 177).

    ``static_load`` of null shares the rotor's weight equally among the bearings.
    """

    kind: Literal["cylindrical"]
    journal_diameter: Length
    length: Length
    radial_clearance: Length
    oil_viscosity: ModelledViscosity
    static_load: ModelledLoad | None = None


class JournalTableConfig(Section):
    """A journal bearing from a table of dimensionless coefficients over the Sommerfeld number.

    ``rows`` are (S, Kxx, Kxy, Kyx, Kyy, Bxx, Bxy, Byx, Byy), with x the direction of the load,
    S = viscosity N L D / W (R / C)^2, N in 1/s; k = K W / C and c = B W / (w C). Between the rows: cubic splines of the
    logarithm of S. ``table`` in their place is the name of a table of the package, or a CSV file.
    """

    kind: Literal["journal_table"]
    rows: tuple[Annotated[tuple[float, ...], Field(min_length=9, max_length=9)], ...] | None = Field(None, min_length=4)
    table: str | None = None
    journal_diameter: Length
    length: Length
    radial_clearance: Length
    oil_viscosity: ModelledViscosity
    static_load: ModelledLoad
    preload: float | None = Field(None, ge=0, lt=1)
    load_angle: ShaftAngle = 0.0

    @model_validator(mode="after")
    def _ascending(self) -> JournalTableConfig:
        if (self.rows is None) == (self.table is None):
            raise ValueError(f"must have either rows or table, but has {'neither' if self.rows is None else 'both'}")
        numbers = [row[0] for row in self.rows or ()]
        if numbers and (numbers[0] <= 0 or any(b <= a for a, b in itertools.pairwise(numbers))):
            raise ValueError(f"must have rows with ascending Sommerfeld numbers above zero, but got {numbers}")
        return self


class SpeedTableConfig(Section):
    """Coefficients at some speeds, such as measured or published ones, and straight lines between them.

    ``rows`` are (speed in rpm, kxx, kxy, kyx, kyy, cxx, cxy, cyx, cyy), N/m and N s/m.
    """

    kind: Literal["speed_table"]
    rows: tuple[Annotated[tuple[float, ...], Field(min_length=9, max_length=9)], ...] = Field(min_length=2)

    @model_validator(mode="after")
    def _ascending(self) -> SpeedTableConfig:
        speeds = [row[0] for row in self.rows]
        if speeds[0] < 0 or any(b <= a for a, b in itertools.pairwise(speeds)):
            raise ValueError(f"must have rows with ascending speeds (rpm), but got {speeds}")
        return self


class LinearBearingConfig(Section):
    """A support with the same coefficients at every speed."""

    kind: Literal["linear"]
    kxx: AnyStiffness = 0.0
    kxy: AnyStiffness = 0.0
    kyx: AnyStiffness = 0.0
    kyy: AnyStiffness = 0.0
    cxx: AnyDamping = 0.0
    cxy: AnyDamping = 0.0
    cyx: AnyDamping = 0.0
    cyy: AnyDamping = 0.0


class RotorFileBearingConfig(Section):
    """The bearings that are saved in ``machine.rotor.file``."""

    kind: Literal["rotor_file"]


_SingleBearing = (
    BallBearingConfig | CylindricalBearingConfig | JournalTableConfig | SpeedTableConfig | LinearBearingConfig
)
AnyBearingConfig = Annotated[_SingleBearing, Field(discriminator="kind")]


class PerNodeBearingConfig(Section):
    """Bearings that differ, by node."""

    kind: Literal["per_node"]
    nodes: dict[NonNegativeInt, AnyBearingConfig] = Field(min_length=1)


BearingConfig = Annotated[_SingleBearing | PerNodeBearingConfig | RotorFileBearingConfig, Field(discriminator="kind")]
