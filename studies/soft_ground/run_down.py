"""Unbalance and foundation from one run-down, after Sinha, Lees and Friswell (J. Sound and Vibration 272, 2004, 967).

    python studies/soft_ground/run_down.py output=FOLDER [seeds=100-111] [workers=2]

A rotor with two discs on two short bearings stands on a base whose four modes lie in the range of speeds; only the
casings' motion in x and y is measured, once, from 3000 to 300 rpm, with no weight and 1 % + 0.05 um of noise. Drawn for
each seed: frequencies of the modes, damping ratios between 1 and 4 %, modal masses about 60 kg, shapes that mix
directions and pedestals, the phases of 400 and 500 g mm on the discs. The file states the base with frequencies 6 %
off, damping ratios 0.5 in the logarithm, each participation 20 %; it states the bearings, but for the oil's viscosity,
known to a factor of 1.1.

*Response* is the relative error of the base's receptance (4 x 4) at the pedestals, over the range of speeds.
"""

from __future__ import annotations

import json
import subprocess
import sys
from concurrent.futures import ProcessPoolExecutor
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import yaml

from pipeline.config.compose import compose_config
from pipeline.data.dataset import DIRECTIONS, Excitation
from pipeline.data.excitation_files import write_excitation
from pipeline.data.sensors import NOMINAL_95, NoiseModel, project
from pipeline.data.simulate import add_noise, simulate
from pipeline.data.vibration_files import write_vibration
from pipeline.files import write_json
from pipeline.rotor.stored import load_modelled_bearings, load_rotor
from pipeline.units import RAD_S_PER_RPM

DISCS, BEARINGS, UNBALANCE = (3, 5), (1, 7), (4e-4, 5e-4)  # kg m
FREQUENCIES, PARTICIPATION = np.array([17.0, 24.0, 32.0, 41.0]), 0.13  # Hz; 1/sqrt(kg), of a modal mass of 60 kg
SHAPES = np.array(
    [[(1, 0.2), (1, 0.2)], [(0.2, 1), (0.2, 1)], [(1, -0.2), (-1, 0.2)], [(-0.2, 1), (0.2, -1)]]
)  # (modes, pedestals, directions): both along x, both along y, against each other
SHAFT = {"outer_diameter": "50 mm"}
ROTOR = {
    "shaft": [
        {"length": "100 mm", "elements": 1} | SHAFT,
        {"length": "1000 mm", "elements": 6} | SHAFT,
        {"length": "100 mm", "elements": 1} | SHAFT,
    ],
    "material": {"density": "7810 kg/m^3", "youngs_modulus": "211 GPa", "shear_modulus": "81.2 GPa"},
    "discs": [
        {"node": node, "width": "40 mm", "inner_diameter": "50 mm", "outer_diameter": "260 mm"} for node in DISCS
    ],
    "bearing_nodes": list(BEARINGS),
}
SIZES = {"journal_diameter": "50 mm", "length": "25 mm", "radial_clearance": "0.1 mm", "static_load": "250 N"}
FILM = {"kind": "cylindrical", "oil_viscosity": "0.02 Pa s"} | SIZES
SPEEDS = {"start_rpm": 300, "stop_rpm": 3000, "step_rpm": 20}
TOLD = {"support_stiffness": 0.2, "support_damping": 0.7, "base_participation": 0.04}


def write_base(frequencies: np.ndarray, damping: np.ndarray, participation: np.ndarray) -> dict[str, Any]:
    """The section of a rotor; frequencies in Hz."""
    modes = [
        {
            "frequency": f"{frequency:.5g} Hz",
            "damping_ratio": float(f"{ratio:.3g}"),
            "participation": [[float(f"{size:.3g}") for size in point] for point in shape],
        }
        for frequency, ratio, shape in zip(frequencies, damping, participation, strict=True)
    ]
    return {"points": list(BEARINGS), "modes": modes}


def write_machine(path: Path, base: dict[str, Any], **more: Any) -> None:
    """A machine file, on a base as it is or as it is stated."""
    run = {"name": "placeholder", "unbalances": [{"node": DISCS[0], "magnitude": "100 g mm"}]}
    machine = {"rotor": ROTOR | {"base": base}, "bearings": FILM, "speeds": SPEEDS, "runs": [run]}
    path.write_text(yaml.safe_dump(machine | more, sort_keys=False), encoding="utf-8")


def write_user_files(folder: Path, seed: int) -> dict[str, Any]:
    """The machine as its user has it; its base and the phases of its unbalance."""
    generator = np.random.default_rng([seed, 41])
    folder.mkdir(parents=True, exist_ok=True)
    frequencies = FREQUENCIES * np.exp(0.05 * generator.standard_normal(4))
    damping, sizes = generator.uniform(0.01, 0.04, 4), PARTICIPATION * np.exp(0.2 * generator.standard_normal(4))
    participation = sizes[:, None, None] * (SHAPES + 0.2 * generator.standard_normal(SHAPES.shape))
    phases = generator.uniform(0, 2 * np.pi, 2)
    real = write_base(frequencies, damping, participation)
    write_machine(folder / "real.yaml", real)
    machine = compose_config([f"machine.file={folder / 'real.yaml'}", "tracking=none"]).machine
    rotor, speeds = load_rotor(machine.rotor), np.array(machine.speeds.rpm()) * RAD_S_PER_RPM
    bearings = load_modelled_bearings(machine.rotor, machine.bearings, speeds)
    unbalance = zip(DISCS, UNBALANCE, phases, strict=True)
    data = simulate(rotor, bearings, tuple(Excitation("run_down", "unbalance", *one) for one in unbalance))
    casings = range(rotor.n_nodes, rotor.n_places)
    data = project(data, tuple((node, angle) for node in casings for angle in DIRECTIONS.values()))
    data = add_noise(data, NoiseModel(5e-8, 0.01).deviation(data.displacement), generator)
    write_vibration(folder / "vibration.csv", data)
    # Nothing is known of the unbalance: a run without any weight has an unbalance of zero.
    nothing = Excitation("run_down", "unbalance", DISCS[0], 0.0, 0.0)
    write_excitation(folder / "excitation.csv", replace(data, excitations=(nothing,)))
    stated = write_base(
        frequencies * np.exp(0.06 * generator.standard_normal(4)),
        damping * np.exp(0.5 * generator.standard_normal(4)),
        participation * (1 + 0.2 * generator.standard_normal(SHAPES.shape)),
    )
    laws = {
        "oil": {"law": "constant", "viscosity": {"guess": "0.02 Pa s", "within": 1.1}},
        "bearings": {node: {"kind": "short_journal"} | SIZES for node in BEARINGS},
    }
    files = {"vibration": "vibration.csv", "excitation": "excitation.csv"}
    write_machine(folder / "machine.yaml", stated, data=files, laws=laws)
    return {"base": real, "stated": stated, "phases": phases.tolist()}


def identify(folder: Path) -> str:
    """By the command; its last line where it refuses, else nothing."""
    told = [f"identify.model_parameters.{kind}={size}" for kind, size in TOLD.items()]
    told += ["identify.known_within=3", f"identify.unbalance_planes=[{DISCS[0]},{DISCS[1]}]"]
    machine = [f"machine.file={folder / 'machine.yaml'}", "model=law", "loss=response", "training=to_the_minimum"]
    command = [sys.executable, "-m", "pipeline", "stage=[diagnose,train]", *machine, *told]
    ended = subprocess.run(
        [*command, f"output={folder / 'answer'}", "tracking=none"], capture_output=True, text=True, check=False
    )
    (folder / "said.txt").write_text(ended.stdout + ended.stderr, encoding="utf-8")
    return "" if ended.returncode == 0 else (ended.stderr.strip().splitlines() or ["no word"])[-1]


def receptance(base: dict[str, Any], fitted: dict[str, Any] | None = None) -> np.ndarray:
    """(S, 4, 4) of the pedestals in m/N over the range of speeds: as it is written, or with the ``fitted`` numbers."""
    w = np.arange(SPEEDS["start_rpm"], SPEEDS["stop_rpm"] + 1, 5) * RAD_S_PER_RPM
    total = np.zeros((len(w), 4, 4), dtype=complex)
    for r, mode in enumerate(base["modes"], 1):
        natural, shape = 2 * np.pi * float(mode["frequency"].split()[0]), np.ravel(mode["participation"])
        stiffness, damping = natural**2, 2 * mode["damping_ratio"] * natural
        if fitted:
            places = [f"node {node} {direction}" for node in (9, 10) for direction in "xy"]
            shape = shape + [fitted[f"base_participation mode {r} at {place}"]["value"] for place in places]
            stiffness *= np.exp(fitted[f"support_stiffness mode {r}"]["value"])
            damping *= np.exp(fitted[f"support_damping mode {r}"]["value"])
        total += np.outer(shape, shape) / (stiffness - w**2 + 1j * w * damping)[:, None, None]
    return total


def judge(folder: Path, truth: dict[str, Any]) -> dict[str, Any]:
    """Errors of unbalance and foundation; whether the unbalance lies in its 95 % circle."""
    import pandas as pd

    training = json.loads((folder / "answer" / "training.json").read_text(encoding="utf-8"))
    table = pd.read_csv(folder / "answer" / "residual_unbalance.csv")
    real = np.array(UNBALANCE) * np.exp(1j * np.array(truth["phases"]))
    found = (table.magnitude * np.exp(1j * np.radians(table.phase_deg))).to_numpy()
    as_is, as_fitted = receptance(truth["base"]), receptance(truth["stated"], training["model_parameters"])
    off = np.linalg.norm(as_fitted - as_is, axis=(1, 2)) / np.linalg.norm(as_is, axis=(1, 2))
    chi_square = training["fit"]["chi_square"]
    return {
        "chi_square_over_expected": chi_square["value"] / chi_square["expected"],
        "unbalance_percent": (100 * np.abs(np.abs(found / real) - 1)).tolist(),
        "unbalance_deg": np.degrees(np.abs(np.angle(found / real))).tolist(),
        "magnitude_within": (np.abs(np.abs(found) - np.abs(real)) <= NOMINAL_95 * table.magnitude_std).tolist(),
        "response_median_percent": 100 * float(np.median(off)),
        "response_largest_percent": 100 * float(off.max()),
    }


def run(folder: Path, seed: int) -> dict[str, Any]:
    """One machine, from drawing to judging; read again where it is done."""
    done = folder / "judged.json"
    if not done.exists():
        truth = write_user_files(folder, seed)
        refused = identify(folder)
        write_json(done, {"seed": seed} | ({"refused": refused} if refused else judge(folder, truth)))
    return dict(json.loads(done.read_text(encoding="utf-8")))


def main(arguments: list[str]) -> None:
    """Run the machines and write ``run_down.json``: each, and the worst."""
    given = dict(argument.split("=", 1) for argument in arguments)
    first, _, last = given.get("seeds", "100-111").partition("-")
    folder, seeds = Path(given["output"]).resolve(), range(int(first), int(last or first) + 1)
    with ProcessPoolExecutor(int(given.get("workers", "2"))) as pool:
        machines = list(pool.map(run, [folder / f"run_down-{seed}" for seed in seeds], seeds))
    for machine in machines:
        print(json.dumps(machine), flush=True)
    write_json(folder / "run_down.json", machines)


if __name__ == "__main__":
    main(sys.argv[1:])
