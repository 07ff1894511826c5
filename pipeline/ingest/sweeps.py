"""How much the sweep of a run-up biases the peak that its vectors show: rate from the tacho, bias from the model."""

from __future__ import annotations

import numpy as np

from pipeline.ingest.tracks import RunTracks
from pipeline.sweep.bias import SweepBias, describe_bias, find_mode, measure_bias, read_peak


def measure_sweep(run: RunTracks, most: float) -> SweepBias | None:
    """The bias at the largest peak of the probe that has most of it; ``most`` is the share that a peak may lag.

    None for a run without times, and where no probe shows a peak with half the power on both sides.
    """
    if run.times is None or len(run.times) < 3:
        return None
    biases: list[SweepBias] = []
    for track in run.tracks.values():
        reading = read_peak(track.speeds, np.abs(track.vectors))
        if reading:
            rates = np.gradient(track.speeds, run.times)
            rate = float(np.interp(reading.frequency, track.speeds, rates))
            biases.append(measure_bias(*find_mode(reading, rate), rate, most))
    return max(biases, key=lambda bias: abs(bias.peak_shift), default=None)


def note_sweep(run: RunTracks, bias: SweepBias | None) -> list[str]:
    """A sentence where the peak lags by more than it may."""
    if not bias or abs(bias.peak_shift) <= bias.most:
        return []
    return [
        f"run '{run.name}' is no sequence of steady states: {describe_bias(bias)}; run it slower, or fit the ramp "
        "with stage=runup"
    ]
