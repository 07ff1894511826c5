"""A person's typical mistakes: each gives a warning or an error that names its cause.

The machine has two rolling bearings, two discs, two probes beside each bearing and three runs of trial weights. Each
case changes the readings or the setting as the mistake would, and asks what is said.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from conftest import assert_says, refused
from measured_files import CONVENTIONS, long, table_config
from reading import RUNS, read, seen

from pipeline.coefficients import COEFFICIENTS
from pipeline.data.dataset import Excitation, VibrationDataset
from pipeline.data.sensors import NoiseModel, Sensors, measure
from pipeline.data.simulate import simulate
from pipeline.errors import PipelineError
from pipeline.ingest.plausibility import note_clipping, note_size
from pipeline.problem.measurement import Guess, Measurement
from pipeline.rotor.bearing_table import BearingTable
from pipeline.rotor.model import RotorModel
from pipeline.trust.mistakes import find_mistakes
from pipeline.unknowns import tie, unknown_set

pytestmark = pytest.mark.slow  # half a second to two seconds each

NODES = (1, 5)
PROBES = ((1, 45.0), (1, 135.0), (5, 45.0), (5, 135.0))
UNKNOWNS = ("kxx", "kyy", "cxx", "cyy")
MIL, G_MM = 25.4, 1e-6
NOISE = NoiseModel(0.05e-6, 0.005)
WEIGHTS = (
    Excitation("first", "unbalance", 2, 200 * G_MM, 0.0),
    Excitation("second", "unbalance", 4, 200 * G_MM, np.pi / 2),
    Excitation("both", "unbalance", 2, 150 * G_MM, np.radians(120)),
    Excitation("both", "unbalance", 4, 150 * G_MM, np.radians(300)),
)


@cache
def rotor() -> RotorModel:
    from pipeline.config.compose import compose_config
    from pipeline.rotor.stored import load_rotor

    return load_rotor(compose_config(["experiment=measured_demo"]).machine.rotor)


@cache
def truth() -> Measurement:
    """What was measured, and how it is stated, without a mistake."""
    speeds = np.arange(1600.0, 5800.0, 200.0) * np.pi / 30
    values = np.zeros((2, len(speeds), 8))
    for b, own in enumerate(((1.2e7, 1.6e7, 6e3, 8e3), (1.5e7, 2.2e7, 9e3, 7e3))):
        for name, value in zip(UNKNOWNS, own, strict=True):
            values[b, :, COEFFICIENTS.index(name)] = value
    bearings = BearingTable(NODES, speeds, values)
    probes = measure(simulate(rotor(), bearings, WEIGHTS), Sensors(PROBES, NOISE), np.random.default_rng(4))
    unknowns = unknown_set(dict.fromkeys(NODES, tie(UNKNOWNS)))
    return Measurement(rotor(), probes, bearings, NOISE, unknowns, Guess(1e7, 5e3))


def readings(change: Callable[[np.ndarray], np.ndarray]) -> Measurement:
    data = truth().dataset
    return replace(truth(), dataset=replace(data, displacement=change(data.displacement)))


def of_probe(probe: int, change: Callable[[np.ndarray], np.ndarray]) -> Measurement:
    """Other readings of one probe."""
    return readings(lambda all_of: np.where((np.arange(4) == probe)[:, None], change(all_of), all_of))


def stated(i: int, **changes: Any) -> Measurement:
    """A weight that is stated otherwise than it was."""
    acting = tuple(replace(one, **changes) if j == i else one for j, one in enumerate(WEIGHTS))
    return replace(truth(), dataset=replace(truth().dataset, excitations=acting))


def other_rotor(stiffness: float) -> Measurement:
    """The file of a rotor whose shaft is of another steel, or thinner."""
    return replace(truth(), rotor=replace(rotor(), stiffness=stiffness * rotor().stiffness))


def mirrored(data: VibrationDataset) -> VibrationDataset:
    return replace(data, channels=tuple((node, -angle % 360) for node, angle in data.channels))


@dataclass(frozen=True)
class Case:
    """What was done, and the words that name it."""

    made: Callable[[], Measurement]
    said: str
    first: bool = True  # False: another mistake looks the same in the readings


def own_unbalance(times: float) -> Measurement:
    """The machine's own unbalance in every run."""
    return readings(lambda all_of: all_of + times * of_unbalance())


@cache
def of_unbalance() -> np.ndarray:
    complete = simulate(rotor(), truth().known, (Excitation("own", "unbalance", 4, 120 * G_MM, 0.7),))
    return measure(complete, Sensors(PROBES), np.random.default_rng(0)).displacement


CASES: dict[str, Case] = {
    "um for mil": Case(lambda: readings(lambda q: q / MIL), "25.4 times too small: mil taken for um"),
    "mil for um": Case(lambda: readings(lambda q: q * MIL), "25.4 times too large: um taken for mil"),
    "peak-to-peak for zero-to-peak": Case(lambda: readings(lambda q: 2 * q), "peak-to-peak amplitudes taken for zero"),
    "zero-to-peak for rms": Case(lambda: readings(lambda q: q / 2**0.5), "rms amplitudes taken for zero-to-peak"),
    "lag for lead": Case(lambda: readings(np.conj), "all readings have the wrong sign (lag for lead"),
    "lag for lead in one run": Case(
        lambda: readings(lambda q: np.where(np.arange(3) == 1, np.conj(q), q)),
        "phases of run 'second' have the wrong sign",
    ),
    "the tacho at the other edge": Case(lambda: readings(lambda q: q * np.exp(0.35j)), "turned by 20 deg"),
    "the tacho opposite": Case(lambda: readings(lambda q: -q), "turned by 180 deg: the tacho at the other edge"),
    "two probes of a bearing exchanged": Case(
        lambda: readings(lambda q: q[:, [1, 0, 2, 3]]), "probes 'node 1 45' and 'node 1 135' are exchanged"
    ),
    "the probes of the bearings exchanged": Case(
        lambda: readings(lambda q: q[:, [2, 3, 0, 1]]), "the probes of node 1 and those of node 5 are exchanged"
    ),
    "a probe with the wrong sign": Case(lambda: of_probe(2, np.negative), "probe 'node 5 45' has the wrong sign"),
    "the scale of another channel": Case(
        lambda: of_probe(3, lambda q: q * 1.27), "readings of probe 'node 5 135' are not as stated (1.27 times"
    ),
    "a dead channel": Case(lambda: of_probe(0, lambda q: q * 1e-3), "probe 'node 1 45'"),
    "angles of the probes against the rotation": Case(
        lambda: replace(truth(), dataset=mirrored(truth().dataset)), "the angles of all probes have the wrong sign"
    ),
    "the weight in the other plane": Case(lambda: stated(0, node=4), "run 'first' at node 4 is at node 2"),
    "the weight at another angle": Case(
        lambda: stated(1, phase=np.pi), "the weight of run 'second' is 270 deg from its stated angle"
    ),
    "the angle of a weight against the rotation": Case(
        lambda: stated(3, phase=-WEIGHTS[3].phase), "run 'both' at node 4 has the wrong sign of its angle"
    ),
    "a weight of another mass": Case(
        lambda: stated(0, magnitude=160 * G_MM), "run 'first' is not as stated (1.25 times as large"
    ),
    "runs exchanged": Case(
        lambda: readings(lambda q: q[..., [1, 0, 2]]), "recordings of runs 'first' and 'second' are exchanged"
    ),
    "the rotor of another steel": Case(
        lambda: other_rotor(1 / 1.05), "Young's modulus (or its diameters) is 5 % larger"
    ),
    "another rotor": Case(lambda: other_rotor(1 / 1.2), "Young's modulus (or its diameters) is 20 % larger"),
    "no baseline subtracted": Case(lambda: own_unbalance(1.0), "own unbalance is in the readings: the baseline is not"),
    "the baseline subtracted twice": Case(lambda: own_unbalance(-1.0), "or it is twice"),
    "runout left in": Case(
        lambda: readings(lambda q: q + 8e-6 * np.exp(1j * np.arange(4))[:, None]), "the same at all speeds", first=False
    ),
}


def said_of(measurement: Measurement) -> list[str]:
    """What is said of the readings after a fit; the start is the guess alone."""
    sizes = measurement.guess.sizes(measurement.unknowns)
    values = np.repeat(sizes[:, None], len(measurement.dataset.speeds), axis=1)
    return [one.sentence for one in find_mistakes(measurement, values, constant=True)]


def test_nothing_is_said_of_a_right_measurement() -> None:
    assert said_of(truth()) == []


# What another case has in the other sense, by less, or of another size: found by the same fit.
ALIKE = (
    *("um for mil", "mil for um", "zero-to-peak for rms", "the tacho opposite", "another rotor"),
    *("the baseline subtracted twice", "a dead channel", "the weight at another angle", "lag for lead in one run"),
)


@pytest.mark.parametrize("name", [pytest.param(name, marks=[pytest.mark.nightly] * (name in ALIKE)) for name in CASES])
def test_a_mistake_is_named(name: str) -> None:
    said = said_of(CASES[name].made())
    assert any(CASES[name].said in line for line in (said[:1] if CASES[name].first else said)), said


# --- what is seen before any fit ------------------------------------------------------------------------


def test_speeds_in_hz_called_rpm(tmp_path: Path) -> None:
    """25 to 100 Hz as 25 to 100 rpm: the weights push 3600 times less, so the readings are far too large."""
    (said,) = note_size(replace(truth().dataset, speeds=truth().dataset.speeds / 60), rotor(), 1e7, 5e3)
    assert "times larger than the rotor's" in said


def test_a_run_that_is_missing(tmp_path: Path) -> None:
    long({"one": seen()}, CONVENTIONS).to_csv(tmp_path / "all.csv", index=False)
    config = table_config([RUNS[0], RUNS[0] | {"name": "two"}], layout="long", file=str(tmp_path / "all.csv"))
    with refused("two", kind=PipelineError):
        read(config)


def test_a_clipped_signal_is_named_when_it_is_read() -> None:
    time = np.arange(5000) / 5000
    sine = np.round(np.sin(2 * np.pi * 50 * time) * 2000) / 2000 + 0.01 * np.random.default_rng(0).standard_normal(5000)
    (said,) = note_clipping("'a.h5'", {"left": np.clip(sine, -0.8, 0.8), "right": sine})
    assert_says(said, "probe 'left'", "clipped")
