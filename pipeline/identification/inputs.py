"""The named inputs of coefficient models, and the functions of them that the models are made of.

Inputs are the speed, and operating conditions (an oil temperature, a load) beside it. Each is mapped to [-1, 1] over
the data that the model was made for; beyond them the map goes on.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import TYPE_CHECKING, Literal

import numpy as np

if TYPE_CHECKING:
    import torch

SPEED = "speed"


def trend_terms(
    inputs: torch.Tensor, speed: int, span: tuple[float, float], logarithmic: bool, smallest: float = 1e-3
) -> torch.Tensor:
    """(S, inputs + 1) every input, and the speed's logarithm (or the speed, where the input is its logarithm)."""
    import torch

    low, high = span
    ratio, place = high / low, inputs[..., speed : speed + 1]
    if logarithmic:
        other = 2 * (ratio ** ((place + 1) / 2) - 1) / max(ratio - 1, smallest) - 1
    else:
        other = 2 * (1 + (ratio - 1) * (place + 1) / 2).log() / max(math.log(ratio), smallest) - 1
    return torch.cat([inputs, other], dim=-1)


def fade(inputs: torch.Tensor, reach: float = 2.0) -> tuple[torch.Tensor, torch.Tensor]:
    """(S, 1) each: one where scaled ``inputs`` (S, n) lie in the data's range, falling to zero beyond it: hardly within
    a quarter of the range, and all but nothing is left after one and a half; and the root of what is missing to one,
    squares taken. A correction has fallen to a third at ``reach`` half ranges beyond the data.
    """
    import torch

    beyond = ((inputs.abs() - 1).clamp(min=0.0) / reach).square().sum(-1, keepdim=True).square()
    return torch.exp(-beyond), torch.sqrt(-torch.expm1(-2 * beyond))


def points_of(speeds: np.ndarray, operating: Mapping[str, np.ndarray] | None) -> dict[str, np.ndarray]:
    """Name -> (S,): ``speeds`` (S,) rad/s, and ``operating`` conditions (S,) or single numbers, SI."""
    speeds = np.atleast_1d(speeds)
    return {SPEED: speeds} | {name: np.broadcast_to(values, speeds.shape) for name, values in (operating or {}).items()}


# --- functions of them ----------------------------------------------------------------------------------


def evaluate_functions(kind: Literal["b_spline", "chebyshev", "nodes"], count: int, inputs: np.ndarray) -> np.ndarray:
    """(S, F) the first ``count`` functions at ``inputs`` (N,) in [-1, 1].

    Cubic B-splines with evenly spaced knots (four of them or more), the Chebyshev polynomials from degree 1 on, or the
    cubic splines that are one at a node and zero at the others, which are evenly spaced; constant beyond them.
    """
    if kind == "nodes":
        from scipy.interpolate import CubicSpline

        return np.asarray(CubicSpline(np.linspace(-1.0, 1.0, count), np.eye(count))(np.clip(inputs, -1.0, 1.0)))
    if kind == "chebyshev":
        return np.polynomial.chebyshev.chebvander(inputs, count)[:, 1:]
    from scipy.interpolate import BSpline

    degree = 3
    inner = np.linspace(-1.0, 1.0, count - degree + 1)[1:-1]
    knots = np.concatenate([[-1.0] * (degree + 1), inner, [1.0] * (degree + 1)])
    return np.asarray(BSpline.design_matrix(inputs, knots, degree, extrapolate=True).toarray())


def activate(name: str, x: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
    """Value and slope of an activation."""
    import torch

    if name == "tanh":
        value = torch.tanh(x)
        return value, 1.0 - value.square()
    if name == "silu":
        gate = torch.sigmoid(x)
        return x * gate, gate * (1.0 + x * (1.0 - gate))
    return torch.sin(x), torch.cos(x)
