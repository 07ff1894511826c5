"""What a configuration may say of how a simulated machine differs from its model."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any, Literal

from pydantic import Field, PositiveInt

from pipeline.config.quantities import Mass, PositiveAngle, Stiffness
from pipeline.config.rotor import ShaftSegmentConfig
from pipeline.config.section import NonNegativeInt, Section, Share, rule


class AsBuiltConfig(Section):
    """The machine that makes the data, where it is not the one that the fit assumes: no identification reads it.

    Its vibration is that of the dynamic stiffness (``frequency``), or of integration in ``time``.

    Numbers of rotor and coupling are what they differ by, as a share where they have no unit. Weights and probes differ
    by normal deviates of the given standard deviations. ``shaft`` takes the place of the model's and has as many
    elements; ``shear_effects`` and ``rotary_inertia`` are those of its beam. A pedestal stands under every bearing and
    moves in x and y alike; the model's bearings stand on rock.
    """

    method: Literal["frequency", "time"] = "frequency"
    refinement: PositiveInt = 1  # elements for each one of the model
    shaft: tuple[ShaftSegmentConfig, ...] | None = None
    shear_effects: bool | None = None
    rotary_inertia: bool | None = None
    youngs_modulus: float = Field(default=0.0, gt=-1)
    density: float = Field(default=0.0, gt=-1)
    disc_mass: float = Field(default=0.0, gt=-1)
    disc_inertia: float = Field(default=0.0, gt=-1)
    coupling_stiffness: Stiffness | None = None
    coupling_mass: Mass | None = None
    coupling_node: NonNegativeInt = 0  # of the model
    pedestal_stiffness: Stiffness | None = None
    pedestal_mass: Mass | None = None
    unbalance_magnitude: Share = 0.0
    unbalance_phase: PositiveAngle | None = None
    probe_gain: Share = 0.0
    probe_angle: PositiveAngle | None = None

    @property
    def in_time(self) -> bool:
        """Whether the vibration is integrated."""
        return self.method == "time"

    @property
    def beam(self) -> dict[str, Any]:
        """What takes the place of the same keys of the rotor."""
        given = {name: getattr(self, name) for name in ("shaft", "shear_effects", "rotary_inertia")}
        return {name: value for name, value in given.items() if value is not None}

    @rule
    def _stands(self) -> Iterator[str]:
        if self.pedestal_mass is not None and self.pedestal_stiffness is None:
            yield "must have a pedestal_stiffness beside pedestal_mass, but it is missing"
