"""Coordinates of a bearing in which direct damping stays positive and stiffness may change its sign.

With the impedance Z = K + j w C and g = sqrt(|Zxx| |Zyy|) they are ln |Zxx|, asinh(kxx / (w cxx)), the same two of y,
and kxy / g, kyx / g, w cxy / g, w cyx / g. Bearings of all kinds lie close together there: kxy over sqrt(kxx kyy) runs
from 1 to 29 on plain bearings, where kxy / g stays below one.

Legend: .. batch, S speeds, 8 coefficients in the order of :data:`pipeline.coefficients.COEFFICIENTS`, or coordinates.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING

import numpy as np

from pipeline.errors import ConfigError

if TYPE_CHECKING:
    import torch

PLACES = {"kxx": 0, "cxx": 1, "kyy": 2, "cyy": 3, "kxy": 4, "kyx": 5, "cxy": 6, "cyx": 7}
"""Coefficient -> the coordinate that takes its place where it is unknown."""


def list_places(names: Sequence[str]) -> list[int]:
    """The coordinates of unknown coefficients. Raises ConfigError where they are not those of whole impedances."""
    known = [name for name in PLACES if name not in names]
    if any(name[1] == name[2] for name in known):
        direct = "kxx, kyy, cxx and cyy"
        raise ConfigError(
            f"a population of bearings must have {direct} among identify.unknowns, but {known[0]} is not: identify it, "
            "too, or choose model=network_fluid_film"
        )
    return [PLACES[name] for name in names]


def stand_in_series(values: np.ndarray, speeds: np.ndarray, pedestal: np.ndarray) -> np.ndarray:
    """(.., S, 8) coefficients (.., S, 8) as a shaft feels them at its own frequency, ``speeds`` (S,) rad/s, on
    pedestals h (.., S) N/m: ``(Z^-1 + 1/h)^-1``.

    Both are springs in series: no vibration of the shaft tells one from the other.
    """
    parts, w = values.reshape(*values.shape[:-1], 2, 2, 2), speeds[:, None, None]
    film, ground = parts[..., 0, :, :] + 1j * w * parts[..., 1, :, :], pedestal[..., None, None] * np.eye(2)
    felt = ground @ np.linalg.solve(ground + film, film)
    return np.stack([felt.real, felt.imag / w], axis=-3).reshape(values.shape)


def to_coordinates(values: np.ndarray, speeds: np.ndarray) -> np.ndarray:
    """(.., S, 8) coordinates of coefficients (.., S, 8), N/m and N s/m, at ``speeds`` (S,) rad/s."""
    kxx, kxy, kyx, kyy = np.moveaxis(values[..., :4], -1, 0)
    dxx, dxy, dyx, dyy = np.moveaxis(values[..., 4:] * speeds[:, None], -1, 0)
    x, y = np.hypot(kxx, dxx), np.hypot(kyy, dyy)
    g = np.sqrt(x * y)
    columns = [np.log(x), np.arcsinh(kxx / dxx), np.log(y), np.arcsinh(kyy / dyy), kxy / g, kyx / g, dxy / g, dyx / g]
    return np.stack(columns, axis=-1)


def to_coefficients(
    coordinates: torch.Tensor, speeds: torch.Tensor, slopes: bool = True
) -> tuple[torch.Tensor, torch.Tensor]:
    """(.., S, 8) coefficients, N/m and N s/m, of coordinates (.., S, 8), and their slopes (.., S, 8, 8) by these.

    Without ``slopes``, these are (.., 0, 8, 8).
    """
    import torch

    c = coordinates
    x, y, g = c[..., 0].exp(), c[..., 2].exp(), ((c[..., 0] + c[..., 2]) / 2).exp()
    tx, sx, ty, sy = c[..., 1].tanh(), 1 / c[..., 1].cosh(), c[..., 3].tanh(), 1 / c[..., 3].cosh()
    xy, yx, dxy, dyx = g * c[..., 4], g * c[..., 5], g * c[..., 6], g * c[..., 7]
    each = torch.ones(len(speeds), 8, dtype=c.dtype)
    each[:, 4:] = 1 / speeds[:, None]
    values = torch.stack([x * tx, xy, yx, y * ty, x * sx, dxy, dyx, y * sy], dim=-1) * each
    if not slopes:
        return values, c.new_zeros(*c.shape[:-2], 0, 8, 8)
    by_coordinates = c.new_zeros(*c.shape, 8)
    for place, slope in {
        (0, 0): x * tx, (0, 1): x * sx**2, (3, 2): y * ty, (3, 3): y * sy**2,
        (4, 0): x * sx, (4, 1): -x * sx * tx, (7, 2): y * sy, (7, 3): -y * sy * ty,
        (1, 0): xy / 2, (1, 2): xy / 2, (1, 4): g, (2, 0): yx / 2, (2, 2): yx / 2, (2, 5): g,
        (5, 0): dxy / 2, (5, 2): dxy / 2, (5, 6): g, (6, 0): dyx / 2, (6, 2): dyx / 2, (6, 7): g,
    }.items():  # fmt: skip
        by_coordinates[..., *place] = slope * each[:, place[0]]
    return values, by_coordinates
