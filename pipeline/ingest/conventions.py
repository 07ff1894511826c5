"""What amplitude, phase and angle mean, worked out once.

Time zero is a tacho pulse, w the rotor speed. A probe at the angle a (from x towards y; the shaft turns from x
towards y) gives the displacement of the shaft towards it, v = x cos a + y sin a = Re(V e^{jwt}).

Amplitude. |V| is zero-to-peak: half of a peak-to-peak value, sqrt(2) times a root mean square.

Phase. A phase *lag* is the rotation, in degrees, from the tacho pulse to the next positive peak of the signal, when
the shaft is nearest to the probe (the high spot): v = A cos(wt - lag), so V = A e^{-j lag}. A phase *lead* is its
opposite: v = A cos(wt + lead), V = A e^{+j lead}. Complex numbers have their angle as a lead where they belong to
e^{jwt}, and as a lag (they are conjugated here) where they belong to e^{-jwt}.

Velocities and accelerations. U = (j w)^k V, so the displacement is V = U / (j w)^k, with the frequency w of the
vibration.

Excitation. An unbalance m e acts as F = w^2 m e e^{jp} [1, -j] on (x, y), that is w^2 m e (cos(wt + p), sin(wt + p)):
p is its angle from x at t = 0, at the pulse. At the pulse the shaft's mark stands at the tacho probe's angle T. An
unbalance at the angle s on the shaft, measured from the mark, is therefore at

    p = T + s   where s is measured with the rotation,      p = T - s   where it is measured against it.

A balancing instrument's "angle from the mark against rotation" is the second. Where the mark is long, it is the end
of it that makes the configured edge of the pulse.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from pipeline.config.measured import (
    AmplitudeKind,
    AnyRecordingsConfig,
    PhaseSense,
    SpeedUnit,
    VectorConventionsConfig,
)
from pipeline.config.motion import to_motion
from pipeline.units import RAD_S_PER_RPM

_TO_PEAK: dict[AmplitudeKind, float] = {"zero_to_peak": 1.0, "peak_to_peak": 0.5, "rms": math.sqrt(2.0)}
RAD_S: dict[SpeedUnit, float] = {"rpm": RAD_S_PER_RPM, "Hz": 2 * math.pi, "rad/s": 1.0}
"""Size of each unit of speed, rad/s."""


def describe_vectors(said: VectorConventionsConfig) -> str:
    """What complex numbers in a file are taken for."""
    return (
        f"complex, {said.unit}, {said.amplitude.replace('_', '-')}, angle a phase {said.phase}, speed in {said.speed}"
    )


def read_vectors(
    values: np.ndarray, said: VectorConventionsConfig, scale: str | None, frequencies: np.ndarray
) -> np.ndarray:
    """V in m of complex ``values`` of a probe of this ``scale``, at ``frequencies`` (rad/s, of their shape)."""
    order, size = to_motion(said.unit, scale)
    return to_displacement(to_lead(values, size, said.amplitude, said.phase), order, frequencies)


def to_lead(values: np.ndarray, size: float, kind: AmplitudeKind, sense: PhaseSense) -> np.ndarray:
    """Complex V in SI units, zero-to-peak, of complex values in units of ``size``."""
    with np.errstate(over="ignore"):  # what is too large for a number is no vibration, and refused as such
        return (values if sense == "lead" else values.conj()) * (size * _TO_PEAK[kind])


def to_displacement(vectors: np.ndarray, order: int, frequencies: np.ndarray) -> np.ndarray:
    """V in m of ``vectors`` in m/s^k of the order k at ``frequencies`` (rad/s, of their shape): U / (j w)^k."""
    if order == 0:
        return vectors
    with np.errstate(divide="ignore", invalid="ignore"):  # at standstill, which is refused later
        return vectors / (1j * frequencies) ** order


# --- back to what a table of records is written in ------------------------------------------------


GRAM_MILLIMETRE = 1e-6
"""kg m"""


@dataclass(frozen=True)
class SourceUnits:
    """The conventions of a machine's recordings; um zero-to-peak, phase lead and angles from x where it has no table of
    records."""

    recordings: AnyRecordingsConfig

    @property
    def unit(self) -> str:
        """Of vectors."""
        return self.recordings.vectors.unit

    @property
    def probes(self) -> tuple[str, ...]:
        """The names of the probes in the order of the channels; none where there is no table of records."""
        return tuple(self.recordings.probes) if self.recordings.planes else ()

    def vectors(self, displacement: np.ndarray, speeds: np.ndarray) -> np.ndarray:
        """(n, P) complex in the table's unit, of ``displacement`` (n, P) m at the probes and ``speeds`` (n,) rad/s."""
        values = displacement / self.sizes(speeds)
        return np.asarray(values.conj() if self.recordings.vectors.phase == "lag" else values)

    def sizes(self, speeds: np.ndarray) -> np.ndarray:
        """(n, P) complex m: one unit of each probe's vector at these ``speeds`` (n,) rad/s."""
        scales = [self.recordings.probes[name].scale for name in self.probes] or [None]
        ones = np.ones(len(speeds), dtype=complex)
        return np.stack([read_vectors(ones, self.recordings.vectors, scale, speeds) for scale in scales], axis=1)

    def weights(self, unbalance: np.ndarray) -> np.ndarray:
        """Complex g mm, of ``unbalance`` in kg m: the angle is measured on the shaft as the recordings say."""
        begin = self.recordings.angle_from_x(0.0)
        sense = np.sign(self.recordings.angle_from_x(1.0) - begin)
        turned = sense * (np.angle(unbalance) - begin)
        return np.asarray(np.abs(unbalance) / GRAM_MILLIMETRE * np.exp(1j * turned))
