"""Every class of element that ROSS has: its rotor file gives ROSS's own response, or is refused by name."""

from __future__ import annotations

import inspect
import json
from collections.abc import Callable, Iterator, Sequence
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from conftest import refused

from pipeline.config.rotor import RotorConfig
from pipeline.data.dataset import Excitation, VibrationDataset, require_synchronous
from pipeline.data.sensors import list_directions, project
from pipeline.data.simulate import integrate, simulate
from pipeline.errors import ConfigError, DataError
from pipeline.parameters.model import ModelParameter, rotor_change
from pipeline.problem.residual import bearing_equations
from pipeline.rotor.bearing_table import BearingTable
from pipeline.rotor.bearings import RotorFileBearingConfig
from pipeline.rotor.model import RotorModel
from pipeline.rotor.ross_adapter import assemble, bearing_table, ross
from pipeline.rotor.stored import load_rotor
from pipeline.twin.modes import find_modes

RS = ross()
SPEEDS = np.linspace(25.0, 590.0, 23)
GRID = np.linspace(10.0, 600.0, 9)
STEEL = RS.Material("steel", rho=7810, E=211e9, G_s=81.2e9)
LAST = RS.BearingElement(n=5, kxx=1e7, kyy=2e7, cxx=1e3, tag="last")
TABLE = {"kxx": 1e6 + 1e3 * GRID, "kxy": 2e3 * GRID, "kyx": -1e3 * GRID, "cxx": 300 + GRID, "cxy": 3 + 0 * GRID}
UNBALANCE = Excitation("run", "unbalance", 3, 1e-3, 0.4)
Parts = tuple[list[Any], list[Any], list[Any], list[Any]]


def shaft(**changes: Any) -> list[Any]:
    """Six elements."""
    return [RS.ShaftElement(L=0.2, idl=0, odl=0.05, material=STEEL, **changes) for _ in range(6)]


def first() -> Any:
    """A bearing at node 1."""
    return RS.BearingElement(n=1, kxx=1e7, cxx=1e3, tag="first")


def bare(name: str, n: int, **more: Any) -> Any:
    """An element of a class whose constructor solves a film for seconds, as the file has it: with its coefficients."""
    kind = getattr(RS, name)
    made = kind.__new__(kind)
    made.__dict__["kwargs"] = None
    for argument in list(inspect.signature(kind.__init__).parameters)[1:]:
        setattr(made, argument, None)  # else ROSS would save it as its base class
    del made.__dict__["kwargs"]
    RS.BearingElement.__init__(made, n=n, **({**TABLE, "frequency": GRID, "tag": name} | more))
    return made


def bearing(element: Any) -> Parts:
    """A bearing of some class at node 1, beside an ordinary one."""
    return shaft(), [], [element, LAST], []


def seal(element: Any) -> Parts:
    """A seal of some class at the disc, and bearings."""
    return shaft(), [], [first(), element, LAST], []


SAME: dict[str, Callable[[], Parts]] = (
    {
        "ShaftElement": lambda: (
            shaft(torque=20.0, axial_force=500.0, alpha=0.5, beta=1e-5),
            [],
            [first(), LAST],
            [],
        ),
        "CouplingElement": lambda: (
            [
                *shaft()[:5],
                RS.CouplingElement(
                    1, 2, 0.01, 0.02, 0.005, 0.01, 1e7, 2e7, 1e6, 1e4, 2e4, 1e4, 5, 6, 7, 8, 9, 1, L=0.1
                ),
            ],
            [],
            [first(), LAST],
            [],
        ),
        "DiskElement": lambda: (
            shaft(),
            [RS.DiskElement(n=2, m=5, Id=0.1, Ip=0.2, tag="more")],
            [first(), LAST],
            [],
        ),
        "PointMass": lambda: (
            shaft(),
            [],
            [
                RS.BearingElement(n=1, kxx=1e7, kxy=2e6, cxx=1e3, n_link=7, tag="film"),
                RS.BearingElement(n=7, kxx=1e8, kyy=5e7, cxx=2e3, mxx=1.5, tag="pedestal"),
                RS.BearingElement(n=5, n_link=8, frequency=GRID, tag="film of the other", **TABLE),
                RS.BearingElement(n=8, kxx=3e8, cxx=2e3, n_link=9, tag="pedestal of the other"),
                RS.BearingElement(n=9, kxx=9e8, cxx=2e3, tag="foundation"),
            ],
            [RS.PointMass(n=node, m=mass, tag=f"mass {node}") for node, mass in ((7, 12.0), (8, 9.0), (9, 70.0))],
        ),
        "BearingElement": lambda: bearing(
            RS.BearingElement(n=1, frequency=GRID, **TABLE, mxx=2.0 + 0 * GRID, tag="with mass")
        ),
        "BallBearingElement": lambda: bearing(RS.BallBearingElement(1, 8, 0.03, 500.0, 0.5)),
        "RollerBearingElement": lambda: bearing(RS.RollerBearingElement(1, 8, 0.03, 500.0, 0.5)),
        "MagneticBearingElement": lambda: bearing(
            RS.MagneticBearingElement(1, 1e-3, 1.0, 1e-4, 200, kp_pid=1e3, kd_pid=1.0, n_f=30, frequency=GRID)
        ),
        "CylindricalBearing": lambda: bearing(
            RS.CylindricalBearing(1, GRID, 525.0, 0.03, 0.1, 1e-4, 0.1, tag="short bearing")
        ),
        "SqueezeFilmDamper": lambda: bearing(
            RS.SqueezeFilmDamper(1, [300.0], 0.02, 0.06, 7e-5, 0.5, "ISOVG32", tag="damper")
        ),
        "ThrustPad": lambda: (
            shaft(),
            [],
            [
                first(),
                LAST,
                bare("ThrustPad", 3, **dict.fromkeys(TABLE, 0 * GRID), kzz=1e8 + GRID, czz=1e3 + GRID),
            ],
            [],
        ),
        "SealElement": lambda: (
            shaft(),
            [],
            [
                first(),
                LAST,
                RS.SealElement(n=3, frequency=GRID, mxx=3 + GRID / 300, tag="table", **TABLE),
                RS.SealElement(n=5, kxx=1e6, kxy=2e5, kyx=-2e5, cxx=100, mxx=2, tag="constant, at a bearing"),
                RS.SealElement(n=2, kxx=[1e6, 2e6, 2.5e6], cxx=[100, 120, 125], frequency=[0, 300, 600], tag="three"),
            ],
            [],
        ),
        "BearingFluidFlow": lambda: bearing(
            RS.BearingFluidFlow(1, 12, 12, 0.03, [157.1], 0.0, 0.0, 0.0499, 0.05, 0.1, 860.0, load=525)
        ),
    }
    | {name: lambda name=name: bearing(bare(name, 1)) for name in ("PlainJournal", "TiltingPad")}
    | {name: lambda name=name: seal(bare(name, 3)) for name in ("LabyrinthSeal", "HolePatternSeal", "HybridSeal")}
)
SAVED_AS_BASE = {"SqueezeFilmDamper", "BearingFluidFlow", "MagneticBearingElement"}
UNSAVED = {
    "GearElement": lambda: RS.GearElement(n=2, m=5, Id=0.1, Ip=0.2, n_teeth=30, pitch_diameter=0.1),
    "GearElementTVMS": lambda: RS.GearElementTVMS(2, STEEL, 0.05, 0.05, 0.002, 60, pr_angle=0.35),
}
"""ROSS 2.3.0 can't save them: no file has one."""


def rotor_of(parts: Parts) -> Any:
    """ROSS's rotor, with a disc where the unbalance is."""
    shaft_elements, discs, bearings, masses = parts
    return RS.Rotor(shaft_elements, [RS.DiskElement(n=3, m=20, Id=0.1, Ip=0.2, tag="disc"), *discs], bearings, masses)


def saved(parts: Parts, path: Path) -> tuple[Any, RotorConfig]:
    """The rotor, and the configuration of its file."""
    made = rotor_of(parts)
    made.save(path)
    return made, RotorConfig(file=str(path))


@cache
def made_of(name: str) -> Any:
    """ROSS's rotor of a case, which keeps its response."""
    return rotor_of(SAME[name]())


def read(config: RotorConfig, speeds: np.ndarray = SPEEDS) -> tuple[RotorModel, BearingTable, VibrationDataset]:
    """What the pipeline makes of a file, and its unbalance response."""
    model, table = assemble(config), bearing_table(config, RotorFileBearingConfig(kind="rotor_file"), speeds)
    assert table.nodes == model.bearing_nodes
    return model, table, simulate(model, table, (UNBALANCE,), None)


def difference(made: Any, found: VibrationDataset) -> float:
    """Largest difference of x and y at all nodes from ROSS's response, over the largest."""
    answer = made.run_unbalance_response([3], [1e-3], [0.4], frequency=found.speeds).forced_resp
    theirs = np.array([answer[6 * node + (angle > 0)] for node, angle in found.channels]).T
    assert np.abs(theirs).max() > 1e-9
    return float(np.abs(found.displacement[..., 0] - theirs).max() / np.abs(theirs).max())


def subclasses(kind: type) -> Iterator[type]:
    """All of them."""
    for one in kind.__subclasses__():
        yield one
        yield from subclasses(one)


def test_every_class_of_element_has_a_case() -> None:
    named = {one.__name__ for one in subclasses(RS.element.Element) if one.__module__.startswith("ross.")}
    assert {name for name in named if hasattr(RS, name)} == SAME.keys() | UNSAVED.keys()


# Of ROSS's magnetic, tilting pad, damper and fluid flow bearings.
@pytest.mark.filterwarnings("ignore:(the matrix subclass|DataFrame is highly|Extrapolating|BearingFluidFlow is dep)")
@pytest.mark.parametrize("ending", ["toml", "json"])
@pytest.mark.parametrize("name", SAME)
def test_a_file_with_any_element_gives_the_response_of_ross(name: str, ending: str, tmp_path: Path) -> None:
    made, config = made_of(name), RotorConfig(file=str(tmp_path / f"rotor.{ending}"))
    made.save(config.file)
    # ROSS saves those that lack an argument of their constructor as their base class.
    assert f"{name}_" in (tmp_path / f"rotor.{ending}").read_text() or name in SAVED_AS_BASE
    model, _, found = read(config)
    assert difference(made, found) < 1e-10
    kept = load_rotor(config)
    assert np.array_equal(kept.seals.rows, model.seals.rows, equal_nan=True)
    assert kept.supported_nodes == load_rotor(config).supported_nodes == model.supported_nodes


@pytest.mark.parametrize("name", UNSAVED)
def test_no_file_has_a_gear(name: str, tmp_path: Path) -> None:
    """Where a later ROSS can save it, this test asks for a case of its own."""
    made = rotor_of((shaft(), [UNSAVED[name]()], [first(), LAST], []))
    with pytest.raises(Exception, match=r"base_diameter|TOML|Object of type"):
        made.save(tmp_path / "rotor.toml")


def test_a_gear_of_stated_inertia_is_a_disc(tmp_path: Path) -> None:
    path = tmp_path / "rotor.json"
    made, config = saved(SAME["DiskElement"](), path)
    path.write_text(path.read_text().replace("DiskElement_more", "GearElement_more"))
    assert difference(made, read(config)[2]) < 1e-10


def test_a_point_mass_on_the_shaft_is_a_disc_without_inertia(tmp_path: Path) -> None:
    """ROSS keeps three DOF of its own for it, without stiffness: it has no response to compare with."""
    stands = [first(), LAST]
    _, config = saved((shaft(), [], stands, [RS.PointMass(n=1, m=3.0)]), tmp_path / "mass.toml")
    made, _ = saved((shaft(), [RS.DiskElement(n=1, m=3, Id=0, Ip=0, tag="mass")], stands, []), tmp_path / "disc.toml")
    assert difference(made, read(config)[2]) < 1e-10


REFUSED: dict[str, tuple[Callable[[], Parts], str]] = {
    "a link between nodes of the shaft": (
        lambda: bearing(RS.BearingElement(n=1, kxx=1e7, cxx=1e3, n_link=4, tag="link")),
        "'link' holds the nodes 1 and 4 together",
    ),
    "one support of two bearings": (
        lambda: (
            shaft(),
            [],
            [
                RS.BearingElement(n=1, kxx=1e7, cxx=1e3, n_link=7, tag="a"),
                RS.BearingElement(n=5, kxx=1e7, cxx=1e3, n_link=7, tag="b"),
                RS.BearingElement(n=7, kxx=1e8, cxx=1e3, tag="c"),
            ],
            [RS.PointMass(n=7, m=10)],
        ),
        "holds the nodes 1 and 5 together: give each bearing a support of its own",
    ),
    "a seal on a support": (
        lambda: (
            shaft(),
            [],
            [
                RS.BearingElement(n=1, kxx=1e7, cxx=1e3, tag="a"),
                LAST,
                RS.SealElement(n=3, kxx=1e5, cxx=1e3, n_link=7, tag="labyrinth"),
                RS.BearingElement(n=7, kxx=1e8, cxx=1e3, tag="c"),
            ],
            [RS.PointMass(n=7, m=10)],
        ),
        "'labyrinth' at node 3 stands on a support: leave out its n_link",
    ),
    "seals alone": (
        lambda: (shaft(), [], [RS.SealElement(n=3, kxx=1e6, cxx=1e2)], []),
        "must have bearings to identify",
    ),
}


@pytest.mark.parametrize("case", REFUSED)
def test_what_can_not_be_separated_is_refused_by_name(case: str, tmp_path: Path) -> None:
    make, words = REFUSED[case]
    _, config = saved(make(), tmp_path / "rotor.toml")
    with refused(words, kind=ConfigError):
        read(config)


@pytest.mark.filterwarnings("ignore:DataFrame is highly fragmented")  # of ROSS's coaxial rotor
def test_several_shafts_and_foreign_elements_are_refused_by_name(tmp_path: Path) -> None:
    """Rotors on one axis, a seal's table over speed and frequency, and an element of another program."""
    path = tmp_path / "rotor.json"
    RS.coaxrotor_example().save(path)
    with refused("must have one shaft, but that of", "and another begins", kind=ConfigError):
        assemble(RotorConfig(file=str(path)))
    saved(SAME["SealElement"](), path)
    content = json.loads(path.read_text())
    for changed, words in (
        ({name: {**content[name], "kxx": [[1e5, 2e5]] * 9} for name in content if name[:4] == "Seal"}, "over one axis"),
        ({"Turbine_1": {"n": 2}}, "has a 'Turbine'"),
    ):
        path.write_text(json.dumps(content | changed))
        with refused(words, kind=ConfigError):
            assemble(RotorConfig(file=str(path)))


@pytest.mark.slow
def test_seals_are_in_modes_and_in_time_and_no_parameter_changes_them(tmp_path: Path) -> None:
    made, config = saved(SAME["SealElement"](), tmp_path / "rotor.toml")
    model, table, found = read(config)
    for s in (3, 20):
        theirs = np.sort(made.run_modal(float(SPEEDS[s]), num_modes=28, sparse=False).wd)
        ours = find_modes(model, table.at(np.array([s])), 4).frequency[0]
        # ROSS's modes have torsion and the axis, too.
        assert max(np.abs(theirs - one).min() / one for one in ours) < 1e-6
    few = np.array([3])
    assert np.allclose(integrate(model, table.at(few), (UNBALANCE,)).displacement, found.displacement[few], rtol=1e-3)
    assert rotor_change(ModelParameter("density", 0.1, ""), model).seals.nodes == ()
    assert model.fingerprint != assemble(saved(bearing(first()), tmp_path / "without.toml")[1]).fingerprint


@pytest.mark.parametrize("nodes", [range(7), (1, 5), (1, 3, 5)])
def test_the_true_coefficients_leave_no_residual_beside_seals(nodes: Sequence[int], tmp_path: Path) -> None:
    """Where the seals' nodes are measured, and where they are not."""
    model, table, complete = read(saved(SAME["SealElement"](), tmp_path / "rotor.toml")[1])
    equations = bearing_equations(model, project(complete, list_directions(tuple(nodes))))
    left = equations.free_residual + np.einsum("bsij,bsjr->bsir", table.impedance(), equations.displacement)
    assert np.abs(left).max() < 1e-9 * np.abs(equations.free_residual).max()


def test_a_support_and_a_force_of_its_own_frequency_are_refused(tmp_path: Path) -> None:
    """What the shaft feels of film and support depends on the frequency, not on the speed."""
    _, config = saved(SAME["PointMass"](), tmp_path / "rotor.toml")
    model, table, found = read(config)
    require_synchronous(model, found)
    own = simulate(model, table, (Excitation("run", "force", 3, 1.0, 0.0),), 1.5 * SPEEDS[:, None])
    with pytest.raises(DataError, match="that of node 1 does and a run has a frequency of its own"):
        require_synchronous(model, own)
