"""From recordings to the twin: `measured_demo` against the machine that its recordings were made of. Slow."""

from __future__ import annotations

import importlib.util
import json
from pathlib import Path
from types import ModuleType

import numpy as np
import pandas as pd
import pytest
from conftest import Artifacts, Run

pytestmark = pytest.mark.slow

EXAMPLE = Path(__file__).parents[2] / "examples" / "measured_demo"


@pytest.fixture(scope="module")
def recordings() -> ModuleType:
    """The script that made the recordings, which alone knows the machine."""
    spec = importlib.util.spec_from_file_location("make_recordings", EXAMPLE / "make_recordings.py")
    assert spec is not None
    assert spec.loader is not None
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
    for stage in ("ingest", "train", "evaluate", "predict"):
        run(stage, ["experiment=measured_demo", "machine=measured_demo_table"], made)
    return made


def test_the_direct_stiffness_is_found(folder: Path, recordings: ModuleType) -> None:
    """Within 2 %."""
    found = pd.read_csv(folder / "identified_coefficients.csv")
    for node, truth in recordings.BEARINGS.items():
        own = found[found["bearing_node"] == node]
        for name in ("kxx", "kyy"):
            error = float(np.abs(own[name] / truth[name] - 1).median())
            stated = float((own[f"{name}_std"] / own[name]).median())
            print(f"node {node} {name}: {100 * error:.3f} %, stated {100 * stated:.3f} %")
            assert error < 0.02


def test_the_run_that_was_not_fitted_is_predicted(folder: Path) -> None:
    """Within 3 % at the probes."""
    held_out = json.loads((folder / "metrics.json").read_text())["fit"]["held_out_runs"]
    print(held_out)
    assert held_out["error_percent"] < 3
