"""What data determine of the physical numbers of bearing laws; before any fit: Cramer-Rao at the guesses.

Each reading tells of the numbers by its derivative over its noise; residual unbalance and uncertain numbers of the
model are sought beside them. Numbers that only a product of shows, such as viscosity over load, stay at their priors,
and what is free is a combination of them.

Legend: S operating points, P channels, R runs, B bearings, A active unknowns, Th numbers (theta, the logarithm of each
over its guess), N balance planes, T model parameters, Z = Th + 2 N + T.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from pipeline.coefficients import COEFFICIENTS
from pipeline.data.operating import split_states
from pipeline.errors import IdentifiabilityError
from pipeline.laws.law_set import LawSet
from pipeline.laws.numbers import OIL_TEMPERATURE, LawParameter
from pipeline.problem.measurement import Measurement
from pipeline.problem.ranking import list_leading, rank_indices
from pipeline.problem.slopes import ReadingSlopes, invert, prior_information
from pipeline.rotor.bearing_table import BearingTable

FURTHER = 15.0
"""K that one more oil temperature lies above the highest one."""


@dataclass(frozen=True, eq=False)
class LawInformation:
    """What is known of theta with the readings and the priors."""

    parameters: tuple[LawParameter, ...]  # Th
    covariance: np.ndarray  # (Th, Th) of theta
    untold: float = 0.5  # share of its prior deviation, from which on a number is not told by the data
    leading: float = 0.2  # share in a combination, below which a number is not named

    @property
    def prior(self) -> np.ndarray:
        """(Th,) deviations before the data."""
        return np.array([parameter.deviation for parameter in self.parameters])

    @property
    def deviation(self) -> np.ndarray:
        """(Th,) standard deviation of each number over itself."""
        return np.asarray(np.sqrt(np.diag(self.covariance)))

    @property
    def determined(self) -> np.ndarray:
        """(Th,) bool: whether the readings tell it."""
        return np.asarray(self.deviation < self.untold * self.prior)

    @property
    def free(self) -> tuple[dict[str, float], ...]:
        """The combinations that the readings leave at their priors: shares of a unit vector in prior deviations.

        The largest share is positive. Numbers that share in one may each be told by halves. No
        combination has the number that leads another.
        """
        left, vectors = np.linalg.eigh(self.covariance / np.outer(self.prior, self.prior))
        open_ = vectors[:, left >= self.untold**2]
        count = open_.shape[1]
        if not count:
            return ()
        first = _choose_leaders(open_)
        combinations = []
        for direction in np.linalg.solve(open_[first].T, open_.T):
            shares = direction / np.linalg.norm(direction)
            by_name = {parameter.name: float(share) for parameter, share in zip(self.parameters, shares, strict=True)}
            combinations.append(list_leading(by_name, self.leading))
        return tuple(combinations)


def _choose_leaders(directions: np.ndarray) -> list[int]:
    """The rows of ``directions`` (Th, F) that F combinations are told by: QR with pivoting, and ties by place."""
    rest, chosen = directions.copy(), []
    for _ in range(directions.shape[1]):
        chosen.append(rank_indices((rest**2).sum(axis=1))[0])
        unit = rest[chosen[-1]] / np.linalg.norm(rest[chosen[-1]])
        rest = rest - np.outer(rest @ unit, unit)
    return sorted(chosen)


def inform(*measurements: Measurement) -> LawInformation:
    """What all readings tell of the numbers of the laws. Raises DataError for a condition that is missing."""
    numbers, every = measurements[0].laws.parameters, [law_rows(measurement) for measurement in measurements]
    rows = np.concatenate([rows.reshape(-1, rows.shape[-1]) for rows in every])
    prior = prior_information(measurements[0], np.array([number.deviation**-2 for number in numbers]))
    covariance = invert((rows.conj().T @ rows).real + np.diag(prior))
    return LawInformation(numbers, covariance[: len(numbers), : len(numbers)])


def law_rows(measurement: Measurement) -> np.ndarray:
    """(S, P, R, Z) complex derivative of the readings over their noise."""
    data, unknowns = measurement.dataset, measurement.unknowns
    values, slopes = _evaluate(measurement.laws, data.speeds, data.operating)
    leaders = [COEFFICIENTS.index(name) for name in unknowns.names]
    active = np.stack([slopes[m, :, leaders[u]] for m, u in unknowns.active], axis=1)  # (S, A, Th)
    return ReadingSlopes(measurement, measurement.table(unknowns.leading(values))).rows(active)


def _evaluate(laws: LawSet, speeds: np.ndarray, operating: Mapping[str, np.ndarray]) -> tuple[np.ndarray, np.ndarray]:
    """(B, S, 8) coefficients of the laws at their guesses, and (B, S, 8, Th) slopes by theta."""
    import torch

    theta = torch.zeros(1, len(laws.parameters), dtype=torch.float64)
    values, slopes = laws.coefficients(theta, speeds, operating)
    return values[0].numpy(), slopes[0].numpy()


def guess_table(laws: LawSet, speeds: np.ndarray, operating: Mapping[str, np.ndarray]) -> BearingTable:
    """The coefficients of the laws at their guesses, at ``speeds`` (S,) rad/s and ``operating`` conditions (S,)."""
    return BearingTable(laws.nodes, speeds, _evaluate(laws, speeds, operating)[0], dict(operating))


def at_state(measurement: Measurement, operating: Mapping[str, np.ndarray]) -> Measurement:
    """The same runs at other ``operating`` conditions (S,), read as the laws at their guesses foretell."""
    data = replace(measurement.dataset, operating=dict(operating))
    known, response = replace(measurement.known, operating=dict(operating)), measurement.response
    values = guess_table(measurement.laws, data.speeds, operating).values
    bearings = known.with_unknowns(measurement.unknowns, measurement.unknowns.leading(values))
    shown = np.where(data.present[:, None], response.predict(bearings), 0.0)
    return replace(measurement, dataset=replace(data, displacement=shown), known=known, solved=response)


def try_warmer(measurement: Measurement) -> tuple[np.ndarray, LawInformation] | None:
    """One more oil temperature, in K (one value a point), and the information with it; None where none is asked for.

    The readings of the warmest state are repeated :data:`FURTHER` above it.
    """
    data = measurement.dataset
    if OIL_TEMPERATURE not in measurement.laws.inputs:
        return None
    lines = [points for _, points in split_states(data.speeds, data.operating)]
    points = np.sort(max(lines, key=lambda line: float(data.operating[OIL_TEMPERATURE][line].mean())))
    warmest = measurement.select(points)
    warmer = warmest.dataset.operating[OIL_TEMPERATURE] + FURTHER
    more = at_state(warmest, {**warmest.dataset.operating, OIL_TEMPERATURE: warmer})
    return warmer, inform(measurement, more)


def require_temperatures(laws: LawSet, operating: Mapping[str, np.ndarray], same_oil: float = 0.01) -> None:
    """Raise IdentifiabilityError where the oil temperatures (S,) in K leave a number of the oil unread.

    What changes the viscosity by less than the share ``same_oil`` anywhere can't be read from it.
    """
    import torch

    oil = [i for i, parameter in enumerate(laws.parameters) if parameter.name.startswith("oil.")]
    if laws.oil is None or not laws.oil.needs_temperature or not oil or OIL_TEMPERATURE not in operating:
        return
    temperature = np.asarray(operating[OIL_TEMPERATURE], dtype=float)
    theta = torch.zeros(1, len(laws.parameters), dtype=torch.float64)
    slopes = laws.oil.log_viscosity(theta, torch.from_numpy(temperature.copy()))[1][0, :, oil].numpy()
    singular = np.linalg.svd(slopes / np.sqrt(len(slopes)), compute_uv=False)
    if len(singular) == len(oil) and singular[-1] >= same_oil:
        return
    names = [laws.parameters[i].name for i in oil]
    low, high = temperature.min() - 273.15, temperature.max() - 273.15
    came = f"all readings are at {low:.4g} degC" if high - low < 1 else f"they are at {low:.4g} to {high:.4g} degC"
    needed = "two" if len(oil) < 3 else "three"
    raise IdentifiabilityError(
        f"{' and '.join(names)} must be read from {needed} oil temperatures or more, but {came}: measure at a further "
        f"oil temperature, {FURTHER:g} K apart, or give {names[-1]} in machine.laws as a known number (force=true fits "
        "all the same, and leaves to the guess what the data do not tell)"
    )


def summarize_numbers(information: LawInformation, further: np.ndarray | None) -> dict[str, dict[str, Any]]:
    """By name, SI; ``further`` (Th,) percent, with one more oil temperature."""
    warmer = {} if further is None else {f"deviation_percent_{FURTHER:g}_K_warmer": further}
    return {
        parameter.name: {
            "guess": parameter.guess,
            "value": parameter.guess,
            "deviation": float(parameter.guess * information.deviation[i]),
            "unit": parameter.unit,
            "prior_percent": float(100 * information.prior[i]),
            "deviation_percent": float(100 * information.deviation[i]),
            "determined": bool(information.determined[i]),
            **{name: float(percent[i]) for name, percent in warmer.items()},
        }
        for i, parameter in enumerate(information.parameters)
    }


def describe_open(information: LawInformation) -> list[str]:
    """A sentence on each combination of numbers that stays at its prior; none where all is told."""
    said = []
    for free in information.free:
        with_, against = ([name for name, share in free.items() if (share > 0) == same] for same in (True, False))
        text = _join(with_) + (f", against {_join(against)}" if against else " together" if len(with_) > 1 else "")
        cure = "it" if len(free) == 1 else "one of them"
        said.append(f"these data do not tell {text}: give {cure} as a known number, or measure what tells it")
    return said


def _join(names: Sequence[str]) -> str:
    return f"{', '.join(names[:-1])} and {names[-1]}" if len(names) > 1 else names[0]
