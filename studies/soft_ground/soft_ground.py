"""Do casing probes tell bearings from supports on machines that nobody chose? Drawn machines, identified from files.

    python studies/soft_ground/soft_ground.py output=FOLDER [seeds=300-311] [cases=exact,...] [workers=2]

The rotor, its weights, speeds and instruments are those of studies/ordinary/draw.py. Each bearing stands on a support:
its stiffness is drawn about that of the film at the middle speed (0.7 in the logarithm), its mass about what the
bearing carries (0.5), its damping ratio between 2 and 10 %. The file states each of these numbers off by a factor
drawn log-normal (0.5); the fit is told a factor e. It is also told the size of the bearings' stiffness and damping,
off by a factor e, to a factor of 30. At both bearings the shaft and the casing are measured, each with 1 % and 0.05 um.
In ``constant`` the bearings have the coefficients of the middle speed at all speeds, and the command says so; in
``exact`` it says, too, that shaft, weights and probes are exactly as stated, as they are in all three; in ``default``
nothing is said of the bearings, and their kinds are searched. ``seal`` is ``exact`` with a seal at a drawn node between
the bearings, where the shaft is measured, too. Its direct stiffness is about a fifth of the films', its mass about a
fifth of what a bearing carries (0.5 each), its damping ratio between 20 and 100 %; cross terms are those of a short
seal with half the speed as its swirl (Black and Jenssen 1970), at the middle speed. The fit is told that the mass is
nothing, plus or minus what a bearing carries. ``exact.1``, ``exact.2`` .. have other draws of the noise.

Counted as in studies/ordinary/ordinary.py; *supports* are their six numbers each, *masses* the four of a seal.
"""

from __future__ import annotations

import json
import math
import sys
from collections.abc import Sequence
from concurrent.futures import ProcessPoolExecutor
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import yaml

ORDINARY = Path(__file__).parents[1] / "ordinary"
sys.path.insert(0, str(ORDINARY))

from draw import Drawn, compose_real, draw_machine, list_excitations  # noqa: E402
from ordinary import PLACEHOLDER, identify, judge, summarize  # noqa: E402

from pipeline.config.rotor import RotorConfig  # noqa: E402
from pipeline.data.dataset import DIRECTIONS, Excitation, VibrationDataset  # noqa: E402
from pipeline.data.excitation_files import write_excitation  # noqa: E402
from pipeline.data.sensors import NOMINAL_95, project  # noqa: E402
from pipeline.data.simulate import simulate  # noqa: E402
from pipeline.data.vibration_files import write_vibration  # noqa: E402
from pipeline.files import write_json  # noqa: E402
from pipeline.rotor.bearing_table import BearingTable  # noqa: E402
from pipeline.rotor.model import DOF_PER_NODE, RotorModel  # noqa: E402
from pipeline.rotor.stored import load_modelled_bearings, load_rotor  # noqa: E402
from pipeline.twin.modes import find_modes, measure_stability  # noqa: E402
from pipeline.units import RAD_S_PER_RPM  # noqa: E402

NOISE, FLOOR = 0.01, 5e-8
KINDS = {"support_stiffness": "k", "support_damping": "c", "support_mass": "m"}


@dataclass(frozen=True)
class Grounded:
    """A drawn machine, what its bearings are, and its supports as they are and as its file states them.

    A bearing carries ``carried`` kg. At ``seal``, which counts as a bearing, the fluid adds so many kg to a node.
    """

    drawn: Drawn
    bearings: BearingTable
    supports: list[dict[str, Any]]
    stated: list[dict[str, Any]]
    carried: float
    seal: tuple[tuple[int, float], ...] = ()

    @property
    def rotor(self) -> dict[str, Any]:
        """What its file states of it without the supports."""
        return self.drawn.stated["rotor"] | {"bearing_nodes": list(self.bearings.nodes)}

    def load(self) -> RotorModel:
        """The rotor as it is."""
        model = load_rotor(RotorConfig.model_validate(self.rotor | {"supports": self.supports}))
        mass = model.mass.copy()
        for node, added in self.seal:
            for direction in (0, 1):
                mass[DOF_PER_NODE * node + direction, DOF_PER_NODE * node + direction] += added
        return replace(model, mass=mass)


def draw_grounded(seed: int, case: str) -> Grounded:
    """Drawn again while it is unstable at one of its speeds."""
    generator = np.random.default_rng([seed, 31])
    drawn = draw_machine(seed)
    config = compose_real(drawn)
    speeds = np.array(config.machine.speeds.rpm()) * RAD_S_PER_RPM
    bearings = load_modelled_bearings(config.machine.rotor, config.machine.bearings, speeds, {})
    middle = bearings.values[:, [len(speeds) // 2]]
    if case != "default":
        bearings = replace(bearings, values=np.repeat(middle, len(speeds), axis=1))
    carried = load_rotor(config.machine.rotor).total_mass / 2
    while True:
        supports, stated = [], []
        for node, values in zip(bearings.nodes, middle[:, 0], strict=True):
            film = np.sqrt(np.prod(np.hypot(values[[0, 3]], speeds[len(speeds) // 2] * values[[4, 7]])))
            stiffness = film * np.exp(0.7 * generator.standard_normal() + 0.3 * generator.standard_normal(2))
            mass = carried * np.exp(0.5 * generator.standard_normal() + 0.1 * generator.standard_normal(2))
            damping = 2 * generator.uniform(0.02, 0.1, 2) * np.sqrt(stiffness * mass)
            number = dict(zip(("kxx", "kyy", "cxx", "cyy", "mxx", "myy"), [*stiffness, *damping, *mass], strict=True))
            off = np.exp(0.5 * generator.standard_normal(6))
            supports.append({"node": int(node)} | {key: float(f"{v:.4g}") for key, v in number.items()})
            stated.append(
                {"node": int(node)}
                | {key: float(f"{v * o:.2g}") for (key, v), o in zip(number.items(), off, strict=True)}
            )
        machine = Grounded(drawn, bearings, supports, stated, carried)
        if case == "seal":
            machine = add_seal(machine, generator)
        chosen = machine.bearings.at(np.arange(0, len(speeds), 10))
        if measure_stability(find_modes(machine.load(), chosen)).stable:
            return machine


def add_seal(machine: Grounded, generator: np.random.Generator) -> Grounded:
    """The machine with a seal between its bearings."""
    (left, right), values = machine.bearings.nodes, machine.bearings.values
    node, w = int(generator.integers(left + 1, right)), float(np.median(machine.bearings.speeds))
    stiffness = np.sqrt(np.abs(values[..., [0, 3]]).prod(axis=2)).mean() / 5 * np.exp(0.5 * generator.standard_normal())
    added = machine.carried / 5 * np.exp(0.5 * generator.standard_normal())
    damping = 2 * generator.uniform(0.2, 1.0) * np.sqrt(stiffness * added)
    stiff, damped = (stiffness, damping * w / 2), (damping, added * w)
    film = [entry for direct, cross in (stiff, damped) for entry in (direct, cross, -cross, direct)]
    table = np.insert(values, 1, np.array(film), axis=0)
    bearings = BearingTable((left, node, right), machine.bearings.speeds, table)
    return replace(machine, bearings=bearings, seal=((node, added),))


def measure(machine: Grounded, seed: int, draw: str) -> VibrationDataset:
    """What the probes at both shafts and casings read in every run; the first has no weight. A further ``draw`` (a
    number) has other noise alone."""
    generator = np.random.default_rng([seed, 32, *map(int, draw)])
    rotor, drawn = machine.load(), machine.drawn
    acting, residual = list_excitations(drawn, compose_real(drawn), rotor.n_nodes, seed)
    seen = [
        simulate(rotor, machine.bearings, (*own, *(Excitation(name, "unbalance", *u) for u in residual)))
        for name, own in acting.items()
    ]
    whole = replace(
        seen[0],
        runs=tuple(acting),
        displacement=np.concatenate([data.displacement for data in seen], axis=2),
        excitations=tuple(e for own in acting.values() for e in own),
    )
    at = [*machine.bearings.nodes, *range(rotor.n_nodes, rotor.n_places)]
    data = project(whole, tuple((node, angle) for node in at for angle in DIRECTIONS.values()))
    real, imaginary = generator.standard_normal((2, *data.displacement.shape)) / np.sqrt(2)
    deviation = np.sqrt(FLOOR**2 + (NOISE * np.abs(data.displacement)) ** 2)
    return replace(data, displacement=data.displacement + deviation * (real + 1j * imaginary))


def write_user_files(folder: Path, machine: Grounded, seed: int, draw: str) -> None:
    """The machine as its user has it."""
    folder.mkdir(parents=True, exist_ok=True)
    data = measure(machine, seed, draw)
    write_vibration(folder / "vibration.csv", data)
    write_excitation(folder / "excitation.csv", data)
    stated = {key: value for key, value in machine.drawn.stated.items() if key not in ("probes", "runs")}
    stated["rotor"] = machine.rotor | {"supports": machine.stated}
    stated["runs"] = [run for run in machine.drawn.stated["runs"] if len(run) > 1]
    stated["bearings"] = PLACEHOLDER
    stated["data"] = {"vibration": "vibration.csv", "excitation": "excitation.csv", "baseline": "as_found"}
    (folder / "machine.yaml").write_text(yaml.safe_dump(stated, sort_keys=False), encoding="utf-8")


def run_case(folder: Path, seed: int, case: str) -> dict[str, Any]:
    """One machine, from drawing to judging; read again where it is done."""
    done = folder / "judged.json"
    case, _, draw = case.partition(".")
    if not done.exists():
        machine = draw_grounded(seed, case)
        write_user_files(folder, machine, seed, draw)
        told = [f"identify.model_parameters.{kind}=1" for kind in KINDS]
        told += ["identify.known_within=30", *state_sizes(machine.bearings, seed)]
        told += ["model=constant"] if case != "default" else []
        told += ["identify.usual_tolerances=false"] if case in ("exact", "seal") else []
        for node, _ in machine.seal:
            told += [f"identify.seal_nodes=[{node}]", f"identify.model_parameters.added_mass={machine.carried:.1g}"]
        refused = identify(folder, told)
        judged = (
            {"coefficients": []}
            if refused
            else judge(folder, machine.bearings)
            | judge_supports(folder, machine.supports)
            | judge_masses(folder, machine)
        )
        write_json(done, {"refused": refused} | judged)
    return dict(json.loads(done.read_text(encoding="utf-8")))


def state_sizes(bearings: BearingTable, seed: int) -> list[str]:
    """What its user knows of the bearings: the size of their direct coefficients, off by a factor e in the mean."""
    generator, direct = np.random.default_rng([seed, 33]), bearings.values[:, :, [0, 3, 4, 7]]
    sizes = np.exp(np.log(np.abs(direct)).mean(axis=(0, 1)).reshape(2, 2).mean(axis=1) + generator.standard_normal(2))
    keys = ("known_stiffness", "known_damping")
    return [f"identify.{key}={size:.1g}" for key, size in zip(keys, sizes, strict=True)]


def judge_supports(folder: Path, supports: list[dict[str, Any]]) -> dict[str, Any]:
    """A row for each number of a support; a band is that of the logarithm, as it was fitted."""
    training = json.loads((folder / "answer" / "training.json").read_text(encoding="utf-8"))
    rows = []
    for support in supports:
        for kind, letter in KINDS.items():
            for direction in "xy":
                name, real = f"{kind} node {support['node']} {direction}", support[letter + 2 * direction]
                fitted = training["model_parameters"][name]
                off = math.log(fitted["number"] / real)
                rows.append(
                    {
                        "number": name,
                        "within": bool(abs(off) <= NOMINAL_95 * fitted["deviation"]),
                        "error_percent": 100 * abs(math.expm1(off)),
                        "half_width_percent": 100 * NOMINAL_95 * fitted["deviation"],
                    }
                )
    return {"supports": rows}


def judge_masses(folder: Path, machine: Grounded) -> dict[str, Any]:
    """A row for each mass of a seal, in percent of its direct ones."""
    training = json.loads((folder / "answer" / "training.json").read_text(encoding="utf-8"))
    rows = []
    for node, added in machine.seal:
        for axes in ("xx", "xy", "yx", "yy"):
            name = f"added_mass m{axes} node {node}"
            fitted = training["model_parameters"][name]
            error, deviation = abs(fitted["value"] - added * (axes in ("xx", "yy"))), fitted["deviation"]
            rows.append(
                {
                    "number": name,
                    "within": bool(error <= NOMINAL_95 * deviation),
                    "error_percent": 100 * error / added,
                    "half_width_percent": 100 * NOMINAL_95 * deviation / added,
                }
            )
    return {"masses": rows}


def summarize_masses(machines: Sequence[dict[str, Any]]) -> dict[str, float]:
    """Of the machines of a case; nothing where no machine has a seal."""
    rows = [row for machine in machines if machine["coefficients"] for row in machine["masses"]]
    if not rows:
        return {}
    return {
        "masses": len(rows),
        "masses_within_percent": 100 * float(np.mean([row["within"] for row in rows])),
        "masses_error_percent": float(np.median([row["error_percent"] for row in rows])),
        "masses_half_width_percent": float(np.median([row["half_width_percent"] for row in rows])),
    }


def summarize_supports(machines: Sequence[dict[str, Any]]) -> dict[str, float]:
    """Of the machines of a case; *told* are numbers whose band is below a quarter."""
    each = [machine["supports"] for machine in machines if machine["coefficients"]]
    rows = [row for supports in each for row in supports]
    told = [row for row in rows if row["half_width_percent"] < 25]
    return {
        "supports_within_percent": 100 * float(np.mean([row["within"] for row in rows])),
        "lowest_supports_percent": 100 * min(float(np.mean([row["within"] for row in s])) for s in each),
        "numbers": len(rows),
        "told": len(told),
        "told_within_percent": 100 * float(np.mean([row["within"] for row in told])),
        "told_error_percent": float(np.median([row["error_percent"] for row in told])),
        "told_half_width_percent": float(np.median([row["half_width_percent"] for row in told])),
    }


def main(arguments: list[str]) -> None:
    """Run what is asked for and write ``soft_ground.json``."""
    given = dict(argument.split("=", 1) for argument in arguments)
    first, _, last = given.get("seeds", "300-311").partition("-")
    folder, seeds = Path(given["output"]).resolve(), range(int(first), int(last or first) + 1)
    summary = {}
    with ProcessPoolExecutor(int(given.get("workers", "2"))) as pool:
        for case in given.get("cases", "exact,constant,default,seal").split(","):
            folders = [folder / "machines" / f"{case}-{seed}" for seed in seeds]
            machines = list(pool.map(run_case, folders, seeds, [case] * len(seeds)))
            summary[case] = summarize(machines) | summarize_supports(machines) | summarize_masses(machines)
            print(case, json.dumps(summary[case]), flush=True)
    write_json(folder / "soft_ground.json", summary)


if __name__ == "__main__":
    main(sys.argv[1:])
