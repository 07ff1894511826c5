"""What a configuration may say of how a simulated machine differs from its model."""

from __future__ import annotations

from pydantic import Field, PositiveInt

from pipeline.config.quantities import Mass, PositiveAngle, Stiffness
from pipeline.config.section import NonNegativeInt, Section, Share


class AsBuiltConfig(Section):
    """The machine that makes the data, where it is not the one that the fit assumes: no identification reads it.

    Numbers of rotor and coupling are what they differ by, as a share where they have no unit. Weights and probes differ
    by normal deviates of the given standard deviations.
    """

    refinement: PositiveInt = 1  # elements for each one of the model
    youngs_modulus: float = Field(default=0.0, gt=-1)
    density: float = Field(default=0.0, gt=-1)
    disc_mass: float = Field(default=0.0, gt=-1)
    disc_inertia: float = Field(default=0.0, gt=-1)
    coupling_stiffness: Stiffness | None = None
    coupling_mass: Mass | None = None
    coupling_node: NonNegativeInt = 0  # of the model
    unbalance_magnitude: Share = 0.0
    unbalance_phase: PositiveAngle | None = None
    probe_gain: Share = 0.0
    probe_angle: PositiveAngle | None = None
