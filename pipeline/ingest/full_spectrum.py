"""What time signals show beyond 1X: full spectra in orders of the rotor speed, and the mean position of the shaft.

Legend: n samples, P probes, T parts of a record, K orders.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from pipeline.config.measured import MeasuredProbeConfig
from pipeline.data.operating import space_evenly
from pipeline.ingest.order_tracking import Signals


@dataclass(frozen=True, eq=False)
class FullSpectra:
    """Spectra of x + j y of one node along a record."""

    speeds: np.ndarray  # (T,) rad/s, in the middle of each part
    orders: np.ndarray  # (K,) ascending; negative turns against the rotor
    spectrum: np.ndarray  # (T, K) m, amplitude of the circle that turns with each order
    centre: np.ndarray  # (T, 2) m, mean x and y


def measure_full_spectra(
    records: Sequence[Signals],
    probes: Mapping[str, MeasuredProbeConfig],
    node: int,
    part_turns: int = 32,
    per_turn: int = 32,
    highest: float = 4.0,
    most_parts: int = 48,
) -> FullSpectra | None:
    """Spectra of the ``node`` from the probes there, resampled at equal angles; None where all records are too short.

    ``records`` have one column for each of ``probes``, in their order. A part has so many turns: orders are told apart
    by one over it, and by twice that after the window; they are shown up to the ``highest``, of ``most_parts`` of each.
    """
    columns = [p for p, probe in enumerate(probes.values()) if probe.node == node]
    angles = np.array([probe.angle for probe in probes.values()])[columns]
    inverse = np.linalg.pinv(np.stack([np.cos(angles), np.sin(angles)], axis=1))
    step = np.arange(part_turns * per_turn) / per_turn
    window = np.hanning(len(step))
    orders = np.fft.fftshift(np.fft.fftfreq(len(step), 1 / per_turn))
    keep = np.abs(orders) <= highest
    speeds, spectra, centres = [], [], []
    for record in (signals.between_pulses() for signals in records):
        turns = np.asarray(record.angle.angle(record.time)) / (2 * np.pi)
        count = int((turns[-1] - turns[0]) // part_turns)
        for shown in space_evenly(count, most_parts):
            at = np.interp(turns[0] + shown * part_turns + step, turns, record.time)
            first, last = np.searchsorted(record.time, at[[0, -1]])
            near = slice(max(first - 1, 0), last + 1)
            seen = record.displacement(near).T[columns]
            xy = inverse @ np.stack([np.interp(at, record.time[near], values) for values in seen])
            centre = xy.mean(axis=1)
            moving = (xy[0] - centre[0]) + 1j * (xy[1] - centre[1])
            spectrum_lines = np.abs(np.fft.fftshift(np.fft.fft(moving * window))) / window.sum()
            speeds.append(2 * np.pi * part_turns / (at[-1] - at[0]) * (len(step) - 1) / len(step))
            spectra.append(spectrum_lines[keep])
            centres.append(centre)
    return FullSpectra(np.array(speeds), orders[keep], np.array(spectra), np.array(centres)) if speeds else None
