"""Functions that coefficient models are made of: activations of networks, B-splines, Chebyshev polynomials."""

from __future__ import annotations

from typing import TYPE_CHECKING, Literal

import numpy as np

if TYPE_CHECKING:
    import torch

_CUBIC = 3


def evaluate_functions(kind: Literal["b_spline", "chebyshev"], count: int, inputs: np.ndarray) -> np.ndarray:
    """(S, F) the first ``count`` functions at ``inputs`` (N,) in [-1, 1].

    Cubic B-splines with evenly spaced knots (four of them or more), or the Chebyshev polynomials from degree 1 on.
    """
    if kind == "chebyshev":
        return np.polynomial.chebyshev.chebvander(inputs, count)[:, 1:]
    from scipy.interpolate import BSpline

    inner = np.linspace(-1.0, 1.0, count - _CUBIC + 1)[1:-1]
    knots = np.concatenate([[-1.0] * (_CUBIC + 1), inner, [1.0] * (_CUBIC + 1)])
    return np.asarray(BSpline.design_matrix(inputs, knots, _CUBIC, extrapolate=True).toarray())


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
