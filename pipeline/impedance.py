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


def to_coordinates(values: np.ndarray, speeds: np.ndarray) -> np.ndarray:
    """(.., S, 8) coordinates of coefficients (.., S, 8), N/m and N s/m, at ``speeds`` (S,) rad/s."""
    kxx, kxy, kyx, kyy = np.moveaxis(values[..., :4], -1, 0)
    dxx, dxy, dyx, dyy = np.moveaxis(values[..., 4:] * speeds[:, None], -1, 0)
    x, y = np.hypot(kxx, dxx), np.hypot(kyy, dyy)
    g = np.sqrt(x * y)
    columns = [np.log(x), np.arcsinh(kxx / dxx), np.log(y), np.arcsinh(kyy / dyy), kxy / g, kyx / g, dxy / g, dyx / g]
    return np.stack(columns, axis=-1)


def to_coefficients(coordinates: torch.Tensor, speeds: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
    """(.., S, 8) coefficients, N/m and N s/m, of coordinates (.., S, 8), and their slopes (.., S, 8, 8) by these."""
    import torch

    c = coordinates
    x, y, g = c[..., 0].exp(), c[..., 2].exp(), ((c[..., 0] + c[..., 2]) / 2).exp()
    tx, sx, ty, sy = c[..., 1].tanh(), 1 / c[..., 1].cosh(), c[..., 3].tanh(), 1 / c[..., 3].cosh()
    nothing = torch.zeros_like(x)
    xy, yx, dxy, dyx = g * c[..., 4], g * c[..., 5], g * c[..., 6], g * c[..., 7]
    four = [  # kxx, kxy, kyx, kyy: value and slopes
        (x * tx, [x * tx, x * sx**2, nothing, nothing, nothing, nothing, nothing, nothing]),
        (xy, [xy / 2, nothing, xy / 2, nothing, g, nothing, nothing, nothing]),
        (yx, [yx / 2, nothing, yx / 2, nothing, nothing, g, nothing, nothing]),
        (y * ty, [nothing, nothing, y * ty, y * sy**2, nothing, nothing, nothing, nothing]),
        (x * sx, [x * sx, -x * sx * tx, nothing, nothing, nothing, nothing, nothing, nothing]),
        (dxy, [dxy / 2, nothing, dxy / 2, nothing, nothing, nothing, g, nothing]),
        (dyx, [dyx / 2, nothing, dyx / 2, nothing, nothing, nothing, nothing, g]),
        (y * sy, [nothing, nothing, y * sy, -y * sy * ty, nothing, nothing, nothing, nothing]),
    ]
    each = torch.ones(len(speeds), 8, dtype=c.dtype)
    each[:, 4:] = 1 / speeds[:, None]
    values = torch.stack([value for value, _ in four], dim=-1) * each
    slopes = torch.stack([torch.stack(row, dim=-1) for _, row in four], dim=-2) * each[..., None]
    return values, slopes
