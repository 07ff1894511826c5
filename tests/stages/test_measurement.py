"""The measurement of a stage: own files at several operating states, as a fit and as the library read them."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from conftest import refused
from running import composed

from pipeline.data.coefficient_files import write_coefficients
from pipeline.data.excitation_files import write_excitation
from pipeline.data.sensors import NoiseModel
from pipeline.data.vibration_files import write_vibration
from pipeline.problem.configured import model_machine
from pipeline.problem.measurement import Guess, Measurement
from pipeline.stages.measurement import load_measurement

pytestmark = pytest.mark.slow
STATES = "machine.operating={oil_temperature: [65 degC, 45 degC], load: [500 N, 700 N]}"
RUNS = "machine.runs=[{name: a, forces: [{node: 1, magnitude: 1 N}]}, {name: b, forces: [{node: 0, magnitude: 1 N}]}]"
BASE = ("experiment=ball_bearing", "tracking=none", RUNS)
"""At the speeds of the experiment, whose bearings are kept: a new speed would need ROSS, which takes seconds."""


@pytest.fixture(scope="module")
def own(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Files of the user's own, in which one run lacks a state."""
    folder = tmp_path_factory.mktemp("own")
    _, bearings, made = model_machine(composed(*BASE, STATES))
    present = np.ones((len(made.speeds), len(made.runs)), dtype=bool)
    present[made.operating["load"] == 700.0, 0] = False
    some = np.flatnonzero(np.arange(len(made.speeds)) % (len(made.speeds) // 4) % 50 == 0)
    made = replace(made, present=present, displacement=made.displacement * present[:, None]).at(some)
    write_vibration(folder / "vibration.parquet", made)
    write_excitation(folder / "excitation.csv", made)
    write_coefficients(folder / "known.csv", bearings.at(some))
    return folder


def test_a_fit_reads_points_runs_and_known_coefficients_of_own_files(own: Path) -> None:
    files = [f"data.{name}={own / file}" for name, file in (("vibration", "vibration.parquet"), ("known", "known.csv"))]
    found = load_measurement(composed(*BASE, *files, f"data.excitation={own / 'excitation.csv'}"))
    assert (found.dataset.complete, found.known.operating.keys()) == (False, {"oil_temperature", "load"})
    absent = ~found.dataset.present[:, 0]
    assert (found.dataset.operating["load"][absent] == 700.0).all()
    assert np.isinf(found.deviation[absent, :, 0]).all()
    assert np.isfinite(found.deviation[~absent]).all()
    joined = composed(*BASE, *files, f"data.excitation={own / 'excitation.csv'}", "data.same_conditions={load: 200 N}")
    with refused("must have one row a run, speed, operating conditions, node and direction"):
        load_measurement(joined)


def test_the_library_reads_the_same(own: Path) -> None:
    found = Measurement.read(
        Path("examples/measured_demo/rotor.toml"),
        own / "vibration.parquet",
        own / "excitation.csv",
        unknowns=("kxx", "kxy", "kyx", "kyy", "cxx", "cxy", "cyx", "cyy"),
        noise=NoiseModel(1e-7, 0.01),
        guess=Guess(1e7, 1e4),
    )
    assert set(found.known.operating) == {"oil_temperature", "load"}
