"""Back from SI to what a table of records is written in: its unit and sense of vectors, its angles of weights."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from pipeline.config.measured import AnyRecordingsConfig
from pipeline.config.motion import to_motion
from pipeline.ingest.conventions import to_displacement, to_lead

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
        said, columns = self.recordings.vectors, []
        for scale in [self.recordings.probes[name].scale for name in self.probes] or [None]:
            order, size = to_motion(said.unit, scale)
            unit = to_lead(np.ones(len(speeds), dtype=complex), size, said.amplitude, "lead")
            columns.append(to_displacement(unit, order, speeds))
        return np.stack(columns, axis=1)

    def weights(self, unbalance: np.ndarray) -> np.ndarray:
        """Complex g mm, of ``unbalance`` in kg m: the angle is measured on the shaft as the recordings say."""
        begin = self.recordings.angle_from_x(0.0)
        sense = np.sign(self.recordings.angle_from_x(1.0) - begin)
        turned = sense * (np.angle(unbalance) - begin)
        return np.asarray(np.abs(unbalance) / GRAM_MILLIMETRE * np.exp(1j * turned))
