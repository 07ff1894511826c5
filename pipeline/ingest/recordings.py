"""Time signals as they are stored: CSV, Excel, Parquet, NPZ, WAV, HDF5, TDMS or MAT, by the file's ending.

Legend: n samples.
"""

from __future__ import annotations

import struct
import warnings
from collections.abc import Callable, Iterable, Mapping, Sequence
from functools import partial
from pathlib import Path
from typing import Any, NamedTuple
from zipfile import ZipFile

import numpy as np

from pipeline.data.csv_format import CsvConfig
from pipeline.data.mat_files import (
    list_mat,
    open_measured,
    read_mat,
    require_lengths,
    require_names,
    require_room,
    require_unpacked,
    require_values,
)
from pipeline.data.tables import list_units, read_table
from pipeline.errors import DataError, nearest

Channels = dict[str, np.ndarray]
_SECONDS = {"s": 1.0, "ms": 1e-3, "us": 1e-6}


class Contents(NamedTuple):
    """What a file says that it has."""

    units: Mapping[str, str]  # by channel
    attributes: Sequence[str] = ()  # those that may hold the sample rate
    rated: bool = False  # its channels say their rate themselves
    mark: str = "\0"  # what parts a group's name from its channel's


def list_contents(path: Path) -> Contents:
    """The channels of a file, without reading what they hold. Raises DataError for a file that can't be opened."""
    if path.suffix.lower() not in _READERS:
        return Contents(list_units(path))
    _, kind, look = _READERS[path.suffix.lower()]
    with open_measured(path, kind):
        return look(path)


def read_recording(
    path: Path,
    names: Iterable[str],
    text: CsvConfig,
    time: str | None = None,
    unit: str | None = None,
    rate: float | None = None,
    attribute: str | None = None,
) -> tuple[np.ndarray, Channels]:
    """The times (n,) s, ascending, and the channels ``names`` of a file, (n,) each in its numbers.

    Numbers that single precision holds exactly may come in it. The time is the channel ``time`` in its ``unit``, or
    comes from a ``rate`` in Hz, or from that in an ``attribute`` (MAT: a variable), or in the file.

    Raises DataError: no such file or channel, a damaged or truncated file, no sample rate, NaN, channels of unequal
    length, times that do not ascend.
    """
    wanted = list(dict.fromkeys([*names, *([time] if time else [])]))
    ending, stated = path.suffix.lower(), None
    if ending in _READERS:
        read, kind, _ = _READERS[ending]
        with open_measured(path, kind):
            channels, stated = read(path, wanted, attribute)
    elif ending in (".csv", ".txt", ".xlsx", ".xlsm", ".parquet"):
        channels = read_table(path, dict.fromkeys(wanted, "number"), text=text)
    else:
        raise DataError(
            f"'{path}' must end in .csv, .txt, .xlsx, .parquet, .npz, .wav, .h5, .hdf5, .tdms or .mat, but it ends in "
            f"'{path.suffix}'"
        )
    count = check_channels(path, channels)
    # A long record in single precision, or of a converter's whole numbers, stays as short as it is.
    for name, values in channels.items():
        channels[name] = values.astype(np.float32 if np.can_cast(values.dtype, np.float32) else float, copy=False)
    if time:
        return check_times(path, time, channels[time].astype(float) * _SECONDS[unit or "s"]), channels
    if rate and stated and abs(rate / stated - 1) > 1e-6:
        raise DataError(
            f"'{path}' must have the sample rate of the configuration ({rate:g} Hz), but it says {stated:g} Hz: "
            "leave machine.recordings.sample_rate out"
        )
    rate = rate or stated
    if not rate:
        raise DataError(
            f"'{path}' must come with a sample rate, but it has none and the configuration neither: give "
            "machine.recordings.sample_rate (such as 5120 Hz), or machine.recordings.time, the channel with the times"
        )
    return np.arange(count) / rate, channels


def check_channels(path: Path, channels: Mapping[str, np.ndarray], too_large: float = 1e30) -> int:
    """How many samples all ``channels`` have. Raises DataError for unequal numbers of them, and NaN.

    No instrument writes a number that is ``too_large``.
    """
    for name, values in channels.items():
        if values.ndim != 1 or values.dtype.kind not in "iuf":
            raise DataError(
                f"'{path}' must have one row of numbers in '{name}', but it has {values.dtype} values of shape "
                f"{values.shape}: store each channel by itself"
            )
    require_lengths(path, "samples in every channel", channels)
    for name, values in channels.items():
        if values.size and max(-float(values.min()), float(values.max())) < too_large:
            continue
        bad = np.flatnonzero(~(np.abs(values) < too_large))
        if len(bad):
            raise DataError(
                f"'{path}' must have finite numbers, but channel '{name}' has {values[bad[0]]} at sample {bad[0] + 1} "
                f"({len(bad)} in all)"
            )
    count = len(next(iter(channels.values())))
    if count < 2:
        raise DataError(f"'{path}' must have samples, but its channels have {count}")
    return count


def check_times(path: Path, name: str, time: np.ndarray) -> np.ndarray:
    """The ``time`` (n,) s of the channel ``name``. Raises DataError where it does not ascend."""
    back = np.flatnonzero(np.diff(time) <= 0)
    if len(back):
        raise DataError(
            f"'{path}' must have ascending times in '{name}', but sample {back[0] + 2} is not after the "
            f"one before ({len(back)} in all): sort it, or write more digits, or give "
            "machine.recordings.sample_rate in its place"
        )
    return time


def _read_hdf5(path: Path, names: Sequence[str], attribute: str | None) -> tuple[Channels, float | None]:
    import h5py

    with h5py.File(path, "r") as file:
        every: list[str] = []
        file.visititems(lambda name, item: every.append(name) if isinstance(item, h5py.Dataset) else None)
        channels = {}
        for name in names:
            item = file.get(name.strip("/"))
            if not isinstance(item, h5py.Dataset):
                raise DataError(f"'{path}' must have the dataset '{name}', but it has not: {nearest(name, every)}")
            require_values(path, item)
            channels[name] = np.asarray(item[()])
        places = [file.get(name.strip("/")) for name in names] + [file]
        return channels, _read_rate(path, attribute, places)


def _list_hdf5(path: Path) -> Contents:
    import h5py

    with h5py.File(path, "r") as file:
        places: dict[str, Any] = {"": file}
        file.visititems(lambda name, item: places.update({name: item}))
        units = {
            name: " ".join(str(item.attrs[key]) for key in ("unit", "units") if key in item.attrs)
            for name, item in places.items()
            if isinstance(item, h5py.Dataset)
        }
        return Contents(units, [name for place in places.values() for name in place.attrs], mark="/")


def _read_rate(path: Path, attribute: str | None, places: Sequence[Any]) -> float | None:
    """Hz, of the first of ``places`` that has the attribute; their groups are asked too."""
    if not attribute:
        return None
    for place in [*places, *(place.parent for place in places)]:
        if attribute in place.attrs:
            return _to_rate(path, f"attribute '{attribute}'", np.asarray(place.attrs[attribute]))
    known = sorted({str(name) for place in places for name in place.attrs})
    raise DataError(
        f"'{path}' must have the attribute '{attribute}' at a channel, its group or the file, but it has "
        + (nearest(attribute, known) if known else "none")
    )


def _read_variables(
    load: Callable[[Path, Sequence[str]], Channels], path: Path, names: Sequence[str], rate: str | None
) -> tuple[Channels, float | None]:
    """Of files that keep the rate beside the channels, in a variable of that name."""
    every = load(path, [*names, *([rate] if rate else [])])
    stated = _to_rate(path, f"variable '{rate}'", every[rate]) if rate else None
    return {name: every[name] for name in names}, stated


def _to_rate(path: Path, where: str, stated: np.ndarray) -> float:
    if stated.size != 1 or stated.dtype.kind not in "iuf" or not 0 < float(stated.reshape(-1)[0]) < np.inf:
        raise DataError(f"'{path}' must have a rate in Hz in the {where}, but it has {stated.reshape(-1)[:3]}")
    return float(stated.reshape(-1)[0])


def _list_mat(path: Path) -> Contents:
    shapes = list_mat(path)
    columns = {
        f"{name}(:,{column})" if len(shape) == 2 and min(shape) > 1 else name: ""
        for name, shape in shapes.items()
        if not set(shape) <= {1}
        for column in range(1, 1 + (shape[1] if len(shape) == 2 and min(shape) > 1 else 1))
    }
    return Contents(columns, list(shapes.keys() - columns.keys()), mark=".")


def _read_tdms(path: Path, names: Sequence[str], attribute: str | None) -> tuple[Channels, float | None]:
    import logging

    from nptdms import TdmsFile
    from nptdms.log import log_manager

    log_manager.set_level(logging.ERROR)  # what it warns of is refused below
    with path.open("rb") as stream, TdmsFile.open(stream) as file:
        if file.file_status.incomplete_final_segment:
            raise DataError(f"'{path}' must be a complete TDMS file, but its last segment is cut: copy it again")
        every = {f"{group.name}/{channel.name}": channel for group in file.groups() for channel in group.channels()}
        channels, rates = {}, set()
        require_names(path, "channel", names, every)
        for name in names:
            require_room(path, 8 * len(every[name]))
            channels[name] = np.asarray(every[name][:], dtype=float)
            step = float(every[name].properties.get("wf_increment", 0.0))
            rates |= {1 / step} if step > 0 else set()
    if len(rates) > 1:
        text = ", ".join(f"{rate:g} Hz" for rate in sorted(rates))
        raise DataError(f"'{path}' must have channels of one sample rate, but it has {text}")
    return channels, next(iter(rates), None)


def _list_tdms(path: Path) -> Contents:
    from nptdms import TdmsFile

    with path.open("rb") as stream:
        channels = [channel for group in TdmsFile.read_metadata(stream).groups() for channel in group.channels()]
    units = {f"{c.group_name}/{c.name}": str(c.properties.get("unit_string", "")) for c in channels}
    return Contents(units, rated=any("wf_increment" in channel.properties for channel in channels), mark="/")


def _load_npz(path: Path, names: Sequence[str]) -> Channels:
    """Each array by itself: np.load would open objects, too, where it is asked to."""
    require_unpacked(path)
    require_names(path, "array", names, _list_npz(path).units)
    every = {}
    with ZipFile(path) as file:
        for name in names:
            with file.open(f"{name}.npy") as array:
                every[name] = np.lib.format.read_array(array)
    return every


def _list_npz(path: Path) -> Contents:
    with ZipFile(path) as file:
        names = [name.removesuffix(".npy") for name in file.namelist()]
    return Contents(dict.fromkeys(names, ""), names)


def _read_wav(path: Path, names: Sequence[str], attribute: str | None) -> tuple[Channels, float | None]:
    """Channels are called 1, 2, ..; full scale is one."""
    from scipy.io import wavfile

    # Opened here: of a damaged file SciPy leaves its own open.
    with path.open("rb") as file, warnings.catch_warnings():
        warnings.simplefilter("ignore", wavfile.WavFileWarning)  # of parts that hold no samples
        warnings.filterwarnings("error", "Reached EOF", wavfile.WavFileWarning)
        rate, samples = wavfile.read(file)
        file.seek(0)
        head = file.read(1 << 20)  # SciPy takes samples of other bytes where the two contradict each other
        form = ">HHIIHH" if head[:4] == b"RIFX" else "<HHIIHH"
        _, count, _, _, block, bits = struct.unpack_from(form, head, head.index(b"fmt ") + 8)
        if block != count * -(-bits // 8):
            raise ValueError(f"its blocks must have {bits} bits for each of {count} channels, but have {block} bytes")
        every = {str(i): column for i, column in enumerate(samples.reshape(len(samples), -1).T, 1)}
        require_names(path, "channel", names, every)
        middle, full = 0.0, 1.0
        if samples.dtype.kind != "f":
            limits = np.iinfo(samples.dtype)
            full = (limits.max - limits.min + 1) / 2
            middle = limits.min + full
        return {name: (every[name] - middle) / full for name in names or every}, float(rate)


_READERS: dict[
    str,
    tuple[Callable[[Path, Sequence[str], str | None], tuple[Channels, float | None]], str, Callable[[Path], Contents]],
] = {
    **dict.fromkeys((".h5", ".hdf5", ".hdf"), (_read_hdf5, "complete HDF5 file", _list_hdf5)),
    ".tdms": (_read_tdms, "complete TDMS file", _list_tdms),
    ".mat": (partial(_read_variables, read_mat), "complete MAT file", _list_mat),
    ".npz": (partial(_read_variables, _load_npz), "complete NumPy file (.npz)", _list_npz),
    ".wav": (
        _read_wav,
        "complete WAV file",
        lambda path: Contents(dict.fromkeys(_read_wav(path, (), None)[0], ""), rated=True),
    ),
}
"""By a file's ending: what gives the channels and the sample rate in Hz that the file states, what it reads, and what
says which channels there are."""
