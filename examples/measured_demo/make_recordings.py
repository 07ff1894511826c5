"""Synthetic recordings as an engineer would hand them over, made straight from ROSS and nothing of this package.

    python examples/measured_demo/make_recordings.py

A rotor with two discs on two bearings runs up from 600 to 6000 rpm, four times: as it was found, with a trial weight on
the first disc, with one on the second, and with one on both (kept for the proof). Two proximity probes at 45 and 135
degrees beside each bearing, with runout and noise, and a tacho are sampled at 2.5 kHz and 0.1 mV (HDF5). The same runs
are also written as tables that a balancing instrument would print (mil peak-to-peak, phase lag, every 100 rpm).
"""

from __future__ import annotations

from pathlib import Path

import h5py
import numpy as np
import pandas as pd
import ross as rs
from scipy.interpolate import CubicSpline

HERE = Path(__file__).parent
SEED = 2026
RATE, DURATION = 2500.0, 20.0  # Hz, s
START, STOP = 550.0, 6050.0  # rpm
SENSITIVITY = 7.87e3  # V/m, that is 200 mV/mil
GAP = -9.0  # V
DIGITS = 4  # decimals of a volt that are kept
NOISE, HISS = 0.01, 5.0e-8  # of the 1X amplitude, and m, in each sample
RUNOUT = 1.0e-6  # m
BEARINGS = {
    1: {"kxx": 2.4e7, "kyy": 1.7e7, "cxx": 9.0e3, "cyy": 7.0e3},
    5: {"kxx": 2.0e7, "kyy": 1.4e7, "cxx": 8.0e3, "cyy": 6.0e3},
}
PROBES = {"DE_left": (1, 45.0), "DE_right": (1, 135.0), "NDE_left": (5, 45.0), "NDE_right": (5, 135.0)}
RESIDUAL = {2: (6.0e-5, 40.0), 4: (4.0e-5, 200.0)}  # node: kg m, degrees from the mark, with rotation
TRIALS = {
    "as_found": {},
    "first_disc": {2: (2.0e-4, 0.0)},
    "second_disc": {4: (2.0e-4, 90.0)},
    "both_discs": {2: (1.5e-4, 120.0), 4: (1.5e-4, 300.0)},
}


def machine() -> rs.Rotor:
    """The rotor, in SI."""
    steel = rs.Material("steel", rho=7810, E=211e9, G_s=81.2e9)
    shaft = [rs.ShaftElement(L=0.15, idl=0.0, odl=0.05, material=steel, shear_effects=True) for _ in range(6)]
    discs = [
        rs.DiskElement.from_geometry(n=node, material=steel, width=0.05, i_d=0.05, o_d=outer)
        for node, outer in ((2, 0.22), (4, 0.26))
    ]
    bearings = [rs.BearingElement(n=node, **values) for node, values in BEARINGS.items()]
    return rs.Rotor(shaft, discs, bearings)


def response(rotor: rs.Rotor, rpm: np.ndarray, unbalances: dict[int, tuple[float, float]]) -> dict[str, np.ndarray]:
    """Complex displacement (S,) along every probe at the steady speeds."""
    speeds = rpm * np.pi / 30
    nodes = list(unbalances)
    found = rotor.run_unbalance_response(
        nodes, [unbalances[n][0] for n in nodes], [np.radians(unbalances[n][1]) for n in nodes], frequency=speeds
    )
    per_node = rotor.number_dof
    seen = {}
    for name, (node, angle) in PROBES.items():
        x, y = found.forced_resp[per_node * node], found.forced_resp[per_node * node + 1]
        seen[name] = x * np.cos(np.radians(angle)) + y * np.sin(np.radians(angle))
    return seen


def recording(
    steady: dict[str, np.ndarray], rpm: np.ndarray, runout: dict[str, complex], generator: np.random.Generator
) -> dict[str, np.ndarray]:
    """Volts of every probe and of the tacho through a run-up that is slow beside the machine's transients."""
    time = np.arange(int(RATE * DURATION)) / RATE
    at = START + (STOP - START) * time / DURATION
    angle = np.pi / 30 * (START * time + (STOP - START) * time**2 / (2 * DURATION))
    signals = {}
    for name, vector in steady.items():
        amplitude = CubicSpline(rpm, vector)(at) + runout[name]
        moved = (amplitude * np.exp(1j * angle)).real
        moved += 0.05 * np.abs(amplitude) * np.cos(2 * angle + 1.0)  # a little 2X
        moved += np.hypot(NOISE * np.abs(amplitude), HISS) * generator.standard_normal(len(time))
        signals[name] = GAP + SENSITIVITY * moved + 0.2 * time / DURATION  # the gap drifts as the machine warms up
    turn = np.mod(angle + 0.1, 2 * np.pi)  # a keyway of 65 degrees, its leading edge at the mark
    rising = np.clip((turn - 0.075) / 0.05, 0, 1) * np.clip((1.2 - turn) / 0.05, 0, 1)  # half way up at the mark
    signals["tacho"] = 5.0 * rising
    return signals


def main() -> None:
    """Write recordings, table and rotor beside this file."""
    generator = np.random.default_rng(SEED)
    rotor = machine()
    rotor.save(HERE / "rotor.toml")
    none = {"kxy": 0.0, "kyx": 0.0, "cxy": 0.0, "cyx": 0.0}
    known = [{"bearing_node": node, "speed_rpm": speed} | none for node in BEARINGS for speed in (START, STOP)]
    pd.DataFrame(known).to_csv(HERE / "known_coefficients.csv", index=False)
    rpm = np.arange(START - 50, STOP + 51, 5.0)
    runout = {name: RUNOUT * np.exp(1j * generator.uniform(0, 2 * np.pi)) for name in PROBES}
    rows = []
    for run, trial in TRIALS.items():
        residual, added = response(rotor, rpm, RESIDUAL), response(rotor, rpm, trial) if trial else None
        steady = {name: residual[name] + (0 if added is None else added[name]) for name in PROBES}
        signals = recording(steady, rpm, runout, generator)
        with h5py.File(HERE / f"{run}.h5", "w") as file:
            for name, values in signals.items():
                kept = {"compression": "gzip", "compression_opts": 9, "shuffle": True, "scaleoffset": DIGITS}
                file.create_dataset(f"signals/{name}", data=values.astype(np.float32), **kept)
        for speed in np.arange(700.0, 5901.0, 100.0):
            row: dict[str, object] = {"run": run, "rpm": speed}
            for name in PROBES:
                value = steady[name][np.searchsorted(rpm, speed)] + runout[name]
                value *= 1 + NOISE / 10 * (generator.standard_normal() + 1j * generator.standard_normal())
                row[f"{name} mil pp"] = round(2 * abs(value) / 25.4e-6, 4)
                row[f"{name} deg lag"] = round(float(np.degrees(-np.angle(value))) % 360, 2)
            rows.append(row)
    for run in TRIALS:
        own = pd.DataFrame([row for row in rows if row["run"] == run]).drop(columns="run")
        own.to_csv(HERE / f"{run}.csv", index=False)


if __name__ == "__main__":
    main()
