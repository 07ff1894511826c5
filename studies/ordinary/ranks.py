"""Are real coefficients spread over their bands as the bands say? Simulation-based calibration (Talts et al. 2018).

    python studies/ordinary/ranks.py output=FOLDER [seeds=200-223] [workers=2]

What is real is drawn from the very prior of the fit: the kind of each bearing, its coefficients at the fit's nodes with
its spline between, E, the discs' mass, each weight, each probe's gain and angle, each bearing in each run and in the
baseline. Rotors, probes, weights and noise are those of draw.py, with 1 % + 0.05 um. A machine that would be unstable
is drawn again, which the prior does not know. Each is identified by the command, with nothing stated, as in
ordinary.py.

The rank of a real coefficient is the probability that its band, taken as normal, gives to a smaller one. Over all
machines, coefficients and speeds ranks are to be uniform: `ranks.json` has the share of each tenth, and the shares
inside the central 50, 80 and 95 %. Ranks of one machine hang together: machines count, not speeds.
"""

from __future__ import annotations

import json
import sys
from concurrent.futures import ProcessPoolExecutor
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import torch
from draw import Drawn, compose_real, draw_machine, is_stable
from ordinary import identify, write_user_files
from scipy.interpolate import CubicSpline
from scipy.stats import norm

from pipeline.coefficients import COEFFICIENTS
from pipeline.config.compose import compose_config
from pipeline.files import write_json
from pipeline.impedance import to_coefficients
from pipeline.laws.population import make_priors
from pipeline.parameters.model import ALWAYS_FITTED
from pipeline.rotor.stored import load_rotor
from pipeline.rotor.weight import estimate_journals, find_static_loads
from pipeline.units import RAD_S_PER_RPM


def draw_from_prior(seed: int) -> Drawn:
    """The machine of a seed with bearings and trouble from the prior of the fit."""
    drawn, generator = draw_machine(seed), np.random.default_rng([seed, 21])
    config, model = compose_real(drawn), compose_config(["model=bearings_network", "loss=response"]).model
    rpm = np.array(config.machine.speeds.rpm())
    rotor, speeds = load_rotor(config.machine.rotor), rpm * RAD_S_PER_RPM
    nodes = np.geomspace(speeds[0], speeds[-1], model.count)
    loads, journals = find_static_loads(rotor), estimate_journals(rotor)
    sizes = {name: ALWAYS_FITTED[name] * generator.standard_normal() for name in ("youngs_modulus", "disc_mass")}
    trouble = {
        "built": {name: round(float(share), 6) for name, share in sizes.items()},
        "drift": ALWAYS_FITTED["bearing_drift"],
        "gain": ALWAYS_FITTED["probe_gain"],
        "angle": float(np.degrees(ALWAYS_FITTED["probe_angle"])),
        "weight": (ALWAYS_FITTED["unbalance_magnitude"], ALWAYS_FITTED["unbalance_phase"]),
    }
    while True:
        bearings = {}
        for node, load, diameter in zip(rotor.bearing_nodes, loads, journals, strict=True):
            priors = make_priors(model.families, nodes, float(load), float(diameter))
            prior = generator.choice(np.array(priors, dtype=object))
            drawn_nodes = prior.mean + prior.root @ generator.standard_normal(prior.root.shape[1])
            between = CubicSpline(np.log(nodes), drawn_nodes.reshape(len(COEFFICIENTS), -1).T)(np.log(speeds))
            values = to_coefficients(torch.as_tensor(between), torch.as_tensor(speeds), slopes=False)[0].tolist()
            bearings[str(node)] = {
                "kind": "speed_table",
                "rows": [[at, *row] for at, row in zip(rpm.tolist(), values, strict=True)],
            }
        real = replace(drawn, bearings=bearings, trouble=trouble)
        if is_stable(real):
            return real


def rank_machine(folder: Path, seed: int) -> dict[str, list[float]]:
    """Ranks over the speed, by coefficient; read again where they were made."""
    done = folder / "ranks.json"
    if not done.exists():
        felt = write_user_files(folder, draw_from_prior(seed), 0.01, seed)
        if refused := identify(folder):
            print(f"seed {seed}: {refused}", flush=True)
            return {}
        table = pd.read_csv(folder / "answer" / "identified_coefficients.csv")
        ranks = {}
        for b, node in enumerate(felt.nodes):
            here = table[table.bearing_node == node]
            for c, name in enumerate(COEFFICIENTS):
                off = felt.values[b, :, c] - here[name].to_numpy()
                ranks[f"node {node} {name}"] = norm.cdf(off / here[f"{name}_std"].to_numpy()).tolist()
        write_json(done, ranks)
    return dict(json.loads(done.read_text(encoding="utf-8")))


def summarize(machines: list[dict[str, list[float]]]) -> dict[str, Any]:
    """Shares in percent, each machine counting alike."""
    each = [np.concatenate(list(ranks.values())) for ranks in machines if ranks]
    tenths = np.mean([np.histogram(ranks, bins=10, range=(0, 1))[0] / len(ranks) for ranks in each], axis=0)
    inside = {
        f"inside_{level}_percent": 100 * float(np.mean([np.mean(np.abs(r - 0.5) < level / 200) for r in each]))
        for level in (50, 80, 95)
    }
    return {"machines": len(each), "tenths_percent": (100 * tenths).round(1).tolist()} | inside


def main(arguments: list[str]) -> None:
    """Run the machines and write ``ranks.json``."""
    given = dict(argument.split("=", 1) for argument in arguments)
    first, _, last = given.get("seeds", "200-223").partition("-")
    folder, seeds = Path(given["output"]).resolve(), range(int(first), int(last or first) + 1)
    with ProcessPoolExecutor(int(given.get("workers", "2"))) as pool:
        machines = list(pool.map(rank_machine, [folder / "machines" / f"prior-{seed}" for seed in seeds], seeds))
    summary = summarize(machines)
    print(json.dumps(summary), flush=True)
    write_json(folder / "ranks.json", summary)


if __name__ == "__main__":
    main(sys.argv[1:])
