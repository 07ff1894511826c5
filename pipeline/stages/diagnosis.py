"""What the data determine, from them alone: what several stages ask before a fit, and `diagnose` writes down."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from pipeline.coefficients import COEFFICIENTS
from pipeline.config.schema import Config
from pipeline.equations.identifiability import Identifiability, Verdict, identifiability
from pipeline.equations.least_squares import per_speed_least_squares
from pipeline.equations.noise import least_squares_deviation, residual_covariance, sensor_deviation, whitened
from pipeline.equations.response import expansion
from pipeline.equations.unknown_system import UnknownSystem, unknown_system
from pipeline.identification.response_identifiability import response_account
from pipeline.identification.response_start import differences
from pipeline.identification.training import initial_guess, setup_of
from pipeline.reporting.console import say
from pipeline.rotor.bearing_table import BearingTable
from pipeline.stages.inputs import Inputs
from pipeline.stages.response import equations_of, prepared_response
from pipeline.unknowns import UnknownSet, unknown_set


@dataclass(frozen=True, eq=False)
class Diagnosis:
    """Everything that is known of the fit before it is done. Legend: B bearings, S speeds."""

    accounts: tuple[Identifiability, ...]
    answer: BearingTable  # least squares of each speed by itself, or a guess: sizes to compare the deviations with
    deviation: np.ndarray  # (B, S, 8) standard deviation of it, N/m and N s/m; NaN where nothing is identified
    by_least_squares: bool = True  # what the deviation is of; else of the network's fit

    def relative(self, node: int) -> dict[str, np.ndarray]:
        """Coefficient -> (S,) standard deviation over size."""
        b = self.answer.nodes.index(node)
        size = np.abs(self.answer.values[b])
        return {
            name: np.divide(self.deviation[b, :, c], size[:, c], out=np.full(len(size), np.inf), where=size[:, c] > 0)
            for c, name in enumerate(COEFFICIENTS)
            if not np.isnan(self.deviation[b, :, c]).all()
        }

    def worst(self, account: Identifiability) -> tuple[str, float]:
        """The coefficient of a bearing with the largest deviation, and that over its size, median over speed."""
        medians = {
            f"{name} at node {node}" if len(account.nodes) > 1 else name: float(np.median(values))
            for node in account.nodes
            for name, values in self.relative(node).items()
        }
        name = max(medians, key=lambda key: medians[key])
        return name, medians[name]


def diagnose(config: Config, inputs: Inputs) -> Diagnosis:
    """From the data alone; no modelled coefficient is read."""
    if config.loss.kind == "response":
        return _by_response(config, inputs)
    identify, equations, known = config.identify, inputs.equations, inputs.known
    unknowns = unknown_set({node: identify.at(node) for node in equations.bearing_nodes})
    system = unknown_system(equations, unknowns, known)
    alike = identify.tie_bearings
    accounts = identifiability(equations, system, alike, config.model.kind == "constant")
    answer = _solved(system.alike() if alike else system, known, system)
    noise = sensor_deviation(inputs.dataset, config.stated_noise.additive, config.stated_noise.multiplicative)
    covariance = residual_covariance(inputs.rotor, inputs.dataset, answer, noise)
    spread = least_squares_deviation(whitened(system, covariance, alike))
    return Diagnosis(accounts, answer, _of_coefficients(spread, unknowns, known))


def _of_coefficients(spread: np.ndarray, unknowns: UnknownSet, known: BearingTable) -> np.ndarray:
    """(B, S, 8) from the deviation of the unknowns (M, S, U); NaN where nothing is identified."""
    spread = np.broadcast_to(spread, (len(known.nodes), *spread.shape[1:]))
    # Each coefficient follows one unknown, with a sign that no deviation has. 0 x inf would be NaN.
    follows = np.abs(unknowns.expansion).argmax(axis=2)  # (B, 8)
    deviation = np.take_along_axis(spread, follows[:, None, :], axis=2)
    return np.where(unknowns.identified[:, None], deviation, np.nan)


def _by_response(config: Config, inputs: Inputs) -> Diagnosis:
    """From the forces at the bearings where the sensors tell them, and else from the response's own derivative."""
    known, setup = inputs.known, setup_of(config)
    unknowns = unknown_set({node: config.identify.at(node) for node in known.nodes})
    alike = config.identify.tie_bearings
    equations, displacement = equations_of(config, inputs), inputs.dataset.displacement
    noise = sensor_deviation(inputs.dataset, config.stated_noise.additive, config.stated_noise.multiplicative)
    if equations.planes:
        equations, displacement, noise = differences(equations, displacement, noise)
    expanded = expansion(equations, displacement, noise)
    if expanded is None:
        found = response_account(prepared_response(config, inputs, setup), initial_guess(setup, unknowns.names, 1))
        table = known.at(np.flatnonzero(np.isin(known.speeds, found.account.speeds)))
        answer = table.with_unknowns(unknowns, found.values)
        return Diagnosis((found.account,), answer, _of_coefficients(found.deviation, unknowns, table), False)
    system = unknown_system(expanded.equations, unknowns, known)
    accounts = identifiability(expanded.equations, system, alike, config.model.kind == "constant")
    answer = _solved(system.alike() if alike else system, known, system)
    covariance = expanded.residual_covariance(equations, answer)
    spread = least_squares_deviation(whitened(system, covariance, alike))
    return Diagnosis(accounts, answer, _of_coefficients(spread, unknowns, known))


def _solved(solvable: UnknownSystem, known: BearingTable, system: UnknownSystem) -> BearingTable:
    values, _ = per_speed_least_squares(solvable)
    return known.with_unknowns(system.unknowns, values)


def noise_words(config: Config) -> str:
    """The stated noise, such as ``0.1 % noise``."""
    noise = config.stated_noise
    parts = [f"{100 * noise.multiplicative:g} %"] if noise.multiplicative else []
    parts += [f"{1e6 * noise.additive:g} um"] if noise.additive else []
    return " and ".join(parts) + " noise"


def say_diagnosis(config: Config, inputs: Inputs) -> Diagnosis:
    """A line a bearing, before a fit."""
    diagnosis = diagnose(config, inputs)
    for account in diagnosis.accounts:
        text = account.sentence
        if account.verdict is not Verdict.NOT_IDENTIFIABLE:
            name, deviation = diagnosis.worst(account)
            method = "least squares" if diagnosis.by_least_squares else "the network"
            text += (
                f"; condition number {np.median(account.condition):.2g} (worst {account.condition.max():.2g}); at "
                f"{noise_words(config)} {method} gives {name} to {100 * deviation:.2g} %"
            )
        say(f"{config.name}: {text}")
    return diagnosis
