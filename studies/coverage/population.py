"""Bearings with a prior of functions: what a population of bearings says, where readings do not.

A study beside the program's own fit, on the same files. Two forward runs determine a part only of the sixteen functions
of the speed; the rest is prior, and bands hold where the prior is what bearings are. Here it is read from bearings that
are drawn from the laws of :mod:`pipeline.laws`, family by family, under the static load that follows from the rotor.

Coordinates of a bearing, Z = K + j w C with g = sqrt(|Zxx| |Zyy|): ln |Zxx|, asinh(kxx / (w cxx)), the same of y, and
kxy / g, kyx / g, w cxy / g, w cyx / g. Direct damping stays positive, and stiffness may change its sign. They are given
at nodes even in ln w, with a cubic spline between. The prior of a family is normal: mean and covariance of the drawn
bearings, and room for what theory lacks. The rotor's modulus and disc masses, and one factor for each bearing and run,
are fitted with their tolerances. Each pair of families is one least-squares problem (Levenberg and Marquardt, from
readings of little weight to their full one); pairs count by their evidence, and bands are quantiles of draws.

Legend: S speeds, P probes, R runs, B = 2 bearings, C = 8 coordinates, K nodes, T numbers of the rotor.
"""

from __future__ import annotations

import itertools
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from scipy.interpolate import CubicSpline
from scipy.linalg import cho_factor, cho_solve, solve_triangular

from pipeline.laws.numbers import turn_axes
from pipeline.laws.short_bearing import short_table
from pipeline.laws.table import FilmTable, read_film_table
from pipeline.problem.measurement import Measurement
from pipeline.rotor.interpolation import bearing_places
from pipeline.rotor.model import RotorModel
from pipeline.rotor.parameters import ModelParameter, update_rotor

FAMILIES = ("plain", "lobed", "tilting_pad", "rolling", "unknown")
N_NODES = 14
LACKS = {
    "plain": (0.30, 0.30, 0.20, 0.12),
    "lobed": (0.30, 0.30, 0.24, 0.16),
    "tilting_pad": (0.30, 0.30, 0.10, 0.06),
    "rolling": (0.30, 0.40, 0.08, 0.03),
}
"""Family -> standard deviations of what theory lacks: of ln |Z|, asinh, cross stiffness and cross damping over g."""


# --- coordinates -----------------------------------------------------------------------------------------


def to_coordinates(values: np.ndarray, w: np.ndarray) -> np.ndarray:
    """(.., S, C) of coefficients (.., S, 8), N/m and N s/m, at speeds (S,) rad/s."""
    kxx, kxy, kyx, kyy = np.moveaxis(values[..., :4], -1, 0)
    dxx, dxy, dyx, dyy = np.moveaxis(values[..., 4:] * w[:, None], -1, 0)
    x, y = np.hypot(kxx, dxx), np.hypot(kyy, dyy)
    g = np.sqrt(x * y)
    return np.stack(
        [np.log(x), np.arcsinh(kxx / dxx), np.log(y), np.arcsinh(kyy / dyy), kxy / g, kyx / g, dxy / g, dyx / g],
        axis=-1,
    )


def to_impedance(c: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Z (.., 2, 2) of coordinates (.., C), and its derivative (.., 2, 2, C)."""
    x, y, g = np.exp(c[..., 0]), np.exp(c[..., 2]), np.exp((c[..., 0] + c[..., 2]) / 2)
    tx, sx, ty, sy = np.tanh(c[..., 1]), 1 / np.cosh(c[..., 1]), np.tanh(c[..., 3]), 1 / np.cosh(c[..., 3])
    xy, yx = c[..., 4] + 1j * c[..., 6], c[..., 5] + 1j * c[..., 7]
    z = np.stack([x * (tx + 1j * sx), g * xy, g * yx, y * (ty + 1j * sy)], axis=-1)
    slope = np.zeros((*z.shape, c.shape[-1]), dtype=complex)
    slope[..., 0, 0], slope[..., 3, 2] = z[..., 0], z[..., 3]
    slope[..., 0, 1], slope[..., 3, 3] = x * sx * (sx - 1j * tx), y * sy * (sy - 1j * ty)
    slope[..., 1:3, 0] = slope[..., 1:3, 2] = z[..., 1:3] / 2
    slope[..., 1, 4] = slope[..., 2, 5] = g
    slope[..., 1, 6] = slope[..., 2, 7] = 1j * g
    return z.reshape(*z.shape[:-1], 2, 2), slope.reshape(*z.shape[:-1], 2, 2, -1)


def to_coefficients(c: np.ndarray, w: np.ndarray) -> np.ndarray:
    """(.., S, 8) of coordinates (.., S, C)."""
    z = to_impedance(c)[0].reshape(*c.shape[:-1], 4)
    return np.concatenate([z.real, z.imag / w[:, None]], axis=-1)


# --- the population ----------------------------------------------------------------------------------------


@dataclass(frozen=True, eq=False)
class Prior:
    """Normal, of the coordinates of one bearing at the nodes."""

    family: str
    mean: np.ndarray  # (C K,)
    root: np.ndarray  # (C K, C K) lower, of the covariance


def _tables(family: str) -> list[tuple[FilmTable, bool]]:
    """Each table of a family, and whether its Sommerfeld number has the square of L / D."""
    if family == "plain":
        return [(short_table(), True), (read_film_table("lund_thomsen_two_axial_groove"), False)]
    return [(read_film_table({"lobed": "elliptical", "tilting_pad": "tilting_pad"}[family]), False)]


def draw_bearings(
    family: str, w: np.ndarray, load: float, diameter: float, generator: np.random.Generator, count: int = 2500
) -> np.ndarray:
    """(n, K, 8) coefficients of ``count`` bearings of a family at speeds (K,) rad/s under a load in N."""
    import torch

    def spread(median: float, deviation: float) -> np.ndarray:
        return median * np.exp(deviation * generator.standard_normal((count, 1)))

    if family == "rolling":
        kxx, loss = spread(1e8, 1.1), spread(1.25e-5, 0.9)
        kyy = kxx * spread(np.exp(-0.3), 0.35)
        nothing = np.zeros_like(kxx)
        rows = np.stack([kxx, nothing, nothing, kyy, loss * kxx, nothing, nothing, loss * kyy], axis=-1)
        return np.broadcast_to(rows, (count, len(w), 8))
    journal, force, ratio = spread(diameter, 0.1), spread(load, 0.05), spread(0.6, 0.35)
    clearance = spread(1.6e-3, 0.45) * journal / 2
    thinning = -np.abs(0.4 * generator.standard_normal((count, 1)))
    viscosity = spread(0.018, 0.8) * (w / np.sqrt(w[0] * w[-1])) ** thinning
    sommerfeld = viscosity * w / (2 * np.pi) * ratio * journal**2 / force * (journal / 2 / clearance) ** 2
    tables, drawn = _tables(family), []
    for part, (table, squared) in zip(np.array_split(np.arange(count), len(tables)), tables, strict=True):
        low, high = table.preloads[0], table.preloads[-1]
        preload = torch.as_tensor(generator.uniform(low, high, (len(part), 1)))
        log_s = np.log((sommerfeld * ratio**2 if squared else sommerfeld)[part])
        pure = table.evaluate(torch.as_tensor(log_s), preload)[0].numpy()
        size = (force / clearance)[part][:, None]
        drawn.append(np.concatenate([pure[..., :4] * size, pure[..., 4:] * size / w[:, None]], axis=-1))
    # Gravity is along -y; its direction at the film is not known to a few degrees.
    angles = -np.pi / 2 + np.radians(8.0) * generator.standard_normal(count)
    return np.stack([rows @ turn_axes(angle).T for rows, angle in zip(np.concatenate(drawn), angles, strict=True)])


def make_priors(w: np.ndarray, load: float, diameter: float, generator: np.random.Generator) -> list[Prior]:
    """One of each family, at nodes (K,) rad/s."""
    priors, n, u = [], len(w), np.log(w / w[0])
    far = np.sqrt(5) * np.abs(u[:, None] - u)  # Matern 5/2 of length 1
    smooth = 0.5 + 0.5 * (1 + far + far**2 / 3) * np.exp(-far)
    for family, (size, angle, stiffness, damping) in LACKS.items():
        drawn = to_coordinates(draw_bearings(family, w, load, diameter, generator), w)
        sane = np.isfinite(drawn).all(axis=(1, 2)) & (drawn[..., 0].max(axis=1) < 40)
        columns = drawn[sane].swapaxes(1, 2).reshape(sane.sum(), -1)
        lacks = np.diag([size, angle, size, angle, stiffness, stiffness, damping, damping]) ** 2
        alike = 0.06**2 / 2
        lacks[6:, 6:] = damping**2 - alike + 2 * alike * np.eye(2)
        covariance = np.cov(columns.T) + np.kron(lacks, smooth)
        priors.append(Prior(family, columns.mean(axis=0), _root(covariance)))
    level = np.mean([prior.mean.reshape(8, n)[[0, 2]].mean() for prior in priors])
    middle = (u - u.mean()) / max(np.ptp(u) / 2, 1e-9)
    # No film is known: levels of any size, straight lines over ln w, and a wiggle.
    blocks = np.zeros((8, n, 8, n))
    for c, level_spread in enumerate((2.0, 1.7, 2.0, 1.7, 0.6, 0.6, 0.3, 0.3)):
        share = min(1.0, level_spread / 0.6)
        line, wiggle = (share * 0.5) ** 2 * np.outer(middle, middle), (share * 0.3) ** 2 * (2 * smooth - 1)
        blocks[c, :, c] = level_spread**2 + line + wiggle
    mean = np.repeat([level, 1.0, level, 1.0, 0.0, 0.0, 0.0, 0.0], n)
    return [*priors, Prior("unknown", mean, _root(blocks.reshape(8 * n, 8 * n)))]


def _root(covariance: np.ndarray) -> np.ndarray:
    return np.linalg.cholesky(covariance + 1e-9 * np.diag(np.diag(covariance)) + 1e-10 * np.eye(len(covariance)))


def find_loads(rotor: RotorModel) -> np.ndarray:
    """(B,) N of the two bearings by the rotor's weight; a tenth of it at least."""
    mass = rotor.mass[::4, ::4].sum(axis=1)
    weight, centre = 9.81 * mass.sum(), (mass @ rotor.positions) / mass.sum()
    first, second = rotor.positions[list(rotor.bearing_nodes)]
    share = (centre - first) / (second - first)
    return np.maximum(weight * np.abs([1 - share, share]), weight / 10)


# --- the least-squares problem -----------------------------------------------------------------------------


@dataclass(frozen=True, eq=False)
class Receptance:
    """Of the free rotor, at the bearings and probes, and what the weights alone do."""

    bearings: np.ndarray  # (S, 4, 4) m/N
    probes: np.ndarray  # (S, P, 4)
    at_bearings: np.ndarray  # (S, 4, R) m
    at_probes: np.ndarray  # (S, P, R) m

    def plus(self, others: list[Receptance], shares: np.ndarray) -> Receptance:
        names = ("bearings", "probes", "at_bearings", "at_probes")
        sums = [getattr(self, n) + sum(v * getattr(o, n) for v, o in zip(shares, others, strict=True)) for n in names]
        return Receptance(*sums)


def find_receptance(rotor: RotorModel, measurement: Measurement) -> Receptance:
    from pipeline.data.dataset import assemble_forces

    data = measurement.dataset
    w = data.speeds[:, None, None]
    stiff = -(w**2) * rotor.mass + 1j * w * (rotor.damping + w * rotor.gyroscopic) + rotor.stiffness
    places = bearing_places(rotor)
    loads = np.broadcast_to(places.loads(rotor.n_dof), (len(data.speeds), rotor.n_dof, 4))
    forces = assemble_forces(rotor, data.excitations, data.runs, data.frequencies)
    motion = np.linalg.solve(stiff, np.concatenate([loads, forces], axis=2))
    shown = np.zeros((len(data.channels), rotor.n_dof))
    for p, (node, angle) in enumerate(data.channels):
        shown[p, 4 * node : 4 * node + 2] = np.cos(np.radians(angle)), np.sin(np.radians(angle))
    at = places.show(motion)
    seen = shown @ motion
    return Receptance(at[..., :4], seen[..., :4], at[..., 4:], seen[..., 4:])


@dataclass(frozen=True, eq=False)
class Problem:
    """Readings of a measurement, of which each pair of priors is fitted."""

    measurement: Measurement
    floor: float = 0.05e-6
    share: float = 0.01
    drift: float = 0.02

    @cached_property
    def nodes(self) -> np.ndarray:
        w = self.measurement.dataset.speeds
        return np.geomspace(w[0], w[-1], N_NODES)

    @cached_property
    def spread(self) -> np.ndarray:
        """(S, K) of the spline."""
        w = self.measurement.dataset.speeds
        return CubicSpline(np.log(self.nodes), np.eye(N_NODES))(np.log(np.clip(w, self.nodes[0], self.nodes[-1])))

    @cached_property
    def base(self) -> Receptance:
        return find_receptance(self.measurement.rotor, self.measurement)

    @cached_property
    def changes(self) -> list[Receptance]:
        """T: by ln E (1 %) and the mass of each disc (2 %), a deviation each."""
        rotor = self.measurement.rotor
        numbers = [ModelParameter("youngs_modulus", 0.01, "")]
        numbers += [ModelParameter("disc_mass", 0.02, "", node) for node in rotor.disc_nodes]
        return [
            find_receptance(update_rotor(rotor, [number], np.ones(1)), self.measurement).plus([self.base], -np.ones(1))
            for number in numbers
        ]

    @cached_property
    def whitening(self) -> np.ndarray:
        """(S, P, R, R) inverse roots of the noise over the runs: their own, and that of the common baseline."""
        data = self.measurement.dataset
        taken = np.zeros_like(data.displacement) if data.subtracted is None else data.subtracted
        alone = self.floor**2 + (self.share * np.abs(data.displacement + taken)) ** 2
        common = np.where(taken != 0, np.sqrt(self.floor**2 + (self.share * np.abs(taken)) ** 2), 0.0)
        covariance = alone[..., None] * np.eye(alone.shape[-1]) + common[..., None] * common[..., None, :]
        return np.sqrt(2.0) * np.linalg.inv(np.linalg.cholesky(covariance))

    @property
    def n_readings(self) -> int:
        return 2 * self.measurement.dataset.displacement.size

    def evaluate(
        self, coordinates: np.ndarray, factors: np.ndarray, numbers: np.ndarray
    ) -> tuple[float, np.ndarray, np.ndarray]:
        """Chi-square, and gradient (S, n) and normal matrix (S, n, n) by the local columns.

        ``coordinates`` (S, B, C), ``factors`` (B, R) in deviations, ``numbers`` (T,); n = B C + B R + T.
        """
        data = self.measurement.dataset
        n_s, n_p, n_r = data.displacement.shape
        at = self.base.plus(self.changes, numbers)
        z, slope = to_impedance(coordinates)
        scale = 1 + self.drift * factors  # (B, R)
        h = np.zeros((n_s, n_r, 4, 4), dtype=complex)
        for b in range(2):
            h[:, :, 2 * b : 2 * b + 2, 2 * b : 2 * b + 2] = scale[b][:, None, None] * z[:, None, b]
        inverse = np.linalg.inv(np.eye(4) + h @ at.bearings[:, None])  # (S, R, 4, 4)
        free = at.at_bearings.swapaxes(1, 2)[..., None]  # (S, R, 4, 1)
        force = -(inverse @ (h @ free))
        motion = (free + at.bearings[:, None] @ force)[..., 0]
        carry = at.probes[:, None] @ inverse  # (S, R, P, 4)
        seen = at.at_probes.swapaxes(1, 2) + (at.probes[:, None] @ force)[..., 0]  # (S, R, P)
        columns = [np.empty((n_s, n_r, n_p, 0), dtype=complex)]
        by_factor = np.zeros((n_s, n_r, n_p, 2, n_r), dtype=complex)
        for b in range(2):
            places = slice(2 * b, 2 * b + 2)
            moved = np.einsum("sijc,srj->sric", slope[:, b], motion[..., places])
            columns.append(-scale[b][:, None, None] * (carry[..., places] @ moved))
            push = np.einsum("sij,srj->sri", z[:, b], motion[..., places])
            along = -self.drift * np.einsum("srpi,sri->srp", carry[..., places], push)
            by_factor[:, np.arange(n_r), :, b, np.arange(n_r)] = along.swapaxes(0, 1)
        columns.append(by_factor.reshape(n_s, n_r, n_p, -1))
        for change in self.changes:
            inside = change.bearings[:, None] @ force + change.at_bearings.swapaxes(1, 2)[..., None]
            told = change.at_probes.swapaxes(1, 2) + (change.probes[:, None] @ force)[..., 0]
            columns.append((told - (carry @ (h @ inside))[..., 0])[..., None])
        off = (seen - data.displacement.transpose(0, 2, 1))[..., None]
        both = np.concatenate([*columns, off], axis=-1).transpose(0, 2, 1, 3)  # (S, P, R, n + 1)
        white = (self.whitening @ both).reshape(n_s, n_p * n_r, -1)
        rows = np.concatenate([white.real, white.imag], axis=1)
        products = rows.swapaxes(1, 2) @ rows
        return float(products[:, -1, -1].sum()), products[:, :-1, -1], products[:, :-1, :-1]

    def spread_out(self, gradient: np.ndarray, matrix: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Gradient and normal matrix by the coordinates at the nodes, B C K of them, factors and numbers."""
        n, k, c = gradient.shape[1], N_NODES, 16
        pairs = (self.spread[:, :, None] * self.spread[:, None]).reshape(len(self.spread), -1)
        own = (pairs.T @ matrix[:, :c, :c].reshape(len(matrix), -1)).reshape(k, k, c, c).transpose(2, 0, 3, 1)
        cross = np.einsum("sk,scg->ckg", self.spread, matrix[:, :c, c:]).reshape(c * k, n - c)
        whole = np.block([[own.reshape(c * k, c * k), cross], [cross.T, matrix[:, c:, c:].sum(axis=0)]])
        first = np.einsum("sk,sc->ck", self.spread, gradient[:, :c]).ravel()
        return np.concatenate([first, gradient[:, c:].sum(axis=0)]), whole


@dataclass(frozen=True, eq=False)
class Mode:
    """A minimum of one pair of families; ``place`` is whitened by its priors."""

    pair: tuple[Prior, Prior]
    place: np.ndarray
    chi_square: float
    matrix: np.ndarray  # of readings at their weight, and priors

    @property
    def square(self) -> float:
        return float(self.place @ self.place)

    def evidence(self, weight: float) -> float:
        """Logarithm, by Laplace's approximation, up to a constant."""
        return -(weight * self.chi_square + self.square) / 2 - np.linalg.slogdet(self.matrix)[1] / 2


@dataclass(frozen=True, eq=False)
class Pair:
    """The problem of one pair of priors."""

    problem: Problem
    priors: tuple[Prior, Prior]

    @cached_property
    def root(self) -> np.ndarray:
        """(B C K, B C K) block diagonal."""
        n = len(self.priors[0].mean)
        whole = np.zeros((2 * n, 2 * n))
        whole[:n, :n], whole[n:, n:] = self.priors[0].root, self.priors[1].root
        return whole

    def split(self, place: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Coordinates (.., S, B, C), factors (.., B, R), numbers (.., T) of places (.., n)."""
        n, n_runs = len(self.root), len(self.problem.measurement.dataset.runs)
        mean = np.concatenate([prior.mean for prior in self.priors])
        at_nodes = (mean + place[..., :n] @ self.root.T).reshape(*place.shape[:-1], 2, 8, N_NODES)
        coordinates = np.moveaxis(at_nodes @ self.problem.spread.T, -1, -3)
        factors = place[..., n : n + 2 * n_runs].reshape(*place.shape[:-1], 2, n_runs)
        return coordinates, factors, place[..., n + 2 * n_runs :]

    @property
    def size(self) -> int:
        return len(self.root) + 2 * len(self.problem.measurement.dataset.runs) + len(self.problem.changes)

    def evaluate(self, place: np.ndarray, weight: float) -> tuple[float, np.ndarray, np.ndarray]:
        """Chi-square; gradient and matrix of half the whole square, in whitened places."""
        square, gradient, matrix = self.problem.evaluate(*self.split(place))
        first, second = self.problem.spread_out(gradient, matrix)
        n = len(self.root)
        first[:n] = self.root.T @ first[:n]
        second[:n] = self.root.T @ second[:n]
        second[:, :n] = second[:, :n] @ self.root
        return square, weight * first + place, weight * second + np.eye(len(place))

    def minimise(self, place: np.ndarray, weight: float, steps: int = 40, tolerance: float = 1e-3) -> Mode:
        """Levenberg and Marquardt, until a step promises less than ``tolerance`` of the whole square."""
        damping = 1e-3
        square, gradient, matrix = self.evaluate(place, weight)
        for _ in range(steps):
            step = -cho_solve(cho_factor(matrix + damping * np.diag(np.diag(matrix))), gradient)
            tried = place + step
            with np.errstate(over="ignore", invalid="ignore"):
                after = self.evaluate(tried, weight) if np.abs(tried).max() < 30 else (np.inf, gradient, matrix)
            gain = weight * (square - after[0]) + place @ place - tried @ tried
            if np.isfinite(gain) and gain > 0:
                place, (square, gradient, matrix), damping = tried, after, max(damping / 5, 1e-9)
                if gain < tolerance:
                    break
            else:
                damping *= 8
                if damping > 1e6:
                    break
        return Mode(self.priors, place, square, matrix)

    def search(self, weight: float, generator: np.random.Generator, starts: int) -> Mode:
        """The best of several tempered descents: from the mean, and from draws."""
        best = None
        for start in range(starts):
            place = 0.7 * generator.standard_normal(self.size) * (start > 0)
            for share in (0.003, 0.05, 1.0):
                mode = self.minimise(place, share * weight, tolerance=1e-3 if share == 1 else 0.1, steps=25)
                place = mode.place
            if best is None or mode.evidence(weight) > best.evidence(weight):
                best = mode
        assert best is not None
        return best


@dataclass(frozen=True, eq=False)
class Answer:
    """Coefficients with their bands."""

    values: np.ndarray  # (B, S, 8) median
    low: np.ndarray  # (B, S, 8) of the 95 % band
    high: np.ndarray
    decided: np.ndarray  # (B, S, 8) bool: by the readings, not by the prior alone
    families: tuple[tuple[str, str, float], ...]  # pairs, with their weights
    chi_square: float  # over what is expected


def identify(measurement: Measurement, diameter: float, seed: int = 0, known: tuple[str, ...] = FAMILIES) -> Answer:
    """The answer of a measurement; ``diameter`` m of the shaft at its bearings."""
    generator = np.random.default_rng(seed)
    problem = Problem(measurement)
    priors = [make_priors(problem.nodes, load, diameter, generator) for load in find_loads(measurement.rotor)]
    pairs = [Pair(problem, pair) for pair in itertools.product(*priors) if {p.family for p in pair} <= set(known)]
    modes = [pair.search(1.0, generator, 2) for pair in pairs]
    freedom = max(problem.n_readings - 60, problem.n_readings / 2)
    best = max(modes, key=lambda mode: mode.evidence(1.0))
    for _ in range(2):  # the size of the noise, once the best pair is known
        weight = freedom / best.chi_square
        order = sorted(range(len(modes)), key=lambda i: -modes[i].evidence(weight))[:5]
        modes = [pairs[i].minimise(modes[i].place, weight) for i in order]
        pairs = [pairs[i] for i in order]
        best = max(modes, key=lambda mode: mode.evidence(weight))
    evidence = np.array([mode.evidence(weight) for mode in modes])
    shares = np.exp(evidence - evidence.max())
    shares /= shares.sum()
    return _conclude(problem, pairs, modes, shares, generator, best.chi_square / problem.n_readings)


def _conclude(
    problem: Problem,
    pairs: list[Pair],
    modes: list[Mode],
    shares: np.ndarray,
    generator: np.random.Generator,
    square: float,
) -> Answer:
    w = problem.measurement.dataset.speeds
    drawn: list[np.ndarray] = []
    before: list[np.ndarray] = []
    for pair, mode, count in zip(pairs, modes, generator.multinomial(600, shares), strict=True):
        if not count:
            continue
        lower = np.linalg.cholesky(mode.matrix)
        noise = solve_triangular(lower.T, generator.standard_normal((len(lower), count))).T
        for places, where in ((mode.place + noise, drawn), (generator.standard_normal((count, pair.size)), before)):
            where.append(to_coefficients(np.moveaxis(pair.split(places)[0], -2, -3), w))
    after, prior = np.concatenate(drawn), np.concatenate(before)
    low, middle, high = np.quantile(after, [0.025, 0.5, 0.975], axis=0)
    wide = np.quantile(prior, [0.16, 0.84], axis=0)
    narrow = np.quantile(after, [0.16, 0.84], axis=0)
    decided = (narrow[1] - narrow[0]) < 0.5 * (wide[1] - wide[0])
    told = tuple(
        (pair.priors[0].family, pair.priors[1].family, float(share)) for pair, share in zip(pairs, shares, strict=True)
    )
    return Answer(middle, low, high, decided, told, square)
