"""Recordings in files of every kind: channels, rates and scales, and what does not fit."""

from __future__ import annotations

import struct
import zlib
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import scipy.io
from conftest import refused
from measured_files import write_hdf5, write_tdms
from reading import RUNS, read
from scipy.io import wavfile

from ingest.test_hostile_files import SIGNALS
from ingest.test_waveform import RATE, run_up, signal_config
from pipeline.data.csv_format import CsvConfig
from pipeline.ingest.recordings import read_recording

Change = Callable[[dict[str, np.ndarray]], dict[str, np.ndarray]]


BAD_SIGNALS: dict[str, tuple[Change, dict[str, Any], str]] = {
    "no such channel": (
        lambda c: {k: v for k, v in c.items() if k != "B"},
        {},
        "must have the dataset 'B', but it has",
    ),
    "no sample rate": (lambda c: c, {"sample_rate": None}, "must come with a sample rate, but it has none"),
    "no such attribute": (
        lambda c: c,
        {"sample_rate": None, "sample_rate_attribute": "rate"},
        "must have the attribute 'rate' at a channel, its group or the file, but it has none",
    ),
    "NaN": (lambda c: c | {"A": np.where(np.arange(len(c["A"])) == 7, np.nan, c["A"])}, {}, "'A' has nan at sample 8"),
    "unequal lengths": (lambda c: c | {"A": c["A"][:-1]}, {}, "must have as many samples in every channel"),
    "time that stands": (
        lambda c: c | {"time": np.round(c["time"], 3)},
        {"sample_rate": None, "time": "time", "time_unit": "s"},
        "must have ascending times in 'time'",
    ),
    "time that goes back": (
        lambda c: c | {"time": np.where(c["time"] > 1, c["time"] - 0.5, c["time"])},
        {"sample_rate": None, "time": "time", "time_unit": "s"},
        "is not after the one before (1 in all)",
    ),
    "no pulses": (lambda c: c | {"tacho": 0 * c["tacho"]}, {}, "must have tacho pulses, but the signal stays"),
    "too few pulses": (lambda c: {k: v[:1500] for k, v in c.items()}, {}, "must have at least 6 tacho pulses"),
    "the wrong channel": (lambda c: c | {"tacho": np.sin(np.arange(len(c["tacho"])) ** 1.7)}, {}, "evenly spaced"),
    "not the range": (
        lambda c: c,
        {"speeds": {"start_rpm": 3000, "stop_rpm": 3500, "step_rpm": 100}},
        "must cover machine.recordings.speeds (3000 to 3500 rpm) with windows of 8 revolutions, but it covers",
    ),
    "a speed that changes": (lambda c: c, {"records": "constant_speed"}, "must have a constant speed (to 1 %)"),
    "a table in a channel": (
        lambda c: c | {"A": np.stack([c["A"], c["A"]])},
        {},
        "must have one row of numbers in 'A'",
    ),
    "nothing": (lambda c: {k: v[:0] for k, v in c.items()}, {}, "must have samples, but its channels have 0"),
}


@pytest.mark.parametrize("case", BAD_SIGNALS)
def test_a_recording_that_does_not_fit(case: str, tmp_path: Path) -> None:
    change, changes, words = BAD_SIGNALS[case]
    path = write_hdf5(tmp_path / "one.h5", change(run_up(0.0)))
    with refused(words, "one.h5"):
        read(signal_config("", [RUNS[0] | {"file": str(path)}], **changes))


def test_a_file_that_says_another_rate(tmp_path: Path) -> None:
    path = write_tdms(tmp_path / "one.tdms", run_up(0.0), RATE)
    with refused("must have the sample rate of the configuration (5000 Hz), but it says 4000 Hz"):
        read(signal_config("run/", [RUNS[0] | {"file": str(path)}], sample_rate="5 kHz"))


def test_a_file_of_an_unknown_kind(tmp_path: Path) -> None:
    (tmp_path / "one.mp3").write_bytes(b"x")
    with refused(
        "must end in .csv, .txt, .xlsx, .parquet, .npz, .wav, .h5, .hdf5, .tdms or .mat, but it ends in '.mp3'"
    ):
        read(signal_config("", [RUNS[0] | {"file": str(tmp_path / "one.mp3")}]))


@pytest.mark.parametrize("kind", ["int16", "int32", "uint8", "float32"])
def test_full_scale_of_a_wav_file_is_one(kind: str, tmp_path: Path) -> None:
    signals = np.linspace(-0.9, 0.9, 50)[:, None] * [1.0, -0.5]
    full, middle = {"int16": (32767, 0), "int32": (2147483647, 0), "uint8": (127, 128), "float32": (1, 0)}[kind]
    wavfile.write(tmp_path / "a.wav", 5120, (signals * full + middle).astype(kind))
    time, channels = read_recording(tmp_path / "a.wav", ["2", "1"], CsvConfig())
    assert time[1] == 1 / 5120
    np.testing.assert_allclose(np.stack([channels["1"], channels["2"]], axis=1), signals, atol=0.02)
    with refused("must have the channel '3'"):
        read_recording(tmp_path / "a.wav", ["3"], CsvConfig())


@pytest.mark.slow
def test_a_variable_that_nobody_asks_for_is_not_unpacked(tmp_path: Path) -> None:
    """1.6 GB of zeros in 2 MB, before what is asked for; themselves they are refused."""
    path, packed = tmp_path / "a.mat", zlib.compressobj()
    scipy.io.savemat(path, SIGNALS)
    size = 1600 * 10**6
    head = struct.pack("<14i", 14, 48 + size, 6, 8, 6, 0, 5, 8, 1, size // 8, 1 | 1 << 16, ord("z"), 9, size)
    begin, block = ((packed.compress(part) + packed.flush(zlib.Z_FULL_FLUSH)) for part in (head, bytes(10**6)))
    whole_file, bomb = path.read_bytes(), begin + 1600 * block
    path.write_bytes(whole_file[:128] + struct.pack("<2i", 15, len(bomb)) + bomb + whole_file[128:])
    assert np.array_equal(read_recording(path, ["a"], CsvConfig(), rate=1.0)[1]["a"], SIGNALS["a"])
    with refused("a.mat", "MemoryError"):
        read_recording(path, ["z"], CsvConfig(), rate=1.0)
