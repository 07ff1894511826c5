"""``stage=export``: the files load in ROSS and give the twin's response; the answer goes back into the project."""

from __future__ import annotations

import shutil
from pathlib import Path

import numpy as np
import pandas as pd
import pytest
from conftest import ARTIFACTS, Artifacts, Run
from running import few, names_in

from pipeline.coefficients import COEFFICIENTS
from pipeline.config.rotor import RotorConfig
from pipeline.data.dataset import Excitation
from pipeline.problem.measurement import Measurement
from pipeline.rotor.bearing_table import BearingTable
from pipeline.rotor.ross_adapter import assemble, ross
from pipeline.stages.analysis import Analysis
from pipeline.stages.measurement import load_measurement, restore
from pipeline.twin.prediction import predict

pytestmark = pytest.mark.slow

WEIGHTS = (Excitation("test", "unbalance", 3, 2e-4, 0.4), Excitation("test", "unbalance", 4, 1e-4, -1.0))


@pytest.fixture(scope="module", params=["realistic", "measured_demo"])
def made(
    request: pytest.FixtureRequest, run: Run, tmp_path_factory: pytest.TempPathFactory
) -> tuple[Path, Measurement, BearingTable]:
    """An exported fit that `make reproduce` made, its measurement at the fitted model parameters, and its answer.

    ``realistic`` has model parameters of shaft, discs and coupling, and tables over the speed; ``measured_demo`` has a
    rotor file and constants.
    """

    folder = tmp_path_factory.mktemp("made") / request.param
    shutil.copytree(Artifacts(ARTIFACTS)(request.param, "training.json", "model.safetensors"), folder)
    answer = restore(Analysis(run("export", [f"experiment={request.param}"], folder)))
    return folder / "export", answer.measurement, answer.table


def ross_response(rotor: object, speeds: np.ndarray, node: int) -> np.ndarray:
    """(S, 2) complex, m: ROSS's own unbalance response."""
    answer = rotor.run_unbalance_response(
        [one.node for one in WEIGHTS],
        [one.magnitude for one in WEIGHTS],
        [one.phase for one in WEIGHTS],
        frequency=speeds,
    )
    return np.asarray(answer.forced_resp)[6 * node : 6 * node + 2].T


def interpolate_exactly(rotor: object) -> None:
    """As docs/export.md has it: splines through the tables in the place of ROSS's smoothed ones."""
    from scipy.interpolate import CubicSpline

    for bearing in rotor.bearing_elements:
        for name in COEFFICIENTS:
            if bearing.frequency is not None:
                setattr(bearing, f"{name}_interpolated", CubicSpline(bearing.frequency, getattr(bearing, name)))


def test_the_rotor_file_gives_the_response_of_the_twin(made: tuple[Path, Measurement, BearingTable]) -> None:
    """Oracle: ROSS loads it and solves six DOF a node by itself; the twin solves four as a band matrix. To 1e-9.

    As ROSS evaluates its tables (a spline that leaves a root mean square of 1 N s/m) the response is within 1e-4.
    """
    folder, updated, table = made
    rotor, picked = ross().Rotor.load(folder / "rotor.toml"), slice(None, None, 9)
    twin = predict(updated.updated_rotor, table.at(np.arange(len(table.speeds))[picked]), WEIGHTS, 3).displacement
    constant = all(one.frequency is None for one in rotor.bearing_elements)
    np.testing.assert_allclose(ross_response(rotor, table.speeds[picked], 3), twin, rtol=1e-9 if constant else 1e-4)
    exact = ross().Rotor.load(folder / "rotor.toml")  # the first one keeps its response
    interpolate_exactly(exact)
    np.testing.assert_allclose(ross_response(exact, table.speeds[picked], 3), twin, rtol=1e-9)


def test_the_rotor_file_has_the_fitted_shaft_and_discs(made: tuple[Path, Measurement, BearingTable]) -> None:
    """Read as this project reads a rotor: the matrices at the fitted model parameters, and the same bearings."""
    folder, updated, table = made
    found, wanted = assemble(RotorConfig(file=str(folder / "rotor.toml"))), updated.updated_rotor
    coupling = [p.place for p in updated.parameters if p.kind.startswith("coupling")]
    free = np.ones(found.n_dof, dtype=bool)
    for node in coupling:  # its spring and mass stand in a bearing element of their own
        free[4 * node : 4 * node + 2] = False
    for name in ("mass", "gyroscopic", "stiffness", "damping"):
        off = (getattr(found, name) - getattr(wanted, name))[np.ix_(free, free)]
        np.testing.assert_allclose(off, 0.0, atol=1e-12 * np.abs(getattr(wanted, name)).max())
    assert set(table.nodes) <= set(found.bearing_nodes)


def test_each_bearing_loads_by_itself(made: tuple[Path, Measurement, BearingTable]) -> None:
    folder, _, table = made
    for b, node in enumerate(table.nodes):
        element = ross().BearingElement.load(folder / f"bearing_node_{node}.toml")
        assert element.n == node
        for c, name in enumerate(COEFFICIENTS):
            np.testing.assert_array_equal(
                np.broadcast_to(getattr(element, name), len(table.speeds)), table.values[b, :, c]
            )


def test_the_deviations_are_those_of_training(made: tuple[Path, Measurement, BearingTable]) -> None:
    folder, _, _ = made
    trained = pd.read_csv(folder.parent / "identified_coefficients.csv")
    for name in ("deviations.csv", "coefficients.csv"):
        found = pd.read_csv(folder / name)
        pd.testing.assert_frame_equal(found, trained[list(found)], rtol=1e-12)


def test_the_answer_goes_back_in_as_known_coefficients(made: tuple[Path, Measurement, BearingTable]) -> None:
    """``data.known=export/coefficients.csv``: the coefficients that are not unknown are those that were exported."""
    from pipeline.config.compose import compose_config

    folder, _, table = made
    own = folder.parent
    files = [
        f"data.{name}={own / file}"
        for name, file in (("vibration", "vibration.parquet"), ("excitation", "excitation.csv"))
    ]
    asked = ["identify.unknowns=[kxx,kyy]", f"data.known={folder / 'coefficients.csv'}", f"output={own}"]
    known = load_measurement(compose_config([f"experiment={own.name}", *files, *asked])).known
    np.testing.assert_array_equal(known.values[..., [1, 2, 4, 5, 6, 7]], table.values[..., [1, 2, 4, 5, 6, 7]])


def test_it_trains_first_and_writes_what_is_asked_for(run: Run, tmp_path: Path) -> None:
    """A fit without deviations, in US units; an earlier export's other files are gone."""
    config = few("ball_bearing")
    asked = config.export.model_copy(update={"units": "us", "formats": ("csv", "ansys")})
    (tmp_path / "export").mkdir()
    (tmp_path / "export" / "dyrobes_node_1.txt").write_text("of an earlier fit")
    run("export", config, tmp_path, export=asked)
    wanted = {f"ansys_node_{node}.{end}" for node in (0, 2) for end in ("txt", "inp")}
    assert names_in(tmp_path / "export") == {"conventions.txt", "coefficients.csv", *wanted}
    assert "kxx_lb_per_in" in pd.read_csv(tmp_path / "export" / "coefficients.csv")
    assert "lb/in" in (tmp_path / "export" / "conventions.txt").read_text()
