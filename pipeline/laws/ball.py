"""The law of a ball bearing: Hertzian contacts (Friswell et al. 2010, pages 182-185), as ROSS's BallBearingElement.

Legend: G members, S operating points, Th unknown numbers, 8 coefficients. SI units.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from typing import TYPE_CHECKING, ClassVar, Literal

import numpy as np
from pydantic import PositiveInt

from pipeline.config.quantities import AngleNumber, ForceNumber, LengthNumber, ShaftAngle
from pipeline.config.section import Section
from pipeline.laws.numbers import Number, Points, Recorded, add_slope, turn_axes

if TYPE_CHECKING:
    import torch


class BallLawConfig(Section):
    """A ball bearing: Hertzian contacts (Friswell et al. 2010, pages 182-185), as the modelled ``ball``."""

    kind: Literal["ball"]
    n_balls: PositiveInt
    ball_diameter: LengthNumber
    contact_angle: AngleNumber
    load: ForceNumber
    load_angle: ShaftAngle = -math.pi / 2

    has_film: ClassVar[bool] = False

    def make(self, where: str, number: Callable[[Section, str], Number]) -> BallLaw:
        """The law of the bearing at ``where``, its numbers made by ``number(section, name)``."""
        return BallLaw(
            n_balls=self.n_balls,
            ball_diameter=number(self, "ball_diameter"),
            contact_angle=number(self, "contact_angle"),
            load=number(self, "load"),
            load_angle=self.load_angle,
        )


@dataclass(frozen=True, kw_only=True)
class BallLaw(Recorded):
    """Number of balls, their diameter, contact angle, and the load (preload and static load) that presses them."""

    kind: Literal["ball"] = "ball"
    n_balls: int
    ball_diameter: Number  # m
    contact_angle: Number  # rad
    load: Number  # N
    load_angle: float  # rad

    inputs = ()

    def evaluate(
        self,
        theta: torch.Tensor,
        points: Points,
        stiffness: float = 13.0e6,
        damping: float = 1.25e-5,
        flattest: float = 1e-6,
    ) -> tuple[torch.Tensor, torch.Tensor]:
        """(G, S, 8) coefficients in N/m and N s/m, and (G, S, 8, Th) their slopes.

        ``stiffness`` (N^(2/3) m^(-4/3)) is that of steel balls, ``damping`` (s) what is usual over the stiffness, both
        as ROSS has them; ``flattest`` is the cosine that a contact angle meets which a fit puts beyond a right angle.
        """
        import torch

        angle = self.contact_angle.of(theta)
        cosine = torch.cos(angle).clamp(min=flattest)
        third = (self.ball_diameter.log(theta) + self.load.log(theta)) / 3
        axial = stiffness * self.n_balls ** (2 / 3) * torch.exp(third + 5 / 3 * cosine.log())
        ratio = np.polyval(np.polyfit((8, 12, 16), (0.46, 0.64, 0.73), 2), self.n_balls)  # across over along the load
        shape = turn_axes(self.load_angle) @ [1, 0, 0, ratio, damping, 0, 0, damping * ratio]
        values = (axial * torch.from_numpy(shape))[:, None].expand(-1, len(points.speeds), -1)
        slopes = values.new_zeros(*values.shape, theta.shape[1])
        add_slope(slopes, self.ball_diameter, values / 3)
        add_slope(slopes, self.load, values / 3)
        bent = -5 / 3 * angle * torch.sin(angle) / cosine * (cosine > flattest)
        add_slope(slopes, self.contact_angle, values * bent[:, None])
        return values, slopes

    def outside(self, theta: torch.Tensor, points: Points) -> np.ndarray:
        """(G, S) False: it has no table."""
        return np.zeros((len(theta), len(points.speeds)), dtype=bool)
