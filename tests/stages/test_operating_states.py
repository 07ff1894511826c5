"""Simulated machines at several operating states, and the files that a fit reads of them."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from conftest import refused
from running import composed
from small_rotor import small_machine

from pipeline.data.coefficient_files import write_coefficients
from pipeline.data.excitation_files import write_excitation
from pipeline.data.sensors import NoiseModel
from pipeline.data.vibration_files import write_vibration
from pipeline.errors import ConfigError
from pipeline.problem.configured import find_idle, model_machine
from pipeline.problem.measurement import Guess, Measurement
from pipeline.rotor.bearing_table import BearingTable
from pipeline.stages.analysis import hash_machine
from pipeline.stages.before_fit import list_idle
from pipeline.stages.measurement import load_measurement

pytestmark = pytest.mark.slow
STATES = "machine.operating={oil_temperature: [65 degC, 45 degC], load: [500 N, 700 N]}"
RUNS = "machine.runs=[{name: a, forces: [{node: 1, magnitude: 1 N}]}, {name: b, forces: [{node: 0, magnitude: 1 N}]}]"
BASE = ("experiment=ball_bearing", "tracking=none", RUNS)
"""At the speeds of the experiment, whose bearings are kept: a new speed would need ROSS, which takes seconds."""


def test_every_speed_and_run_is_made_at_every_combination_of_the_conditions() -> None:
    _, _, plain = model_machine(composed(*BASE))
    _, bearings, found = model_machine(composed(*BASE, STATES))
    count = len(plain.speeds)
    assert len(found.speeds) == 4 * count
    assert found.operating["oil_temperature"].tolist() == [318.15] * 2 * count + [338.15] * 2 * count
    assert found.operating["load"].tolist() == 2 * ([500.0] * count + [700.0] * count)
    assert bearings.operating == found.operating
    np.testing.assert_array_equal(found.displacement, np.tile(plain.displacement, (4, 1, 1)))


def test_a_condition_that_changes_no_bearing_is_named() -> None:
    """Balls follow neither; a film follows what it is told to."""
    at = dict(zip(("load", "oil_temperature"), np.meshgrid([5.0, 7.0], [310.0, 320.0]), strict=True))
    operating = {name: values.ravel() for name, values in at.items()}
    same = BearingTable((0,), np.full(4, 100.0), np.ones((1, 4, 8)), operating)
    assert find_idle(same) == ["load", "oil_temperature"]
    assert find_idle(replace(same, values=same.values * operating["oil_temperature"][:, None])) == ["load"]


def test_a_condition_that_the_model_has_no_input_for_is_named() -> None:
    measurement, _ = small_machine((2e6, 0.0, 0.0, 1.2e6, 900.0, 0.0, 0.0, 600.0))
    count = len(measurement.dataset.speeds)
    operating = {"oil_temperature": np.linspace(310.0, 330.0, count), "load": np.full(count, 500.0)}
    warm = replace(measurement, dataset=replace(measurement.dataset, operating=operating))
    assert (list_idle("constant", warm), list_idle("network", warm)) == (["oil_temperature"], [])


def test_a_machine_without_conditions_is_the_machine_that_it_was() -> None:
    assert hash_machine(composed(*BASE)) == hash_machine(composed(*BASE, "machine.operating=null"))
    assert hash_machine(composed(*BASE)) != hash_machine(composed(*BASE, STATES))


@pytest.mark.parametrize(
    ("key", "given", "words"),
    [
        ("machine.operating", "[45]", "oil_temperature must carry its unit"),
        ("data.same_conditions", "5 N", "(such as 0.5 K)"),
    ],
)
def test_what_is_no_condition_is_named_with_its_key(key: str, given: str, words: str) -> None:
    with refused(f"{key}: ", words, kind=ConfigError):
        composed(*BASE, f"{key}={{oil_temperature: {given}}}")


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
