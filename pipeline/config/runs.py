"""The schema of runs: speeds, excitation, noise, probes, and designs of runs.

SI, angles in rad, speeds in rpm.
"""

from __future__ import annotations

from collections.abc import Iterator
from typing import Annotated, Any, Literal

import numpy as np
from pydantic import Field, NonNegativeFloat, PositiveFloat, PositiveInt

from pipeline.config.motion import Floor
from pipeline.config.operating import States
from pipeline.config.quantities import Angle, Deviation, Force, UnbalanceMagnitude
from pipeline.config.section import NonNegativeInt, Section, Share, ascending, rule
from pipeline.units import RAD_S_PER_RPM


class SpeedsConfig(Section):
    """Rotor speeds from ``start_rpm`` to ``stop_rpm`` inclusive; 0 of a rotor at rest."""

    start_rpm: NonNegativeFloat
    stop_rpm: NonNegativeFloat
    step_rpm: PositiveFloat

    _span = ascending("start_rpm", "stop_rpm")

    def rpm(self) -> list[float]:
        """The speeds, ascending, in rpm."""
        count = int((self.stop_rpm - self.start_rpm) / self.step_rpm + 1e-9) + 1
        return [self.start_rpm + i * self.step_rpm for i in range(count)]

    def rad_s(self) -> np.ndarray:
        """(S,) the same in rad/s."""
        return np.array(self.rpm()) * RAD_S_PER_RPM


class UnbalanceConfig(Section):
    """An unbalance (kg m) at a node; it excites forward whirl at the rotor speed."""

    node: NonNegativeInt
    magnitude: UnbalanceMagnitude
    phase: Angle = 0.0


class ForceConfig(Section):
    """A rotating force (N) at a node, of a shaker or a magnetic bearing."""

    node: NonNegativeInt
    magnitude: Force
    phase: Angle = 0.0
    whirl: Literal["forward", "backward"] = "forward"


class RunConfig(Section):
    """One configuration of unbalances and forces, measured over all speeds.

    The forces turn at the rotor speed, or at ``frequency_hz``, or at ``frequency_ratio`` times the rotor speed;
    unbalances always turn with the rotor.
    """

    name: str = Field(min_length=1)
    unbalances: tuple[UnbalanceConfig, ...] = ()
    forces: tuple[ForceConfig, ...] = ()
    frequency_hz: PositiveFloat | None = None
    frequency_ratio: PositiveFloat | None = None

    @rule
    def _excited(self) -> Iterator[str]:
        if not self.unbalances and not self.forces:
            yield f"run '{self.name}' must have an unbalance or a force, but it has none"
        yield from check_frequency(self)


def check_frequency(run: Any) -> Iterator[str]:
    """What is wrong with a ``run`` with two frequencies of its own, or with one beside an unbalance."""
    if run.frequency_hz and run.frequency_ratio:
        yield f"run '{run.name}' must have frequency_hz or frequency_ratio, but it has both"
    if run.unbalances and (run.frequency_hz or run.frequency_ratio):
        yield (
            f"run '{run.name}' must have no unbalances where its forces have a frequency of their own (unbalances turn "
            "with the rotor), but it has some: put them into another run"
        )


def find_frequencies(run: Any, speeds: np.ndarray) -> np.ndarray:
    """(S,) rad/s of what happens in a ``run`` at the rotor ``speeds`` (S,) rad/s."""
    hz, ratio = run.frequency_hz, run.frequency_ratio
    return 0 * speeds + 2 * np.pi * hz if hz else speeds * (ratio or 1.0)


class NoiseConfig(Section):
    """Root mean square of the noise of each measured complex displacement: ``additive``, and a share of its size.

    ``drift`` is that of a condition's records together, where the conditions are too few to estimate it. ``record`` is
    the share by which all readings of a run at a speed are too large or too small together. Probes may have a floor of
    their own beside it.
    """

    additive: Deviation
    multiplicative: Share
    drift: Deviation = 0.0
    record: Share = 0.0


Measures = Literal["shaft", "casing", "shaft relative to casing"]
"""What a probe shows at the node of a bearing that has a support."""


class ProbeConfig(Section):
    """A probe at a node; its angle is measured from x towards y (two at 45 and 135 degrees are usual).

    ``floor`` is noise beside the others, constant in what the probe measures: a length, a velocity or an acceleration,
    root mean square of a complex reading.
    """

    node: NonNegativeInt
    angle: Angle
    measures: Measures = "shaft"
    floor: Floor = "0 um"


class ProbesConfig(Section):
    """The displacements that are measured, and what the probes add to them.

    ``all`` and ``bearings`` stand for x and y at every node, or at the bearings. Noise is circular and complex: its
    root mean square is ``additive`` and a share ``multiplicative`` of the reading. Runout is a vector of this size and
    of random phase for each probe, the same at every speed and in every run that turns with the rotor. It is subtracted
    as the mean of ``slow_roll_readings`` shows it, with their noise (0: it stays in). Readings are multiples of
    ``quantisation``.
    """

    at: Literal["all", "bearings"] | tuple[ProbeConfig, ...]
    additive: Deviation
    multiplicative: Share
    runout: Deviation
    quantisation: Deviation
    slow_roll_readings: Annotated[int, Field(ge=0, le=1000)]
    seed: NonNegativeInt

    @property
    def listed(self) -> tuple[ProbeConfig, ...]:
        """Those that are given one by one; none where a word stands for them."""
        return () if isinstance(self.at, str) else self.at


class CandidateConfig(Section):
    """An experimenter can use these trial unbalances and rotating forces, at these nodes and phases."""

    unbalance_nodes: tuple[NonNegativeInt, ...]
    unbalance: UnbalanceMagnitude
    force_nodes: tuple[NonNegativeInt, ...]
    force: Force
    whirls: tuple[Literal["forward", "backward"], ...]
    phases_deg: tuple[float, ...] = Field(min_length=1)

    @rule
    def _some(self) -> Iterator[str]:
        if not self.unbalance_nodes and not (self.force_nodes and self.whirls):
            yield "must have an unbalance node, or a force node and a whirl, but there is no candidate"


class DesignConfig(Section):
    """``stage=design`` chooses so many runs from the candidates: the best by the criterion over speeds.

    With ``accuracy``, a relative standard deviation, it chooses at most so many runs, and as few speeds of the machine
    as reach it for each coefficient as a series of ``functions`` terms. Candidates are then made smaller where an orbit
    at a bearing would leave the share ``clearance`` of its radial clearance. With a model of bearing laws the accuracy
    is that of their ``numbers``, or of all that are unknown, in states that are chosen from ``operating``.
    """

    runs: PositiveInt
    accuracy: Annotated[float, Field(gt=0, lt=1)] | None
    functions: Annotated[int, Field(ge=2, le=64)]
    clearance: Annotated[float, Field(gt=0, le=1)]
    criterion: Literal["A", "D"]
    speeds: Annotated[int, Field(ge=2)]
    simulations: NonNegativeInt
    numbers: tuple[str, ...]
    operating: States
