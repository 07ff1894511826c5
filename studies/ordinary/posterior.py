"""Is the covariance of an answer that of its posterior? A reference by Hamiltonian Monte Carlo, for a few machines.

    python studies/ordinary/posterior.py output=FOLDER [seeds=0-3] [case=one_percent]

A machine of draw.py is fitted by `model=bearings`, as the default path does before it trains its networks. Then the
posterior of the same problem (the same readings, noise and priors, each likely choice of kinds by its share of the
evidence) is sampled with no approximation: of all weights at once, where the fit has a normal distribution about each
minimum. The noise is that of the fit. Sampling is by Hamiltonian Monte Carlo (Neal 2011, Handbook of Markov Chain Monte
Carlo, chapter 5), in coordinates in which the fit's distribution has unit variance, in chains that know nothing of each
other; `r_hat` (Gelman and Rubin 1992) is how much wider all chains together are than each half of one, at
the median coefficient and speed and at the ninetieth percentile.

`posterior.json` has for each machine, over coefficients and speeds: *held* is the share of the posterior inside the
exported 95 % band (mean, and that of the lowest coefficient); *width* is the band's half width over that of the
posterior's central 95 % (median, and the tenth and ninetieth percentile); *off* is the distance of the answer from the
posterior's median over its deviation (median).

Legend: G chains, Z weights, D draws, S speeds, A active unknowns.
"""

from __future__ import annotations

import sys
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import torch
from draw import draw_machine
from ordinary import CASES, write_user_files

from pipeline.config.compose import compose_config
from pipeline.data.sensors import NOMINAL_95
from pipeline.files import write_json
from pipeline.identification.answer import conclude
from pipeline.identification.identified import answer_of
from pipeline.identification.output_error_fit import OutputErrorFit, fit_output_error
from pipeline.identification.problem import OutputError
from pipeline.identification.training import setup_of
from pipeline.stages.measurement import load_measurement


def sample(
    problem: OutputError,
    mode: torch.Tensor,
    covariance: np.ndarray,
    generator: torch.Generator,
    chains: int = 24,
    draws: int = 1000,
    warm: int = 480,
    leaps: int = 12,
    accepted: float = 0.8,
    shrunk: float = 0.2,
) -> tuple[torch.Tensor, float]:
    """(D, G, S, A) coefficients of the posterior ``exp(-|rows|^2 / 2)``, and the share of proposals that were accepted.

    Chains start near the ``mode`` (1, 1, Z). While they warm up the step is found for the share ``accepted``; halfway
    coordinates are made anew in which what was drawn in the second quarter has unit variance, with its covariance
    ``shrunk`` to its diagonal by this share. Steps vary by a fifth, so that no path closes.
    """
    root = torch.linalg.cholesky(torch.as_tensor(covariance))
    step, shares, kept, seen = 0.5 / len(root) ** 0.25, [], [], []

    def weights(at: torch.Tensor) -> torch.Tensor:
        return mode + at @ root.mT

    def energy(at: torch.Tensor) -> torch.Tensor:
        return problem.rows(weights(at)).square().sum((1, 2)) / 2

    def slope(at: torch.Tensor) -> torch.Tensor:
        # Not exactly at the mode: model parameters that do not differ from those of the fit are left out there.
        with torch.enable_grad():
            free = at.detach().requires_grad_()
            return torch.autograd.grad(energy(free).sum(), free)[0].nan_to_num(0.0)

    def draw(like: torch.Tensor) -> torch.Tensor:
        return torch.randn(like.shape, generator=generator, dtype=torch.float64)

    z = 0.3 * draw(torch.empty(chains, 1, len(root)))
    for turn in range(warm + draws):
        momentum, ahead = draw(z), z
        begun = energy(z) + momentum.square().sum((1, 2)) / 2
        size = step * (0.8 + 0.4 * float(torch.rand(1, generator=generator, dtype=torch.float64)))
        momentum = momentum - size / 2 * slope(ahead)
        for leap in range(leaps):
            ahead = ahead + size * momentum
            momentum = momentum - (size if leap < leaps - 1 else size / 2) * slope(ahead)
        chance = (begun - energy(ahead) - momentum.square().sum((1, 2)) / 2).exp().nan_to_num(0.0).clamp(max=1.0)
        taken = torch.rand(chains, generator=generator, dtype=torch.float64) < chance
        z = torch.where(taken[:, None, None], ahead, z)
        if turn >= warm:
            shares.append(float(chance.mean()))
            kept.append(problem.unknowns(weights(z), slopes=False)[0])
            continue
        step *= float(np.exp((float(chance.mean()) - accepted) * max(0.1, (turn + 1) ** -0.6)))
        seen.append(z)
        if turn == warm // 2:
            pooled = torch.cat(seen[warm // 4 :])[:, 0].mT.cov()
            pooled = (1 - shrunk) * pooled + shrunk * torch.diag(pooled.diagonal())
            turn_to = torch.linalg.cholesky(pooled)
            root, z = root @ turn_to, torch.linalg.solve_triangular(turn_to, z.mT, upper=False).mT
    return torch.stack(kept), float(np.mean(shares))


def compare_chains(draws: np.ndarray) -> np.ndarray:
    """(S, A) of chains (D, G, S, A), D even, in halves: spread over all halves over that within (split R-hat)."""
    halves = np.concatenate(np.split(draws, 2), axis=1)
    within, between = halves.var(axis=0).mean(axis=0), halves.mean(axis=0).var(axis=0)
    return np.asarray(np.sqrt(1 + between / within))


def refer(
    fit: OutputErrorFit, value: np.ndarray, band: np.ndarray, seed: int, negligible: float = 0.02
) -> dict[str, Any]:
    """The posterior of a fit beside its answer: ``value`` and half width of the ``band``, (S, A)."""
    searched = fit.start.searched
    assert searched is not None, "model=bearings searches"
    generator = torch.Generator().manual_seed(seed)
    every, weights, ratios, accepted = [], [], [], []
    for g, share in enumerate(searched.shares.reshape(2, -1).sum(axis=0)):  # of peaks and of their middles
        if share < negligible:
            continue
        problem = replace(fit.problem, functions=searched.choices.select([g]).functions())
        mode = fit.weights if g == 0 else searched.weights[g : g + 1]
        draws, rate = sample(problem, mode, problem.covariance(mode)[0], generator)
        flat = draws.flatten(0, 1).numpy()
        every.append(flat)
        weights.append(np.full(len(flat), share / len(flat)))
        ratios.append(compare_chains(draws.numpy()))
        accepted.append(rate)
    drawn, mass = np.concatenate(every), np.concatenate(weights)
    mass = mass / mass.sum()
    order = drawn.argsort(axis=0)
    reached = mass[order].cumsum(axis=0)

    def quantile(q: float) -> np.ndarray:
        at = (reached < q).sum(axis=0).clip(max=len(drawn) - 1)
        return np.take_along_axis(drawn, np.take_along_axis(order, at[None], 0), 0)[0]

    held = np.einsum("d,dsa->sa", mass, (np.abs(drawn - value) <= band).astype(float))
    width = 2 * band / (quantile(0.975) - quantile(0.025))
    deviation = np.sqrt(np.einsum("d,dsa->sa", mass, (drawn - np.einsum("d,dsa->sa", mass, drawn)) ** 2))
    return {
        "choices": len(every),
        "r_hat": float(np.median(ratios)),
        "r_hat_90": float(np.quantile(ratios, 0.9)),
        "accepted": float(np.mean(accepted)),
        "held_percent": 100 * float(held.mean()),
        "held_lowest_percent": 100 * float(held.mean(axis=0).min()),
        "width": float(np.median(width)),
        "width_10": float(np.quantile(width, 0.1)),
        "width_90": float(np.quantile(width, 0.9)),
        "off": float(np.median(np.abs(value - quantile(0.5)) / deviation)),
    }


def run_machine(folder: Path, seed: int, case: str) -> dict[str, Any]:
    """Draw a machine, fit it, and sample the posterior of the fit."""
    floor, noise, trouble = CASES[case]
    write_user_files(folder, draw_machine(seed, floor, trouble), noise, seed)
    config = compose_config(
        [f"machine.file={folder / 'machine.yaml'}", "model=bearings", f"output={folder / 'answer'}"]
    )
    measurement, setup = load_measurement(config), setup_of(config)
    fit = fit_output_error(measurement, setup)
    fitted = conclude(fit)
    answer = answer_of(measurement, fitted.model, fitted.uncertainty)
    deviation = answer.stated.deviation
    assert deviation is not None, "the fit knows how well it knows"
    unknowns = measurement.unknowns
    value, band = (unknowns.to_active(unknowns.leading(a)) for a in (answer.table.values, NOMINAL_95 * deviation))
    return refer(fit, value[fit.start.keep], band[fit.start.keep], seed)


def main(arguments: list[str]) -> None:
    """Run the machines and write ``posterior.json``."""
    given = dict(argument.split("=", 1) for argument in arguments)
    first, _, last = given.get("seeds", "0-3").partition("-")
    folder, case = Path(given["output"]).resolve(), given.get("case", "one_percent")
    torch.set_num_threads(1)
    machines = {}
    for seed in range(int(first), int(last or first) + 1):
        machines[str(seed)] = run_machine(folder / "machines" / f"{case}-{seed}", seed, case)
        print(f"seed {seed}: {machines[str(seed)]}", flush=True)
    write_json(folder / "posterior.json", machines)


if __name__ == "__main__":
    main(sys.argv[1:])
