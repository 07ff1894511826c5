"""Velocities, accelerations and voltages: the displacement comes back, and what does not fit is named."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import pytest
from conftest import examples, refused
from hypothesis import given
from hypothesis import strategies as st
from measured_files import (
    CONVENTIONS,
    PAIR,
    TO_PEAK,
    Vectors,
    long,
    probes_config,
    table_config,
    write_hdf5,
)
from reading import (
    GRID,
    RPM,
    RUNS,
    TURNS,
    check_read,
    check_steady,
    long_table,
    read,
    seen,
    steady,
    with_ingest,
)

from pipeline.config.motion import find_motion, to_motion
from pipeline.errors import ConfigError

UNITS = {  # of SI; in/s and mil/s by the inch, g by the standard acceleration
    "velocity": {"mm/s": 1e-3, "m/s": 1.0, "in/s": 0.0254, "ips": 0.0254, "um/s": 1e-6},
    "acceleration": {"g": 9.80665, "m/s^2": 1.0, "m/s2": 1.0, "mm/s²": 1e-3},
}
ON = {"mounted": lambda name: "casing"}


def said(kind: str, unit: str, **changes: Any) -> dict[str, Any]:
    """Conventions with another unit of the amplitudes."""
    return {key: value for key, value in CONVENTIONS.items() if key != "length"} | {kind: unit} | changes


def moved(order: int, size: float, ratio: float = 1.0, amplitude: str = "zero_to_peak") -> pd.DataFrame:
    """A long table of what the probes of both runs see, by the derivative of the order, in units of ``size``."""
    slope = (1j * ratio * GRID * RPM) ** order / size
    runs = {run: Vectors(GRID, {name: of * slope for name, of in seen(turn).of.items()}) for run, turn in TURNS.items()}
    return long(runs, CONVENTIONS | {"length": "m", "amplitude": amplitude})


@pytest.mark.slow
@examples(30)
@given(
    st.sampled_from([(kind, unit, size) for kind, sizes in UNITS.items() for unit, size in sizes.items()]),
    st.sampled_from(sorted(TO_PEAK)),
    st.sampled_from([None, 0.5, 1.7]),
)
def test_the_velocity_of_a_known_displacement_gives_it_back(
    tmp_path_factory: pytest.TempPathFactory, unit: tuple[str, str, float], amplitude: str, ratio: float | None
) -> None:
    """Accelerations, too, in any unit, and of forces with a frequency of their own."""
    kind, name, size = unit
    force = [{"node": 1, "magnitude": "1 N", "phase": "0 deg", "whirl": "forward"}]
    section = long_table(
        tmp_path_factory.mktemp("motion"),
        moved(["length", "velocity", "acceleration"].index(kind), size, ratio or 1.0, amplitude),
        [{"name": run["name"], "forces": force, "frequency_ratio": ratio} for run in RUNS] if ratio else RUNS,
        conventions=said(kind, name, amplitude=amplitude),
        probes=probes_config(**ON),
    )
    check_read(read(section), 1e-12)


@pytest.mark.parametrize(
    ("scale", "order", "volts"),  # V s^k/m
    [
        ("7.87 V/mm", 0, 7870.0),
        ("200 mV/mil", 0, 0.2 / 25.4e-6),
        ("4 mV/(mm/s)", 1, 4.0),
        ("100 mV/g", 2, 0.1 / 9.80665),
    ],
)
def test_a_table_of_voltages(scale: str, order: int, volts: float, tmp_path: Path) -> None:
    """By the sensitivity of each probe; in mV."""
    section = long_table(
        tmp_path,
        moved(order, 1e-3 / volts),
        conventions=said("voltage", "mV", amplitude="zero_to_peak"),
        probes=probes_config(scale=lambda name: scale, **(ON if order else {})),
    )
    check_read(read(section))


def test_time_signals_of_velocity(tmp_path: Path) -> None:
    """At constant speed the derivative of Re(V e^{jwt}) is Re(j w V e^{jwt}); in um/s, and in volts."""
    section = steady(
        lambda name, channels: write_hdf5(tmp_path / f"{name}.h5", channels),
        1,
        signal_unit="um/s",
        probes=probes_config(channel=lambda name: name, **ON),
    )
    volts = probes_config(channel=lambda name: name, scale=lambda name: "1 V/(um/s)", **ON)
    again = read(section | {"signal_unit": "V", "probes": volts})
    assert np.allclose(again.displacement, check_steady(section).displacement, rtol=1e-12, atol=0)


WRONG: dict[str, tuple[dict[str, Any], str]] = {
    "a velocity for a length": (
        {"conventions": CONVENTIONS | {"length": "mm/s"}},
        "conventions.length: must be a unit of m (such as um, mil or mm), but got 'mm/s': give velocity: mm/s in its",
    ),
    "a length for a velocity": (
        {"conventions": said("velocity", "um")},
        "conventions.velocity: must be a unit of m / s (such as mm/s or in/s), but got 'um': give length: um in its",
    ),
    "a mass for an acceleration": (
        {"conventions": said("acceleration", "kg")},
        "conventions.acceleration: must be a unit of m / s**2 (such as g or m/s^2), but got 'kg'",
    ),
    "two units": (
        {"conventions": CONVENTIONS | {"velocity": "mm/s"}},
        "conventions.length: must be the one unit of the amplitudes, but got length and velocity: leave out all but",
    ),
    "no sensitivity": ({"conventions": said("voltage", "mV")}, "probe 'A' must have a scale"),
    "a sensitivity of millimetres": (
        {"probes": probes_config(scale=lambda name: "8 V/mm", **PAIR)},
        "probe 'A' must have no scale where signals are in um, but it has 8 V/mm",
    ),
    "a sensitivity of something else": (
        {"conventions": said("voltage", "mV"), "probes": probes_config(scale=lambda name: "8 V/N", **PAIR)},
        "probes.A.scale: must be a voltage per length, velocity or acceleration",
    ),
    "shaft or casing": (
        {"conventions": said("velocity", "mm/s")},
        "probe 'A' must say what it moves with where it measures velocities, but it has no 'mounted': give",
    ),
    "accelerations of the shaft relative to its casing": (
        {
            "conventions": said("acceleration", "g"),
            "probes": probes_config(measures=lambda name: "shaft relative to casing", **ON, **PAIR),
        },
        "probe 'A' must measure displacements where it measures the shaft relative to casing, but accelerations are",
    ),
    "a casing by what moves with the shaft": (
        {
            "conventions": said("velocity", "mm/s"),
            "probes": probes_config(measures=lambda name: "casing", mounted=lambda name: "shaft", **PAIR),
        },
        "probe 'A' must move with the casing where it measures the casing, but has mounted: shaft",
    ),
    "displacements of a casing": (
        {"probes": probes_config(**ON, **PAIR)},
        "probe 'A' must measure velocities or accelerations where it has mounted: casing",
    ),
}


@pytest.mark.parametrize("case", WRONG)
def test_units_that_do_not_fit_are_named(case: str) -> None:
    changes, words = WRONG[case]
    with refused(words, "machine.recordings", kind=ConfigError):
        with_ingest(table_config([RUNS[0] | {"file": "a.csv"}], **changes))


def test_the_gram_is_no_unit_here() -> None:
    assert find_motion("g") == (2, 9.80665)
    assert find_motion("kg") is None
    assert to_motion("mV", "100 mV/g") == (2, pytest.approx(9.80665e-2))
