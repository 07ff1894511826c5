"""Responses that ROSS computed and saved, against the data set that the simulation gives."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest
from conftest import refused
from measured_files import probes_config
from reading import parsed, read

from benchmarks.ross_oracle import ross_rotor
from pipeline.config.rotor import RotorConfig
from pipeline.data.excitation_files import run_excitations
from pipeline.data.sensors import project
from pipeline.data.simulate import simulate
from pipeline.rotor.bearings import LinearBearingConfig
from pipeline.rotor.ross_adapter import assemble, bearing_table, ross
from pipeline.units import RAD_S_PER_RPM

ROTOR = RotorConfig.model_validate(
    {
        "shaft": [{"length": 1.2, "outer_diameter": 0.05, "elements": 6}],
        "material": {"density": 7810, "youngs_modulus": 211e9, "shear_modulus": 81.2e9},
        "discs": [{"node": 3, "mass": 20, "diametral_inertia": 0.1, "polar_inertia": 0.2}],
        "bearing_nodes": [0, 6],
    }
)
BEARING = LinearBearingConfig(kind="linear", kxx=1e7, kyy=2e7, kxy=1e6, cxx=1e3, cyy=2e3)
SPEEDS = np.linspace(600, 4200, 25) * RAD_S_PER_RPM
RUNS = {"one": [(3, 1e-3, 0.4)], "two": [(3, 2e-4, -1.0), (2, 5e-4, 2.0)]}
PROBES = {"A": (1, 45.0), "B": (1, 135.0), "C": (5, 0.0), "D": (5, 90.0)}


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A file a run, and a time response."""
    made, place = ross_rotor(ROTOR, BEARING, SPEEDS), tmp_path_factory.mktemp("ross")
    for run, weights in RUNS.items():
        nodes, sizes, phases = (list(part) for part in zip(*weights, strict=True))
        made.run_unbalance_response(nodes, sizes, phases, frequency=SPEEDS).save(place / f"{run}.toml")
    made.run_time_response(100.0, np.zeros((20, made.ndof)), np.linspace(0, 0.1, 20)).save(place / "time.toml")
    return place


def section(folder: Path, **changes: Any) -> dict[str, Any]:
    """The recordings of both runs."""
    runs = [
        {
            "name": name,
            "file": str(folder / f"{name}.toml"),
            "unbalances": [{"node": n, "magnitude": size, "phase": phase} for n, size, phase in weights],
        }
        for name, weights in RUNS.items()
    ]
    return {"format": "ross", "shaft_angle": "from_x", "probes": probes_config(PROBES), "runs": runs} | changes


def test_a_response_of_ross_is_the_data_set_of_the_simulation(folder: Path) -> None:
    found = read(section(folder))
    config = parsed(section(folder))
    acting = tuple(excitation for run in config.runs for excitation in run_excitations(run, config.angle_from_x))
    made = simulate(assemble(ROTOR), bearing_table(ROTOR, BEARING, SPEEDS), acting, None)
    made = project(made, ((1, 0.0), (1, 90.0), (5, 0.0), (5, 90.0)))
    assert (found.channels, found.runs, found.excitations) == (made.channels, made.runs, made.excitations)
    assert np.allclose(found.speeds, made.speeds, rtol=1e-12, atol=0)
    assert np.abs(found.displacement - made.displacement).max() < 1e-9 * np.abs(made.displacement).max()


def test_what_does_not_fit_is_named(folder: Path, tmp_path: Path) -> None:
    one, two = section(folder)["runs"]
    with refused("must have the unbalances of its run", "but it says 0.001 kg m at node 3, 0.4 rad: write these"):
        read(section(folder, runs=[one | {"unbalances": two["unbalances"]}]))
    with refused("must have the node 9 of probe 'A', but it has 7 nodes: is it of another rotor?"):
        read(section(folder, probes=probes_config({"A": (9, 0.0), "B": (9, 90.0)})))
    whole = (folder / "one.toml").read_text()
    (tmp_path / "a.json").write_text("{}")
    (tmp_path / "cut.toml").write_text(whole[: len(whole) // 2])
    (tmp_path / "bad.toml").write_text(whole.replace("np.complex128(", "np.complex128(nan", 1))
    for path, *words in (
        (
            folder / "time.toml",
            "must have ForcedResponseResults of ROSS, but it has TimeResponseResults",
            "run_unbalance_response",
        ),
        (tmp_path / "none.toml", "must exist"),
        (tmp_path / "a.json", "must be TOML, but it is JSON, where ROSS leaves complex numbers out"),
        (tmp_path / "cut.toml", "must be a response that ROSS saved, but it can't be read as one"),
        (tmp_path / "bad.toml", "must have complex numbers in forced_resp"),
    ):
        with refused(*words):
            read(section(folder, runs=[one | {"file": str(path)}]))


def test_ross_still_leaves_complex_numbers_out_of_json(folder: Path, tmp_path: Path) -> None:
    """Where a later ROSS writes them, JSON can be read as well."""
    ross().ForcedResponseResults.load(folder / "one.toml").save(tmp_path / "one.json")
    assert "null" in (tmp_path / "one.json").read_text()
