"""How well the modes are known: the fit's covariance, carried to eigenvalues by their derivatives; critical speeds
beyond the speeds of the data, of bearings that are constants by assumption.

With right and left vectors u and v of ``(l^2 M + l (C + W G + C_b) + K + K_b) u = 0`` an eigenvalue moves by

    dl = - v (l^2 dM + l (dC + W dG + dC_b) + dK + dK_b) u / v (2 l M + C + W G + C_b) u

(Nelson 1976; Friswell, Penny, Garvey and Lees 2010, section 6.10), which is exact to first order and costs one solution
for all numbers of the fit. Draws of the posterior would cost the eigenvalues of every speed anew, and the deviation of
the predicted vibration beside it is of first order, too.

Legend: S speeds, K modes, n DOF, B bearings, T model parameters, Z numbers of the fit.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property

import numpy as np

from pipeline.errors import ConfigError
from pipeline.identification.uncertainty import Uncertainty
from pipeline.parameters.kind import ModelParameter
from pipeline.parameters.model import rotor_change
from pipeline.problem.measurement import Measurement
from pipeline.problem.slopes import deviate
from pipeline.rotor.bearing_table import BearingTable
from pipeline.rotor.dynamic_stiffness import assemble_systems
from pipeline.rotor.interpolation import BearingPlaces, bearing_places, shaft_rows
from pipeline.rotor.model import RotorModel
from pipeline.twin.modes import (
    CriticalSpeed,
    Stability,
    StabilityMargin,
    WhirlModes,
    find_critical_speeds,
    find_modes,
    find_reached,
    judge_growth,
    measure_stability,
)


@dataclass(frozen=True, eq=False)
class ModeDeviations:
    """Standard deviations of the modes, and what those of anything that follows from them need."""

    modes: WhirlModes
    frequency: np.ndarray  # (S, K) rad/s; NaN where there is no mode
    logarithmic_decrement: np.ndarray  # (S, K)
    by_number: np.ndarray  # (S, K, Z) complex derivative of the eigenvalues, 1/s
    by_growth: np.ndarray  # (S, Z) derivative of the largest real part, 1/s
    covariance: np.ndarray  # (Z, Z)

    def of_critical(self, critical: CriticalSpeed) -> tuple[float, float]:
        """Deviations of its speed (rad/s) and of its logarithmic decrement."""
        modes, (s, k) = self.modes, critical.place
        step = modes.speeds[s + 1] - modes.speeds[s]
        share = (critical.speed - modes.speeds[s]) / step
        lines = (modes.frequency, modes.logarithmic_decrement)
        slope = [float(line[s + 1, k] - line[s, k]) / step for line in lines]
        by_value = self.by_number[[s, s + 1], k]  # (2, Z)
        by_decrement = _derive_decrement(by_value, *(line[[s, s + 1], k, None] for line in lines))
        slopes = [(1.0 - share) * ends[0] + share * ends[1] for ends in (by_value.imag, by_decrement)]
        # The crossing runs along its line until frequency and speed are equal again.
        speed = slopes[0] / (1.0 - slope[0])
        first, second = deviate(np.stack([speed, slopes[1] + slope[1] * speed]), self.covariance)
        return float(first), float(second)

    def of_margin(
        self, margin: StabilityMargin, draws: int = 400, most_damping: float = 0.5
    ) -> tuple[float, float | None]:
        """Deviations of the largest growth (1/s) and of the smallest logarithmic decrement.

        A smallest of several is no smooth function: another mode may take the place of the one that was found. So it is
        the root mean square difference from what was found, over seeded ``draws`` of all modes moved to first order
        (400 give a standard deviation to 4 %). Modes near critical damping are not among them: there an eigenvalue goes
        with the root of what it depends on, and no first order holds. Those whose damping ratio is above
        ``most_damping`` hardly oscillate: their amplification factor is below 1, and API 617 asks for no margin below
        2.5.
        """
        modes, count = self.modes, len(self.covariance)
        values, vectors = np.linalg.eigh(self.covariance)
        root = vectors * np.sqrt(np.maximum(values, 0.0))
        drawn = root @ np.random.default_rng(0).standard_normal((count, draws))
        ratio = modes.logarithmic_decrement / np.hypot(2.0 * math.pi, modes.logarithmic_decrement)
        whirling = np.abs(ratio) <= most_damping  # false for NaN
        growing = (modes.growth[:, None] + self.by_growth @ drawn).max(axis=0)
        real = modes.eigenvalues.real[whirling][:, None] + self.by_number.real[whirling] @ drawn  # (modes, draws)
        largest = np.maximum(real.max(axis=0, initial=-np.inf), growing)
        growth = math.sqrt(((largest - margin.largest_growth) ** 2).mean())
        if margin.smallest_logarithmic_decrement is None:
            return growth, None
        reached = whirling & find_reached(modes)
        reached[margin.place] = True
        by_decrement = _derive_decrement(
            self.by_number[reached],
            modes.frequency[reached][:, None],
            modes.logarithmic_decrement[reached][:, None],
        )
        smallest = (modes.logarithmic_decrement[reached][:, None] + by_decrement @ drawn).min(axis=0)
        return growth, math.sqrt(((smallest - margin.smallest_logarithmic_decrement) ** 2).mean())

    @property
    def growth(self) -> np.ndarray:
        """(S,) standard deviation of the largest real part at each speed, 1/s."""
        return deviate(self.by_growth, self.covariance)


def _derive_decrement(slopes: np.ndarray, frequency: np.ndarray, decrement: np.ndarray) -> np.ndarray:
    """The derivative of ``d = -2 pi re / im`` from that of the eigenvalue."""
    return np.asarray((-2.0 * math.pi * slopes.real - decrement * slopes.imag) / frequency)


def deviate_modes(
    modes: WhirlModes,
    measurement: Measurement,
    bearings: BearingTable,
    uncertainty: Uncertainty,
) -> ModeDeviations:
    """The deviations that the covariance of coefficients and model parameters implies, to first order.

    ``measurement`` is at the fitted model parameters, ``modes`` and ``bearings`` are those of its rotor.
    """
    by_number = uncertainty.sensitivity(bearings.speeds, bearings.operating)  # (B, S, 8, A (K + L))
    count, covariance = by_number.shape[-1], uncertainty.machine_covariance
    changes = [rotor_change(parameter, measurement.rotor) for parameter in measurement.parameters]
    steps = [parameter.slope for parameter in measurement.parameters]
    positions = [t for t, parameter in enumerate(measurement.parameters) if parameter.kind == "bearing_position"]
    values = np.concatenate([modes.eigenvalues, (modes.growth + 1j * modes.growing)[:, None]], axis=1)
    rotor = measurement.updated_rotor
    mass, damping, stiffness = assemble_systems(rotor, bearings)
    mass = np.broadcast_to(mass, stiffness.shape)
    slopes = np.full((*values.shape, len(covariance)), np.nan, dtype=complex)  # (S, K + 1, Z)
    for s, value in enumerate(values):
        present = np.flatnonzero(~np.isnan(value))
        for t in positions:
            changes[t] = derive_place(rotor, measurement.parameters[t], bearings.values[:, s])
        system = (mass[s], stiffness[s], damping[s], float(bearings.speeds[s]), bearing_places(rotor))
        by_coefficient, by_rotor = derive_eigenvalues(value[present], *system, changes)
        slopes[s, present, :count] = np.einsum("kbc,bcz->kz", by_coefficient, by_number[:, s], optimize=True)
        if changes:
            by_known = np.einsum("kbc,bct->kt", by_coefficient, measurement.known_variation[s])
            slopes[s, present, count:] = by_rotor * steps + by_known
    modal, growing = slopes[:, :-1], slopes[:, -1].real
    by_decrement = _derive_decrement(modal, modes.frequency[..., None], modes.logarithmic_decrement[..., None])
    return ModeDeviations(
        modes,
        deviate(modal.imag, covariance),
        deviate(by_decrement, covariance),
        modal,
        growing,
        covariance,
    )


def derive_place(rotor: RotorModel, parameter: ModelParameter, values: np.ndarray) -> RotorModel:
    """What the place of a bearing changes of ``K + K_b`` and ``C + C_b``; coefficients ``values`` (B, 8)."""
    b, nothing = parameter.place, np.zeros_like(rotor.mass)
    node, shift = rotor.bearing_nodes[b], rotor.bearing_shifts[b] if rotor.bearing_shifts else 0.0
    rows, slopes = (shaft_rows(rotor, node, shift, slope) for slope in (False, True))
    made = [
        parameter.deviation * (slopes.T @ block @ rows + rows.T @ block @ slopes)
        for block in values[b].reshape(2, 2, 2)
    ]
    return replace(rotor, mass=nothing, gyroscopic=nothing, stiffness=made[0], damping=made[1])


@dataclass(frozen=True, eq=False)
class Behaviour:
    """The modes of one system, and what follows from them."""

    modes: WhirlModes
    deviations: ModeDeviations | None = None  # of a fit that states them
    shown: np.ndarray = field(default_factory=lambda: np.zeros((0, 4)))  # (K, 4) of read_modes; none of a modelled one

    @cached_property
    def critical(self) -> list[CriticalSpeed]:
        """Ascending."""
        return find_critical_speeds(self.modes)

    @cached_property
    def margin(self) -> StabilityMargin:
        """Over all speeds."""
        return measure_stability(self.modes)

    @cached_property
    def margin_deviations(self) -> tuple[float | None, float | None]:
        """Those of the largest growth (1/s) and the smallest logarithmic decrement; None where the fit states none."""
        return (None, None) if self.deviations is None else self.deviations.of_margin(self.margin)

    @property
    def stability(self) -> Stability:
        """The verdict on the growth, with its deviation."""
        return judge_growth(self.margin.largest_growth, self.margin_deviations[0] or 0.0)


def derive_eigenvalues(
    values: np.ndarray,
    mass: np.ndarray,
    stiffness: np.ndarray,
    damping: np.ndarray,
    speed: float,
    places: BearingPlaces,
    changes: Sequence[RotorModel | None] = (),
    off: float = 1e-7,
) -> tuple[np.ndarray, np.ndarray]:
    """Derivatives of the eigenvalues ``values`` (K,) of the rotor on its bearings at one ``speed`` W in rad/s.

    By inverse iteration a share ``off`` beside them: the matrix stays regular, and two steps give the vector.

    Args:
        mass: (n, n) M.
        stiffness: (n, n) K + K_b.
        damping: (n, n) C + W G + C_b.

    Returns:
        By the coefficients at ``places``, (K, B, 8) 1/s over N/m and N s/m; by ``changes`` of the rotor, (K, T) 1/s.
    """
    eigenvalues = values[:, None, None]
    shifted = eigenvalues * (1.0 + off) + off
    system = shifted**2 * mass + shifted * damping + stiffness  # (K, n, n)
    right, left = _find_null(system), _find_null(system.swapaxes(1, 2))
    left = left / _multiply(left, 2.0 * eigenvalues * mass + damping, right)[:, None]
    shown = [places.show(vector[..., None]).reshape(len(values), -1, 2) for vector in (left, right)]  # (K, B, 2)
    by_stiffness = -shown[0][..., None] * shown[1][:, :, None]  # (K, B, 2, 2)
    by_stiffness = by_stiffness.reshape(*by_stiffness.shape[:2], 4)
    by_coefficient = np.concatenate([by_stiffness, eigenvalues * by_stiffness], axis=-1)
    by_rotor = np.zeros((len(values), len(changes)), dtype=complex)
    for t, change in enumerate(changes):
        if change is not None:
            turned = change.damping + speed * change.gyroscopic
            moved = eigenvalues**2 * change.mass + eigenvalues * turned + change.stiffness
            by_rotor[:, t] = -_multiply(left, moved, right)
    return by_coefficient, by_rotor


def _multiply(left: np.ndarray, matrix: np.ndarray, right: np.ndarray) -> np.ndarray:
    """(K,) ``left matrix right`` of each mode."""
    return np.asarray((left[:, None] @ matrix @ right[..., None])[:, 0, 0])


def _find_null(system: np.ndarray) -> np.ndarray:
    """(K, n) the vector that each nearly singular matrix (K, n, n) takes to nearly zero, by inverse iteration."""
    vectors = np.broadcast_to(np.linspace(1.0, 2.0, system.shape[-1]), system.shape[:2])
    for _ in range(2):
        vectors = np.linalg.solve(system, vectors[..., None])[..., 0]
        vectors = vectors / np.linalg.norm(vectors, axis=1, keepdims=True)
    return vectors


def expect_criticals(
    measurement: Measurement, uncertainty: Uncertainty, speeds: np.ndarray
) -> list[tuple[CriticalSpeed, tuple[float, float]]]:
    """The critical speeds within ``speeds`` (S,) rad/s beyond the data, ascending, each with its deviations: see
    :meth:`ModeDeviations.of_critical`.

    ``measurement`` is at the fitted model parameters. Raises ConfigError where a coefficient, identified or known,
    depends on the speed: nothing says what it is beyond the data.
    """
    known, identified = measurement.updated_known, uncertainty.identified
    if identified.model.hidden is not None or np.ptp(known.values, axis=1).any():
        raise ConfigError(
            "critical speeds beyond the data must be of coefficients that do not depend on the speed, but some do: use "
            "model=constant and known values, or measure there"
        )
    table = BearingTable(known.nodes, speeds, np.repeat(known.values[:, :1], len(speeds), axis=1))
    updated = replace(measurement, known=table)
    bearings = identified.table(table)
    modes = find_modes(updated.updated_rotor, bearings)
    deviations = deviate_modes(modes, updated, bearings, uncertainty)
    return [(critical, deviations.of_critical(critical)) for critical in find_critical_speeds(modes)]
