"""Ordinary machines, drawn and not built by hand: the rotor, what holds it, what is measured, and what is wrong.

A machine is drawn from a seed alone, and so is its trouble; nothing of an identification is known here. A drawn machine
is two things: what its user states (:attr:`Drawn.stated`, the keys of a machine file) and what it really is.

Sizes are drawn log-normal about those of small and middle-sized machines. Speeds reach from a fifth to 0.7 .. 2.2
times the first natural frequency on rigid supports. Bearings are plain (short, by ROSS; two axial grooves, a published
table), elliptical and tilting-pad (Reynolds), or rolling (constant, or with kinks over the speed); the load follows
from the weight. A machine that would be unstable at one of its speeds is drawn again.

Legend: S speeds, P probes, R runs, B bearings.
"""

from __future__ import annotations

import tempfile
from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np
import yaml

from pipeline.coefficients import COEFFICIENTS
from pipeline.config.compose import compose_config
from pipeline.config.rotor import RotorConfig
from pipeline.config.schema import Config
from pipeline.data.dataset import Excitation, VibrationDataset, project_direction
from pipeline.data.simulate import simulate, solve_response
from pipeline.errors import ConfigError
from pipeline.parameters.as_built import build_rotor, stand_on_pedestals
from pipeline.rotor.bearing_table import BearingTable
from pipeline.rotor.dynamic_stiffness import assemble_systems
from pipeline.rotor.interpolation import shaft_rows
from pipeline.rotor.model import RotorModel
from pipeline.rotor.stored import load_modelled_bearings, load_rotor
from pipeline.twin.modes import find_modes, measure_stability
from pipeline.units import RAD_S_PER_RPM

BEARINGS = ("short", "grooved", "elliptical", "tilting_pad", "rolling", "kinked")
FILMS = {"grooved": "lund_thomsen_two_axial_groove", "elliptical": "elliptical", "tilting_pad": "tilting_pad"}
TROUBLE: dict[str, dict[str, Any]] = {
    "none": {},
    "modulus": {"built": {"youngs_modulus": 0.01}},
    "discs": {"built": {"disc_mass": 0.02}},
    "coupling": {"built": {"coupling_stiffness": "5e4 N/m", "coupling_mass": "0.3 kg"}},
    "drift": {"drift": 0.02},
    "correlated": {"correlation": 0.95},
    "gain": {"gain": 0.02},
    "angle": {"angle": 2.0},
    "load_direction": {"load_angle": 20.0},
    "theory": {"off_theory": 0.15},
    "support": {"built": {"pedestal_stiffness": "3e8 N/m", "pedestal_mass": "20 kg"}},
    "anisotropy": {"anisotropy": 0.005},
    "place": {"place": 5e-3},
    "few_speeds": {"every": 5},
}
"""What is silently wrong, by name, or was measured at every fifth speed alone; each amount was set before the first
machine with it was drawn."""


@dataclass(frozen=True, eq=False)
class Drawn:
    """A machine, as its user states it and as it is."""

    stated: dict[str, Any]  # keys of a machine file, without data
    bearings: dict[str, Any]  # the real ones, by node
    residual: tuple[dict[str, Any], ...]  # unbalance of the machine as found, at any nodes
    floor: float  # m, root mean square of a reading's noise
    trouble: Mapping[str, Any] = field(default_factory=dict)


def draw_machine(seed: int, floor: str = "0.05 um", trouble: str = "none") -> Drawn:
    """The machine of a seed, which no trouble changes; drawn again while it is unstable at one of its speeds, or two
    probes share a place."""
    generator = np.random.default_rng([seed, 11])
    while True:
        drawn = _draw(generator)
        places = [(probe["node"], probe["angle"]) for probe in drawn.stated["probes"]["at"]]
        if len(set(places)) == len(places) and is_stable(drawn):
            drawn.stated["speeds"]["step_rpm"] *= TROUBLE[trouble].get("every", 1)
            return replace(drawn, floor=float(floor.split()[0]) * 1e-6, trouble=TROUBLE[trouble])


def _spread(generator: np.random.Generator, median: float, deviation: float) -> float:
    """A log-normal size, in three digits."""
    return float(f"{median * np.exp(deviation * generator.standard_normal()):.3g}")


def _draw(generator: np.random.Generator) -> Drawn:
    n_elements = int(generator.integers(6, 30))
    diameter = _spread(generator, 0.055, 0.35)  # m
    length = float(f"{diameter * generator.uniform(14, 26):.3g}")
    overhung = bool(generator.random() < 0.4)
    left = max(1, n_elements // 10)
    right = round(n_elements * 0.7) if overhung else n_elements - left
    n_discs = int(generator.integers(1, 4))
    places = generator.choice(np.arange(left + 1, right), size=min(n_discs, right - left - 1), replace=False).tolist()
    light = (0,) if overhung else ()
    if overhung:
        places[0] = n_elements
    discs = [
        {
            "node": int(node),
            "width": f"{1e3 * _spread(generator, 0.9 * diameter, 0.25):.4g} mm",
            "inner_diameter": f"{1e3 * diameter:.4g} mm",
            "outer_diameter": f"{1e3 * _spread(generator, (4.0 if d in light else 4.6) * diameter, 0.15):.4g} mm",
        }
        for d, node in enumerate(places)
    ]
    rotor = {
        "shaft": [{"length": f"{1e3 * length:.4g} mm", "outer_diameter": f"{1e3 * diameter:.4g} mm",
                   "elements": n_elements}],
        "material": {"density": "7810 kg/m^3", "youngs_modulus": "211 GPa", "shear_modulus": "81.2 GPa"},
        "discs": discs,
        "bearing_nodes": [left, right],
    }  # fmt: skip
    first, weight, centre = _weigh(rotor)
    share = (centre - left) / (right - left)
    loads = [max(abs(weight * (1 - share)), 0.05 * weight), max(abs(weight * share), 0.05 * weight)]
    top = first * generator.uniform(0.7, 2.2)
    step = max(5.0, round((top - top / 5) / int(generator.integers(60, 130)) / 5) * 5.0)
    start = max(step, round(top / 5 / step) * step)
    kinds = generator.choice(BEARINGS, size=2)
    nodes = (left, right)
    bearings = {
        str(node): _draw_bearing(generator, kind, diameter, load, top)
        for node, kind, load in zip(nodes, kinds, loads, strict=True)
    }
    turn = float(generator.choice([0.0, 30.0, 45.0]))
    beside = int(generator.integers(0, 3))
    probes = [
        {"node": int(np.clip(node + side * beside, 0, n_elements)), "angle": f"{turn + angle:g} deg"}
        for node, side in ((left, 1), (right, -1))
        for angle in (0, 90)
    ]
    runs, residual = _draw_runs(generator, discs, weight)
    stated = {
        "rotor": rotor,
        "speeds": {"start_rpm": start, "stop_rpm": start + step * int((top - start) / step), "step_rpm": step},
        "runs": runs,
        "probes": {"at": probes},
        "prediction": {"node": discs[0]["node"], "speed_rpm": start + step * int((top - start) / step / 2),
                       "unbalances": runs[-1].get("unbalances") or runs[1]["unbalances"]},
    }  # fmt: skip
    return Drawn(stated, bearings, residual, 0.0)


def _weigh(rotor: Mapping[str, Any]) -> tuple[float, float, float]:
    """First natural frequency on rigid supports (rpm), weight (N), and the node of the centre of mass."""
    from scipy.linalg import eigh

    model = load_rotor(RotorConfig.model_validate(rotor))
    mass, stiffness = np.array(model.mass), np.array(model.stiffness)
    x = np.arange(0, len(mass), len(mass) // model.n_nodes)
    unit = np.zeros(len(mass))
    unit[x] = 1.0
    along = np.zeros(len(mass))
    along[x] = np.arange(model.n_nodes)
    total = unit @ mass @ unit
    for node in rotor["bearing_nodes"]:
        for direction in (0, 1):
            stiffness[x[node] + direction, x[node] + direction] += 1e11
    first = np.sqrt(eigh(stiffness, mass, eigvals_only=True, subset_by_index=[0, 0])[0])
    return float(first / RAD_S_PER_RPM), float(9.81 * total), float(along @ mass @ unit / total)


def _draw_bearing(
    generator: np.random.Generator, kind: str, diameter: float, load: float, top: float
) -> dict[str, Any]:
    if kind in ("rolling", "kinked"):
        stiffness = _spread(generator, 6e7, 0.9) * (diameter / 0.05)
        ratio, loss = np.exp(0.3 * generator.standard_normal() - 0.2), _spread(generator, 1.2e-5, 0.7)
        middle = np.array([stiffness * ratio, stiffness, stiffness * ratio * loss, stiffness * loss])
        count = 7 if kind == "kinked" else 1
        rows = middle * np.exp(0.12 * generator.standard_normal((count, 4)).cumsum(axis=0))
        speeds = np.linspace(0.1, 1.1, count) * top if count > 1 else np.array([0.0])
        table = [
            [float(f"{rpm:.5g}"), *(float(f"{v:.4g}") for v in (kxx, 0, 0, kyy, cxx, 0, 0, cyy))]
            for rpm, (kxx, kyy, cxx, cyy) in zip(speeds, rows, strict=True)
        ]
        if count > 1:
            return {"kind": "speed_table", "rows": table}
        return {"kind": "linear"} | dict(zip(COEFFICIENTS, table[0][1:], strict=True))
    journal = diameter * generator.uniform(0.9, 1.2)
    sizes = {
        "journal_diameter": f"{1e3 * journal:.4g} mm",
        "length": f"{1e3 * journal * min(_spread(generator, 0.5, 0.25), 0.9):.4g} mm",
        "radial_clearance": f"{1e3 * journal / 2 * _spread(generator, 1.6e-3, 0.35):.4g} mm",
        "oil_viscosity": f"{_spread(generator, 0.018, 0.5):.3g} Pa s",
        "static_load": f"{load:.4g} N",
    }
    if kind == "short":
        return {"kind": "cylindrical"} | sizes
    film = {"kind": "journal_table", "table": FILMS[kind]} | sizes
    # Gravity is along -y, the load of a table along its own x.
    film["load_angle"] = "-90 deg"
    if kind in ("elliptical", "tilting_pad"):
        film["preload"] = float(f"{generator.uniform(0.2, 0.5):.2g}")
    return film


def _draw_runs(
    generator: np.random.Generator, discs: list[dict[str, Any]], weight: float
) -> tuple[list[dict[str, Any]], tuple[dict[str, Any], ...]]:
    """As found, and with one to three trial weights of some ten times a residual of grade G 2.5; half have a shaker."""
    mass = weight / 9.81

    def unbalance(size: float) -> dict[str, Any]:
        node = discs[int(generator.integers(len(discs)))]["node"]
        grams = float(f"{1e6 * mass * size * generator.uniform(0.7, 1.4):.3g}")
        return {"node": node, "magnitude": f"{grams} g mm", "phase": f"{int(generator.integers(0, 360))} deg"}

    runs: list[dict[str, Any]] = [{"name": "as_found"}]
    for number in range(int(generator.integers(2, 4))):
        runs.append({"name": f"weight_{number + 1}", "unbalances": [unbalance(40e-6)]})
    if generator.random() < 0.5:
        force = {"node": discs[0]["node"], "magnitude": f"{0.05 * weight:.3g} N", "phase": "0 deg", "whirl": "backward"}
        runs.append({"name": "backward", "forces": [force]})
    return runs, tuple(unbalance(10e-6) for _ in discs)


def compose_real(drawn: Drawn) -> Config:
    """The configuration of the machine as it is."""
    keys = {key: value for key, value in drawn.stated.items() if key not in ("probes", "prediction")}
    keys["runs"] = [run for run in keys["runs"] if len(run) > 1]
    keys["bearings"] = {"kind": "per_node", "nodes": drawn.bearings}
    built = drawn.trouble.get("built", {})
    if built:
        keys["as_built"] = built
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "machine.yaml"
        path.write_text(yaml.safe_dump(keys, sort_keys=False), encoding="utf-8")
        return compose_config([f"machine.file={path}", "tracking=none"])


def _load_bearings(config: Config) -> BearingTable:
    speeds = np.array(config.machine.speeds.rpm()) * RAD_S_PER_RPM
    return load_modelled_bearings(config.machine.rotor, config.machine.bearings, speeds, {})


def is_stable(drawn: Drawn) -> bool:
    """Whether it can be measured at all of its speeds: its films are those of their tables, and no whirl grows."""
    config = compose_real(drawn)
    try:
        bearings = _load_bearings(config)
    except ConfigError:
        return False
    chosen = bearings.at(np.arange(0, len(bearings.speeds), 10))
    return bool(measure_stability(find_modes(load_rotor(config.machine.rotor), chosen)).stable)


def measure_machine(drawn: Drawn, noise: float, seed: int) -> tuple[VibrationDataset, BearingTable]:
    """What the probes read in every run (one has no weight), and the coefficients as the shaft feels them.

    ``noise`` is a share of the reading, beside the floor.
    """
    generator, config = np.random.default_rng([seed, 12]), compose_real(drawn)
    trouble, built = drawn.trouble, config.machine.as_built
    bearings = _turn(_load_bearings(config), trouble.get("load_angle", 0.0))
    bearings = _leave_theory(bearings, trouble.get("off_theory", 0.0), np.random.default_rng([seed, 14]))
    rotor = load_rotor(config.machine.rotor) if built is None else build_rotor(config.machine.rotor, built)
    felt = bearings if built is None else stand_on_pedestals(bearings, built)
    acting, residual = list_excitations(drawn, config, rotor.n_nodes, seed)
    seen, stated = [], []
    weight, misplaced = trouble.get("weight", (0.0, 0.0)), np.random.default_rng([seed, 15])
    for name, excitations in acting.items():
        factors = np.exp(trouble.get("drift", 0.0) * generator.standard_normal((len(felt.nodes), 1, 1)))
        placed = [
            replace(e, magnitude=e.magnitude * (1 + weight[0] * size), phase=e.phase + weight[1] * ahead)
            if e.kind == "unbalance"
            else e
            for e, (size, ahead) in zip(excitations, misplaced.standard_normal((len(excitations), 2)), strict=True)
        ]
        real = [*placed, *(Excitation(name, "unbalance", *one) for one in residual)]
        seen.append(_respond(rotor, replace(felt, values=felt.values * factors), tuple(real), trouble, seed))
        stated += excitations
    complete = simulate(rotor, felt, tuple(real))  # its axes
    channels = tuple((p["node"], float(p["angle"].split()[0])) for p in drawn.stated["probes"]["at"])
    gain, turn = generator.standard_normal((2, len(channels)))
    ahead = trouble.get("place", 0.0) * np.random.default_rng([seed, 16]).standard_normal(len(channels))
    rows = [
        np.array(project_direction(angle + trouble.get("angle", 0.0) * t)) @ shaft_rows(rotor, node, shift)
        for (node, angle), t, shift in zip(channels, turn, ahead.tolist(), strict=True)
    ]
    exact = np.stack(rows) @ np.concatenate(seen, axis=2) * (1 + trouble.get("gain", 0.0) * gain)[:, None]
    data = replace(complete, runs=tuple(acting), channels=channels, displacement=exact, excitations=tuple(stated))
    draw = generator.standard_normal((2, *exact.shape))
    steps, correlation = (draw[0] + 1j * draw[1]) / np.sqrt(2), trouble.get("correlation", 0.0)
    for s in range(1, len(steps)):
        steps[s] = correlation * steps[s - 1] + np.sqrt(1 - correlation**2) * steps[s]
    deviation = np.sqrt(drawn.floor**2 + (noise * np.abs(exact)) ** 2)
    return replace(data, displacement=exact + deviation * steps), felt


def _respond(
    rotor: RotorModel,
    bearings: BearingTable,
    excitations: tuple[Excitation, ...],
    trouble: Mapping[str, Any],
    seed: int,
    turns: int = 40,
) -> np.ndarray:
    """(S, n, 1) the response of a run, of a shaft that is stiffer in one direction by a share, ``anisotropy``.

    That direction turns with the shaft. With ``w = x + i y`` the shaft pushes back by ``K (w + e w* exp(2 i W t))``,
    e half that share and the direction's angle: what whirls forward is excited at 1X again, and what whirls backward at
    3X, which is left out (Genta, Dynamics of Rotating Systems, 2005, chapter 6). A fixed point, in so many ``turns``.
    """
    still = solve_response(rotor, bearings, excitations, (excitations[0].run,))
    share = trouble.get("anisotropy", 0.0) / 2 * np.exp(2j * np.random.default_rng([seed, 17]).uniform(0, np.pi))
    if not share:
        return still
    mass, damping, stiffness = assemble_systems(rotor, bearings)
    w = bearings.speeds[:, None, None]
    receptance = np.linalg.inv(stiffness + 1j * w * damping - w**2 * mass)
    # x and the slope of x; y and, with the other sign, its slope
    along, across, sign = (np.tile(one, rotor.n_nodes) for one in ([0, 3], [1, 2], [1.0, -1.0]))
    first = 4 * np.arange(rotor.n_nodes).repeat(2)
    along, across, response = first + along, first + across, still
    for _ in range(turns):
        forward = (response[:, along] + 1j * sign[:, None] * response[:, across]) / 2
        pushed = -share * (rotor.stiffness[np.ix_(along, along)] @ forward.conj())
        force = np.zeros_like(response)
        force[:, along], force[:, across] = pushed, -1j * sign[:, None] * pushed
        response = still + receptance @ force
    return response


def list_excitations(
    drawn: Drawn, config: Config, n_nodes: int, seed: int
) -> tuple[dict[str, list[Excitation]], list[tuple[int, float, float]]]:
    """What is stated of each run; node, size (kg m) and phase of what acts in all of them and nobody knows."""
    acting: dict[str, list[Excitation]] = {run["name"]: [] for run in drawn.stated["runs"]}
    for run in config.machine.runs:
        acting[run.name] += [Excitation(run.name, "unbalance", u.node, u.magnitude, u.phase) for u in run.unbalances]
        acting[run.name] += [Excitation(run.name, "force", f.node, f.magnitude, f.phase, f.whirl) for f in run.forces]
    places = np.random.default_rng([seed, 13]).integers(n_nodes, size=len(drawn.residual)).tolist()
    residual = [(node, float(r["magnitude"].split()[0]) * 1e-6, np.radians(float(r["phase"].split()[0])))
                for node, r in zip(places, drawn.residual, strict=True)]  # fmt: skip
    return acting, residual


def _leave_theory(bearings: BearingTable, share: float, generator: np.random.Generator) -> BearingTable:
    """Every coefficient off by a smooth factor of its own: of this share, over half of the range of speeds alike."""
    place = (bearings.speeds - bearings.speeds[0]) / np.ptp(bearings.speeds)
    alike = np.exp(-0.5 * ((place[:, None] - place) / 0.5) ** 2) + 1e-8 * np.eye(len(place))
    draw = generator.standard_normal((len(place), len(bearings.nodes) * len(COEFFICIENTS)))
    off = (np.linalg.cholesky(alike) @ draw).T.reshape(len(bearings.nodes), len(COEFFICIENTS), -1).swapaxes(1, 2)
    return replace(bearings, values=bearings.values * np.exp(share * off))


def _turn(bearings: BearingTable, degrees: float) -> BearingTable:
    """The bearings with their load turned by so many degrees from x towards y."""
    c, s = np.cos(np.radians(degrees)), np.sin(np.radians(degrees))
    turn = np.array([[c, -s], [s, c]])
    pairs = bearings.values.reshape(*bearings.values.shape[:2], 2, 2, 2)
    return replace(bearings, values=(turn @ pairs @ turn.T).reshape(bearings.values.shape))
