"""Frequency responses of a levitated rotor from one sweep through the current of a magnetic bearing.

    python studies/levitated/frequency_responses.py FOLDER examples/levitated/frequency_responses.csv

``FOLDER`` holds ``Sweep_Time_Anregung.mat`` and ``Sweep_Time_Ausgang.mat`` of AppliedMechanics/AMrotor (see
examples/levitated/README.md), which are not part of this project.

There is one sweep, so nothing is averaged. The response over the drive of the sweep is the ratio of both spectra; its
inverse transform is the impulse response, in which harmonics of a rising sweep lie before the time zero, and noise
everywhere. What lies in a window behind zero is kept (Mueller and Massarani 2001, "Transfer-function measurement with
sweeps", J. Audio Eng. Soc. 49, 443-471). What lies behind the window is noise, and gives the deviations.

Legend: T samples, P signals, S lines. Hz and s.
"""

from __future__ import annotations

import sys
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pandas as pd

from pipeline.data.mat_files import read_mat

RATE = 2048.0  # Hz, of sampling
SWEEP = 500.0 / 16.0  # Hz/s
CHANNELS = tuple(f"a{i}" for i in range(1, 9))


@dataclass(frozen=True)
class Lines:
    """Lines of the spectrum, and how much of the impulse response they are made of."""

    first: float
    last: float
    step: float
    length: float  # s; all that is left of the impulse response then must be noise


LINES = (Lines(10.0, 29.875, 0.125, 8.0), Lines(30.0, 250.0, 0.5, 1.5))
"""The mode at 16 Hz rings for seconds, the others for tenths of a second: there a shorter window leaves less noise."""


def respond(
    drive: np.ndarray,
    signals: np.ndarray,
    lines: Lines,
    rate: float = RATE,
    sweep: float = SWEEP,
    before: float = 0.1,
    fade: float = 0.3,
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Frequencies (S,), responses (S, P) of ``signals`` (T, P) over ``drive`` (T,), and deviations (S, P) of each part.

    Args:
        drive: a sweep from zero that rises by ``sweep`` Hz/s over the record.
        before: s before the time zero over which the window rises.
        fade: its share of the window, over which it falls.
    """
    count = len(drive)
    frequency = np.fft.rfftfreq(count, 1 / rate)
    swept = sweep * count / rate
    keep = np.interp(frequency, [0.3 * lines.first, 0.5 * lines.first, 0.96 * swept, 0.98 * swept], [0, 1, 1, 0])
    ratio = np.fft.rfft(signals, axis=0) / np.fft.rfft(drive)[:, None] * keep[:, None]
    impulse = np.fft.irfft(ratio, count, axis=0)
    time = np.arange(count) / rate
    rise, fall = (time - count / rate) / before + 1, (lines.length - time) / (fade * lines.length)
    window = np.where(time < lines.length, np.clip(fall, 0, 1), np.clip(rise, 0, 1))
    window = np.sin(np.pi / 2 * window) ** 2
    # A harmonic of the frequency f was excited earlier than f was, by less than f over the sweep.
    quiet = (time > lines.length) & (time < (count / rate - before - lines.last / sweep))
    noise = np.abs(np.fft.rfft(impulse * quiet[:, None], axis=0)) ** 2 * (window**2).sum() / quiet.sum()
    wide = max(round(2.0 * count / rate), 1)  # 2 Hz
    noise = np.apply_along_axis(np.convolve, 0, noise, np.ones(wide) / wide, "same")
    rows = np.round(np.arange(lines.first, lines.last + lines.step / 2, lines.step) * count / rate).astype(int)
    response = np.fft.rfft(impulse * window[:, None], axis=0)
    return frequency[rows], response[rows], np.sqrt(noise[rows] / 2)


def tabulate(drive: np.ndarray, current: np.ndarray, accelerations: np.ndarray) -> pd.DataFrame:
    """The table of all signals, with the responses in A/V and m/s^2/V."""
    tables = []
    for lines in LINES:
        frequency, response, deviation = respond(drive, np.column_stack([current, accelerations]), lines)
        columns = {"frequency_hz": frequency}
        for name, values, spread in zip(("current", *CHANNELS), response.T, deviation.T, strict=True):
            columns |= {f"{name}_re": values.real, f"{name}_im": values.imag, f"{name}_deviation": spread}
        tables.append(pd.DataFrame(columns))
    return pd.concat(tables)


def main(arguments: list[str]) -> None:
    """Read both files and write the table."""
    folder, values = Path(arguments[0]), "y_values.values"
    names = [f"Signal_0.{values}(:,{i})" for i in range(1, 9)]
    signals = read_mat(folder / "Sweep_Time_Ausgang.mat", [*names, f"Signal_1.{values}"])
    current = read_mat(folder / "Sweep_Time_Anregung.mat", [f"Signal.{values}"])[f"Signal.{values}"]
    accelerations = np.column_stack([signals[name] for name in names])
    table = tabulate(signals[f"Signal_1.{values}"], current, accelerations)
    table.to_csv(arguments[1], index=False, float_format="%.5g")


if __name__ == "__main__":
    main(sys.argv[1:])
