"""What bearings are like before anything is measured: a prior of functions of the speed, from bearings that are drawn.

Two runs determine a part only of sixteen functions; the rest is prior, and bands hold where the prior is what bearings
are. So each family of bearings is drawn from the laws and tables of this package, under the static load that follows
from the rotor's weight; the mean and covariance of their coordinates (:mod:`pipeline.impedance`) at nodes over the
speed, and room for what theory lacks, make one normal prior of the family. One more family knows of no film.

Legend: K nodes, 8 coordinates, n drawn bearings. SI units.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from pipeline.impedance import stand_in_series, to_coordinates
from pipeline.laws.numbers import scale_film
from pipeline.laws.short_bearing import short_table
from pipeline.laws.table import read_film_table

LACKS = {
    "plain": (0.30, 0.30, 0.20, 0.12),
    "lobed": (0.30, 0.30, 0.24, 0.16),
    "tilting_pad": (0.30, 0.30, 0.20, 0.12),
    "rolling": (0.30, 0.40, 0.08, 0.03),
}
"""Family -> standard deviations of what theory lacks: of ln |Z|, of asinh, of cross stiffness and of cross damping over
g. Chosen on twelve drawn machines, judged on others (studies/ordinary). Half of them trusts theory too much where it is
15 to 30 % off; evidence of the readings picks that half. Tilting pads have the room of plain bearings: a family with
less of it has more evidence by that alone, and plain bearings were taken for tilting pads that explained less."""


@dataclass(frozen=True, eq=False)
class FamilyPrior:
    """The normal distribution of a family's coordinates at the nodes."""

    family: str
    mean: np.ndarray  # (8 K,) coordinate by coordinate
    root: np.ndarray  # (8 K, 8 K) lower, of the covariance
    yields: bool = False  # whether the ground does

    @property
    def name(self) -> str:
        """As a user reads it."""
        return f"{self.family} on a pedestal" if self.yields else self.family

    def select(self, coordinates: Sequence[int]) -> FamilyPrior:
        """That of some coordinates, in this order."""
        places = np.arange(len(self.mean)).reshape(8, -1)[list(coordinates)].ravel()
        rows = self.root[places]
        return replace(self, mean=self.mean[places], root=np.asarray(np.linalg.cholesky(rows @ rows.T)))


def draw_bearings(
    family: str, speeds: np.ndarray, load: float, diameter: float, generator: np.random.Generator, count: int = 2500
) -> np.ndarray:
    """(n, K, 8) coefficients of bearings of a family at ``speeds`` (K,) under a static ``load`` along -y.

    Medians and deviations (of logarithms): clearance ratio 1.6e-3 (0.45), viscosity 0.018 Pa s (0.8), falling over the
    speed by a power of 0 to 0.4, length over diameter 0.6 (0.35), diameter (0.1), load (0.05); of rolling bearings 5e7
    N/m (1.5), damping over stiffness 1.25e-5 s (0.9), kyy / kxx 1 (0.6). The load's direction is known to 8 degrees.
    """
    import torch

    def spread(median: float, deviation: float) -> np.ndarray:
        return median * np.exp(deviation * generator.standard_normal((count, 1)))

    if family == "rolling":
        kxx, loss = spread(5e7, 1.5), spread(1.25e-5, 0.9)
        kyy = kxx * spread(1.0, 0.6)
        nothing = np.zeros_like(kxx)
        rows = np.stack([kxx, nothing, nothing, kyy, loss * kxx, nothing, nothing, loss * kyy], axis=-1)
        return np.broadcast_to(rows, (count, len(speeds), 8))
    journal, force, ratio = spread(diameter, 0.1), spread(load, 0.05), spread(0.6, 0.35)
    clearance = spread(1.6e-3, 0.45) * journal / 2
    thinning = -np.abs(0.4 * generator.standard_normal((count, 1)))
    viscosity = spread(0.018, 0.8) * (speeds / np.sqrt(speeds[0] * speeds[-1])) ** thinning
    sommerfeld = viscosity * speeds / (2 * np.pi) * ratio * journal**2 / force * (journal / 2 / clearance) ** 2
    # Each table of a family, and whether its Sommerfeld number has the square of L / D.
    names = {"lobed": "elliptical", "tilting_pad": "tilting_pad"}
    tables, drawn = [(read_film_table(names.get(family, "lund_thomsen_two_axial_groove")), False)], []
    tables = [(short_table(), True), *tables] if family == "plain" else tables
    for rows, (table, squared) in zip(np.array_split(np.arange(count), len(tables)), tables, strict=True):
        preload = torch.as_tensor(generator.uniform(table.preloads[0], table.preloads[-1], (len(rows), 1)))
        log_s = np.log((sommerfeld * ratio**2 if squared else sommerfeld)[rows])
        pure = table.evaluate(torch.as_tensor(log_s), preload)[0].numpy()
        drawn.append(scale_film(pure, force[rows], clearance[rows], speeds))
    angle = -np.pi / 2 + np.radians(8.0) * generator.standard_normal(count)
    turn = np.stack([np.cos(angle), -np.sin(angle), np.sin(angle), np.cos(angle)], axis=-1).reshape(count, 1, 1, 2, 2)
    matrices = np.concatenate(drawn).reshape(count, len(speeds), 2, 2, 2)
    return (turn @ matrices @ turn.swapaxes(-1, -2)).reshape(count, len(speeds), 8)


def stand_on_ground(
    coefficients: np.ndarray,
    speeds: np.ndarray,
    generator: np.random.Generator,
    stiffer: tuple[float, float] = (6.0, 1.5),
    above: tuple[float, float] = (3.0, 0.7),
) -> np.ndarray:
    """(n, K, 8) drawn bearings as the shaft feels them on pedestals ``h = k - w^2 m``.

    Medians and deviations of logarithms: how many times ``stiffer`` a pedestal is than its bearing, the largest of
    |Zxx| and |Zyy| over the speed, and how far ``above`` the highest speed it resonates by itself.
    """
    ratio, resonance = (
        median * np.exp(deviation * generator.standard_normal(len(coefficients)))
        for median, deviation in (stiffer, above)
    )
    direct = np.hypot(coefficients[..., [0, 3]], speeds[:, None] * coefficients[..., [4, 7]])
    stiffness = direct.max(axis=(1, 2)) * ratio
    share = speeds / speeds[-1] / np.maximum(resonance, 1.2)[:, None]
    return stand_in_series(coefficients, speeds, stiffness[:, None] * (1 - share**2))


def make_priors(
    families: Sequence[str],
    speeds: np.ndarray,
    load: float,
    diameter: float,
    seed: int = 0,
    rough: float = 0.1,
    yields: bool = False,
) -> tuple[FamilyPrior, ...]:
    """One of each of the ``families``, at nodes ``speeds`` (K,) rad/s, on pedestals where the ground ``yields``; the
    same for the same seed.

    Measured bearings have kinks: ``rough``, a share of what theory lacks, has a length of 0.3 in ln w.
    """
    u = np.log(speeds / speeds[0])
    far = np.sqrt(5) * np.abs(u[:, None] - u)
    # Half of what theory lacks is constant over the speed, half Matern 5/2 of length 1 in ln w.
    smooth = 0.5 + 0.5 * (1 + far + far**2 / 3) * np.exp(-far) + rough**2 * np.exp(-far / np.sqrt(5) / 0.3)
    priors: dict[str, FamilyPrior] = {}
    for family, (size, angle, stiffness, damping) in LACKS.items():
        generator = np.random.default_rng([seed, list(LACKS).index(family)])
        pure = draw_bearings(family, speeds, load, diameter, generator)
        drawn = to_coordinates(stand_on_ground(pure, speeds, generator) if yields else pure, speeds)
        sane = np.isfinite(drawn).all(axis=(1, 2)) & (drawn[..., 0].max(axis=1) < 40)
        columns = drawn[sane].swapaxes(1, 2).reshape(sane.sum(), -1)
        lacks = np.diag([size, angle, size, angle, stiffness, stiffness, damping, damping]) ** 2
        apart = 0.06**2 / 2  # cxy and cyx are alike to 0.06
        lacks[6:, 6:] = damping**2 - apart + 2 * apart * np.eye(2)
        root = _root(np.cov(columns.T) + np.kron(lacks, smooth))
        priors[family] = FamilyPrior(family, columns.mean(axis=0), root, yields)
    level = float(np.mean([prior.mean.reshape(8, -1)[[0, 2]].mean() for prior in priors.values()]))
    priors["unknown"] = _unknown(u, smooth, level)
    return tuple(priors[family] for family in families)


def _unknown(u: np.ndarray, smooth: np.ndarray, level: float) -> FamilyPrior:
    """No film is known: levels of any size, straight lines over ln w, and a wiggle."""
    n, middle = len(u), (u - u.mean()) / max(np.ptp(u) / 2, 1e-9)
    blocks = np.zeros((8, n, 8, n))
    for c, spread in enumerate((2.0, 1.7, 2.0, 1.7, 0.6, 0.6, 0.3, 0.3)):
        share = min(1.0, spread / 0.6)
        line, wiggle = (share * 0.5) ** 2 * np.outer(middle, middle), (share * 0.3) ** 2 * (2 * smooth - 1)
        blocks[c, :, c] = spread**2 + line + wiggle
    mean = np.repeat([level, 1.0, level, 1.0, 0.0, 0.0, 0.0, 0.0], n)
    return FamilyPrior("unknown", mean, _root(blocks.reshape(8 * n, 8 * n)))


def _root(covariance: np.ndarray) -> np.ndarray:
    return np.asarray(
        np.linalg.cholesky(covariance + 1e-9 * np.diag(np.diag(covariance)) + 1e-10 * np.eye(len(covariance)))
    )
