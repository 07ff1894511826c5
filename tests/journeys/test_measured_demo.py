"""From recordings to the twin: `measured_demo` against the machine that its recordings were made of. Slow."""

from __future__ import annotations

import importlib.util
import json
from pathlib import Path
from types import ModuleType

import numpy as np
import pandas as pd
import pytest
from conftest import DATA, Artifacts, Run, pictures_left_out, refused

from pipeline.errors import ConfigError

pytestmark = pytest.mark.slow

EXAMPLE = Path(__file__).parents[2] / "examples" / "measured_demo"


@pytest.fixture(scope="module")
def recordings() -> ModuleType:
    """The script that made the recordings, which alone knows the machine."""
    spec = importlib.util.spec_from_file_location("make_recordings", EXAMPLE / "make_recordings.py")
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


@pytest.fixture(scope="module", params=["recordings", "tables"])
def folder(
    request: pytest.FixtureRequest, artifacts: Artifacts, run: Run, tmp_path_factory: pytest.TempPathFactory
) -> Path:
    """What the graph made of the recordings; and of the tables of a balancing instrument (mil peak-to-peak)."""
    if request.param == "recordings":
        return artifacts("measured_demo", "identified_coefficients.csv", "metrics.json", "prediction.json")
    made = tmp_path_factory.mktemp(request.param)
    with pictures_left_out():
        for stage in ("ingest", "train", "evaluate", "predict"):
            run(stage, ["experiment=measured_demo", "machine=measured_demo_table"], made)
    return made


def test_the_truth_is_what_the_recordings_were_made_of(folder: Path, recordings: ModuleType) -> None:
    """The script says it by itself; the stage read it from the saved rotor."""
    modelled = pd.read_csv(folder / "modelled_coefficients.csv")
    for node, truth in recordings.BEARINGS.items():
        own = modelled[modelled["bearing_node"] == node]
        for name, value in truth.items():
            np.testing.assert_allclose(own[name], value, rtol=1e-12)


def test_stiffness_and_damping_are_found(folder: Path) -> None:
    """Measured: at most 0.025 % and 0.48 % from the recordings."""
    for node, of in json.loads((folder / "metrics.json").read_text())["coefficients"].items():
        for name, error in of.items():
            print(f"node {node} {name}: {error['median_error_percent']:.3f} %")
            assert error["median_error_percent"] < (0.12 if name.startswith("k") else 1.2)


@pytest.mark.usefixtures("no_pictures")
def test_a_plane_and_speeds_that_no_run_had(run: Run, artifacts: Artifacts, tmp_path: Path) -> None:
    """By a model of one disc's run alone: 0.31 % where superposition has no answer, 0.31 % at the critical speed, where
    interpolation is 21 % off.
    """
    held = ["training.holdout_runs=[second_disc,both_discs]", "training.holdout_range=[5000 rpm,5600 rpm]"]
    run("evaluate", ["experiment=measured_demo", *held], artifacts.copied("measured_demo", DATA, tmp_path))
    found = json.loads((tmp_path / "metrics.json").read_text())["held_out"]
    assert found["run second_disc"]["rival_error_percent"] is None
    assert found["run second_disc"]["model_error_percent"] < 0.6
    together = found["range of speeds, 5000 to 5600 rpm"]
    assert together["model_error_percent"] < 0.6
    assert together["rival_error_percent"] > 20 * together["model_error_percent"]


def test_the_run_that_was_not_fitted_is_predicted(folder: Path) -> None:
    """Measured: 0.38 % at the probes."""
    assert json.loads((folder / "metrics.json").read_text())["fit"]["held_out_runs"]["error_percent"] < 1


def test_coefficients_that_run_off_are_named(run: Run, tmp_path: Path) -> None:
    """A lag that is called a lead: no bearing makes such readings."""
    wrong = ["experiment=measured_demo", "machine=measured_demo_table", "machine.recordings.conventions.phase=lead"]
    with refused("ran off to zero", kind=ConfigError):
        run("train", wrong, tmp_path)
