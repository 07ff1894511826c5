"""Fixed functions of the scaled input that a coefficient may be a linear combination of."""

from __future__ import annotations

from typing import Literal

import numpy as np

_CUBIC = 3


def evaluate_functions(kind: Literal["b_spline", "chebyshev"], count: int, inputs: np.ndarray) -> np.ndarray:
    """(N, F) the first ``count`` functions at ``inputs`` (N,) in [-1, 1].

    Cubic B-splines with evenly spaced knots (four of them or more), or the Chebyshev polynomials from degree 1 on.
    """
    if kind == "chebyshev":
        return np.polynomial.chebyshev.chebvander(inputs, count)[:, 1:]
    from scipy.interpolate import BSpline

    inner = np.linspace(-1.0, 1.0, count - _CUBIC + 1)[1:-1]
    knots = np.concatenate([[-1.0] * (_CUBIC + 1), inner, [1.0] * (_CUBIC + 1)])
    return np.asarray(BSpline.design_matrix(inputs, knots, _CUBIC, extrapolate=True).toarray())
