"""Do the 95 % bands hold on ordinary machines, by the path that users take? Machines of draw.py, identified from files.

    python studies/ordinary/ordinary.py output=FOLDER [seeds=0-11] [workers=2] [cases=NAME,...]

Each machine is written as its user has it: a machine file that states rotor and runs, and two tables of vibration and
excitation. `stage=[diagnose,train,verdict]` reads them with nothing stated beside; nothing of what is silently wrong
reaches it. Then, and only then, its files are held against the real coefficients. Seeds 0 to 11 are there to choose a
method by; others judge it. A machine that is done is not done again; the summary is `ordinary.json`.

What is counted, pointwise over the speed: *within* is the share of speeds at which the real coefficient lies inside the
exported 95 % band; a machine's figure is the mean over its sixteen coefficients. *Half width* and *error* are those of
direct coefficients whose half width is below 100 % (what data decide), medians in percent of the real value, or of
a twentieth of the direct coefficients where it is less. A "good" coefficient is *wrong* where its median error exceeds
20 % or the median band. *Usable* is not called "no". *Expected* are coefficients whose deviation the diagnosis, which
comes before the fit, has within a factor of 1.5.
"""

from __future__ import annotations

import json
import math
import subprocess
import sys
from collections.abc import Mapping, Sequence
from concurrent.futures import ProcessPoolExecutor
from pathlib import Path
from typing import Any

import numpy as np
import yaml
from draw import TROUBLE, Drawn, draw_machine, measure_machine

from pipeline.coefficients import COEFFICIENTS
from pipeline.data.excitation_files import write_excitation
from pipeline.data.sensors import NOMINAL_95
from pipeline.data.vibration_files import write_vibration
from pipeline.files import write_json
from pipeline.rotor.bearing_table import BearingTable

CASES: dict[str, tuple[str, float, str]] = {
    "half_percent": ("0.02 um", 0.005, "none"),
    "one_percent": ("0.05 um", 0.01, "none"),
    "two_percent": ("0.05 um", 0.02, "none"),
    "four_percent": ("0.2 um", 0.04, "none"),
    "floor_alone": ("0.5 um", 0.001, "none"),
    "share_alone": ("0.002 um", 0.03, "none"),
    **{trouble: ("0.05 um", 0.01, trouble) for trouble in TROUBLE if trouble != "none"},
}
"""Name -> the floor of a reading, its share, and what is silently wrong."""
PLACEHOLDER = {
    "kind": "cylindrical", "journal_diameter": "60 mm", "length": "30 mm",
    "radial_clearance": "0.08 mm", "oil_viscosity": "0.05 Pa s",
}  # fmt: skip
"""As `stage=new` writes it: which film it is, or none, nobody says."""
DIRECT = ("kxx", "kyy", "cxx", "cyy")


def write_user_files(folder: Path, drawn: Drawn, noise: float, seed: int) -> BearingTable:
    """The machine as its user has it; the coefficients as the shaft feels them."""
    data, felt = measure_machine(drawn, noise, seed)
    folder.mkdir(parents=True, exist_ok=True)
    write_vibration(folder / "vibration.csv", data)
    write_excitation(folder / "excitation.csv", data)
    stated = {key: value for key, value in drawn.stated.items() if key not in ("probes", "runs")}
    stated["runs"] = [run for run in drawn.stated["runs"] if len(run) > 1]
    stated["bearings"] = PLACEHOLDER
    stated["data"] = {"vibration": "vibration.csv", "excitation": "excitation.csv", "baseline": "as_found"}
    (folder / "machine.yaml").write_text(yaml.safe_dump(stated, sort_keys=False), encoding="utf-8")
    return felt


def identify(folder: Path, told: Sequence[str] = ()) -> str:
    """By the command; its last line where it refuses, else nothing."""
    answer = folder / "answer"
    command = [
        sys.executable,
        "-m",
        "pipeline",
        "stage=[diagnose,train,verdict]",
        f"machine.file={folder / 'machine.yaml'}",
        *told,
    ]
    ended = subprocess.run(
        [*command, f"output={answer}", "tracking=none", "threads=1"], capture_output=True, text=True, check=False
    )
    (folder / "said.txt").write_text(ended.stdout + ended.stderr, encoding="utf-8")
    return "" if ended.returncode == 0 else (ended.stderr.strip().splitlines() or ["no word"])[-1]


def judge(folder: Path, felt: BearingTable) -> dict[str, Any]:
    """The program's answer of a machine beside its real coefficients."""
    import pandas as pd

    table = pd.read_csv(folder / "answer" / "identified_coefficients.csv")
    verdicts = json.loads((folder / "answer" / "verdicts.json").read_text(encoding="utf-8"))
    said = {(entry["node"], entry["coefficient"]): entry["verdict"] for entry in verdicts["verdicts"]}
    each = [table[table.bearing_node == node] for node in felt.nodes]
    values = np.stack([part[list(COEFFICIENTS)].to_numpy() for part in each])
    band = NOMINAL_95 * np.stack([part[[f"{name}_std" for name in COEFFICIENTS]].to_numpy() for part in each])
    words = [[said[node, name] for name in COEFFICIENTS] for node in felt.nodes]
    rows = compare(felt, values, values - band, values + band, words)
    before, after = (_read_deviations(folder / "answer" / f"{name}.json") for name in ("diagnosis", "training"))
    expected = [abs(math.log(after[key] / before[key])) < math.log(1.5) for key in said]
    return {
        "machine": verdicts["machine"]["verdict"],
        "coefficients": [row | {"expected": right} for row, right in zip(rows, expected, strict=True)],
    }


def _read_deviations(path: Path) -> dict[tuple[int, str], float]:
    determined = json.loads(path.read_text(encoding="utf-8"))["determined"]["coefficients"]
    return {
        (int(node), name): number["deviation_percent"]
        for node, coefficients in determined.items()
        for name, number in coefficients.items()
    }


def compare(
    felt: BearingTable, values: np.ndarray, low: np.ndarray, high: np.ndarray, words: list[list[str]]
) -> list[dict[str, Any]]:
    """A row a coefficient; values and ends of the bands are (B, S, 8)."""
    rows = []
    for b, node in enumerate(felt.nodes):
        for c, name in enumerate(COEFFICIENTS):
            real, band = felt.values[b, :, c], (high - low)[b, :, c] / 2
            error = np.abs(values[b, :, c] - real)
            # One that is nothing beside the direct coefficients of its bearing is compared with these.
            beside = np.sqrt(np.abs(felt.values[b, :, c - c % 4] * felt.values[b, :, c - c % 4 + 3]))
            size = np.maximum(np.abs(real), 0.05 * beside)
            inside = (real >= low[b, :, c]) & (real <= high[b, :, c])
            error_percent, half_width = (100 * float(np.median(part / size)) for part in (error, band))
            rows.append(
                {
                    "coefficient": f"node {node} {name}",
                    "verdict": words[b][c],
                    "within_percent": 100 * float(np.mean(inside)),
                    "error_percent": error_percent,
                    "half_width_percent": half_width,
                    "wrong": bool(error_percent > min(20.0, half_width)),
                }
            )
    return rows


def run_case(folder: Path, seed: int, case: str) -> dict[str, Any]:
    """One machine, from drawing to judging; read again where it is done."""
    done = folder / "judged.json"
    if not done.exists():
        floor, noise, trouble = CASES[case]
        drawn = draw_machine(seed, floor, trouble)
        felt = write_user_files(folder, drawn, noise, seed)
        refused = "" if (folder / "answer" / "verdicts.json").exists() else identify(folder)
        write_json(done, {"refused": refused, "coefficients": []} if refused else judge(folder, felt))
    return dict(json.loads(done.read_text(encoding="utf-8")))


def summarize(machines: Sequence[Mapping[str, Any]]) -> dict[str, float]:
    """Of the machines of a case."""
    answered = [machine for machine in machines if machine["coefficients"]]
    within = [np.mean([row["within_percent"] for row in machine["coefficients"]]) for machine in answered]
    rows = [row for machine in answered for row in machine["coefficients"]]
    usable = [row for row in rows if row["verdict"] != "no"]
    good = [row for row in rows if row["verdict"] == "good"]
    direct = [row for row in rows if row["coefficient"].split()[-1] in DIRECT and row["half_width_percent"] < 100]
    accurate = [row for row in rows if row["error_percent"] < 5]

    def median(key: str) -> float:
        return float(np.median([row[key] for row in direct])) if direct else 0.0

    return {
        "machines": len(machines),
        "refused": len(machines) - len(answered),
        "within_percent": float(np.mean(within)) if within else 0.0,
        "lowest_machine_percent": float(np.min(within)) if within else 0.0,
        "usable": len(usable),
        "usable_below_85_percent": sum(row["within_percent"] < 85 for row in usable),
        "lowest_usable_percent": float(np.min([row["within_percent"] for row in usable])) if usable else 100.0,
        "half_width_percent": median("half_width_percent"),
        "error_percent": median("error_percent"),
        "good": len(good),
        "good_and_wrong": sum(row["wrong"] for row in good),
        "expected_percent": 100 * float(np.mean([row["expected"] for row in rows])) if rows else 0.0,
        "accurate": len(accurate),
        "accurate_and_usable": sum(row["verdict"] != "no" for row in accurate),
    }


def main(arguments: list[str]) -> None:
    """Run what is asked for and write ``ordinary.json``: the summary of each case."""
    given = dict(argument.split("=", 1) for argument in arguments)
    first, _, last = given.get("seeds", "0-11").partition("-")
    seeds = range(int(first), int(last or first) + 1)
    cases = given["cases"].split(",") if "cases" in given else list(CASES)
    folder = Path(given["output"]).resolve()
    tasks = [(case, seed) for case in cases for seed in seeds]
    # Processes: configurations are composed one at a time in each.
    with ProcessPoolExecutor(int(given.get("workers", "2"))) as pool:
        folders = [folder / "machines" / f"{case}-{seed}" for case, seed in tasks]
        judged = pool.map(run_case, folders, [seed for _, seed in tasks], [case for case, _ in tasks])
        results: dict[str, list[dict[str, Any]]] = {}
        for (case, seed), machine in zip(tasks, judged, strict=True):
            results.setdefault(case, []).append(machine)
            print(f"{case}, seed {seed}: {json.dumps(summarize([machine]))}", flush=True)
    write_json(folder / "ordinary.json", {case: summarize(machines) for case, machines in results.items()})


if __name__ == "__main__":
    main(sys.argv[1:])
