"""What a configuration may say of the probes that simulated data are seen through. SI, angles in rad."""

from __future__ import annotations

from typing import Annotated, Literal

from pydantic import Field

from pipeline.config.quantities import Angle, Deviation
from pipeline.config.section import NonNegativeInt, Section


class ProbeConfig(Section):
    """A displacement probe at a node; its angle is measured from x towards y (two at 45 and 135 degrees are usual)."""

    node: NonNegativeInt
    angle: Angle


class ProbesConfig(Section):
    """Which displacements are measured, and what the probes add to them.

    ``all`` and ``bearings`` stand for x and y at every node, or at the bearings. Noise is circular and complex: its
    root mean square is ``additive`` and a share ``multiplicative`` of the reading. Runout is a vector of this size and
    of random phase for each probe, the same at every speed and in every run that turns with the rotor. Readings are
    multiples of ``quantisation``.
    """

    at: Literal["all", "bearings"] | tuple[ProbeConfig, ...]
    additive: Deviation
    multiplicative: Annotated[float, Field(ge=0, lt=1)]
    runout: Deviation
    quantisation: Deviation
    seed: NonNegativeInt
