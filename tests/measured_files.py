"""Measured data as other programs would write them, for the tests of stage=ingest: none of the package's code."""

from __future__ import annotations

import warnings
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd

METRE = {"um": 1e-6, "mm": 1e-3, "m": 1.0, "mil": 25.4e-6, "in": 25.4e-3}
TO_PEAK = {"zero_to_peak": 1.0, "peak_to_peak": 0.5, "rms": 2.0**0.5}
RPM_OF = {"rpm": 1.0, "Hz": 60.0, "rad/s": 30.0 / np.pi}
CONVENTIONS = {"length": "um", "amplitude": "peak_to_peak", "phase": "lag", "phase_unit": "deg", "speed": "rpm"}
PROBES = {"A": (0, 45.0), "B": (0, 135.0), "C": (2, 0.0), "D": (2, 90.0)}  # node, degrees from x towards y


@dataclass(frozen=True)
class Vectors:
    """What probes see, zero-to-peak in m, phase as of e^{jwt}."""

    rpm: np.ndarray  # (S,)
    of: Mapping[str, np.ndarray]  # probe -> (S,) complex


def vectors_of(
    rpm: np.ndarray, x: Callable[[int], np.ndarray], y: Callable[[int], np.ndarray], probes: Mapping[str, Any] = PROBES
) -> Vectors:
    """What probes see of the displacements x(node), y(node) (S,)."""
    seen = {
        name: x(node) * np.cos(np.radians(angle)) + y(node) * np.sin(np.radians(angle))
        for name, (node, angle) in probes.items()
    }
    return Vectors(rpm, seen)


def columns(vector: np.ndarray, said: Mapping[str, str]) -> tuple[np.ndarray, np.ndarray]:
    """Amplitude and phase as written in the conventions."""
    amplitude = np.abs(vector) / METRE[said["length"]] / TO_PEAK[said["amplitude"]]
    lead = np.angle(vector)
    phase = -lead if said["phase"] == "lag" else lead
    return amplitude, np.mod(np.degrees(phase), 360.0) if said["phase_unit"] == "deg" else phase


def wide(vectors: Vectors, said: Mapping[str, str] = CONVENTIONS) -> pd.DataFrame:
    """A row a speed."""
    table = {"speed": vectors.rpm / RPM_OF[said["speed"]]}
    for name, vector in vectors.of.items():
        table[f"{name} amp"], table[f"{name} ph"] = columns(vector, said)
    return pd.DataFrame(table)


def long(runs: Mapping[str, Vectors], said: Mapping[str, str] = CONVENTIONS) -> pd.DataFrame:
    """A row a run, probe and speed."""
    frames = []
    for run, vectors in runs.items():
        for name, vector in vectors.of.items():
            amplitude, phase = columns(vector, said)
            speed = vectors.rpm / RPM_OF[said["speed"]]
            frames.append(
                pd.DataFrame({"run": run, "speed": speed, "probe": name, "amplitude": amplitude, "phase": phase})
            )
    return pd.concat(frames, ignore_index=True)


def probes_config(probes: Mapping[str, Any] = PROBES, **more: Callable[[str], Any]) -> dict[str, Any]:
    """The section ``probes``; ``more`` makes further keys of a probe from its name."""
    return {
        name: {"node": node, "angle": f"{angle} deg"} | {key: make(name) for key, make in more.items()}
        for name, (node, angle) in probes.items()
    }


def table_config(runs: Sequence[Mapping[str, Any]], layout: str = "wide", **changes: Any) -> dict[str, Any]:
    """The section ``ingest`` for tables of this module."""
    pair = {"columns": lambda name: {"amplitude": f"{name} amp", "phase": f"{name} ph"}} if layout == "wide" else {}
    return {
        "format": "table",
        "layout": layout,
        "conventions": dict(CONVENTIONS),
        "columns": {"speed": "speed"},
        "probes": probes_config(**pair),
        "shaft_angle": "from_x",
        "runs": [dict(run) for run in runs],
    } | changes


def uff_set(
    x: np.ndarray, values: np.ndarray, node: int, direction: int, texts: Sequence[str] = (), **changes: Any
) -> dict[str, Any]:
    """A dataset 58 for pyuff."""
    return (
        {
            "type": 58,
            "binary": 0,
            "func_type": 1 if not np.iscomplexobj(values) else 0,
            "rsp_node": node,
            "rsp_dir": direction,
            "ref_node": 1,
            "ref_dir": 1,
            "x": x,
            "data": values,
            "abscissa_spacing": 0,
            "abscissa_spec_data_type": 19 if np.iscomplexobj(values) else 17,
            "ordinate_spec_data_type": 8,
            "orddenom_spec_data_type": 0,
        }
        | {f"id{i + 1}": text for i, text in enumerate(texts)}
        | changes
    )


def write_uff(path: Path, sets: Sequence[Mapping[str, Any]]) -> Path:
    """A universal file."""
    import pyuff

    path.unlink(missing_ok=True)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", ResourceWarning)  # of files that it leaves open
        pyuff.UFF(str(path)).write_sets([dict(one) for one in sets], mode="add")
    return path


def write_hdf5(path: Path, channels: Mapping[str, np.ndarray | None], rate: float | None = None, **how: Any) -> Path:
    """A dataset a channel, stored as ``how`` says, and the attribute ``fs`` at the file."""
    import h5py

    with h5py.File(path, "w") as file:
        for name, values in channels.items():
            file.create_dataset(name, data=values, **how)
        if rate is not None:
            file.attrs["fs"] = rate
    return path


def write_tdms(path: Path, channels: Mapping[str, np.ndarray], rate: float | None = None) -> Path:
    """A channel of the group ``run`` each, with the waveform property of LabVIEW."""
    from nptdms import ChannelObject, TdmsWriter

    properties = {} if rate is None else {"wf_increment": 1 / rate}
    with TdmsWriter(str(path)) as writer:
        writer.write_segment([ChannelObject("run", name, values, properties) for name, values in channels.items()])
    return path


def rotating(vector: np.ndarray, phi: np.ndarray) -> np.ndarray:
    """Re(V e^{j phi})."""
    return np.real(vector * np.exp(1j * phi))


def tacho_of(phi: np.ndarray, edge: float = 6.0) -> np.ndarray:
    """Volts: rises through its middle when phi is a multiple of a turn, over ``edge`` degrees."""
    turn = np.mod(phi / (2 * np.pi) + 0.5, 1.0) - 0.5
    width = edge / 360
    return 5.0 * (np.clip(0.5 + turn / width, 0, 1) - np.clip(0.5 + (turn - 0.2) / width, 0, 1))
