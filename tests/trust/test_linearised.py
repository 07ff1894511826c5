"""What the linear theory of a fit says of left-out readings, held to fits that were made."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from pipeline.trust.linearised import LinearisedFit


def a_line(noise: float = 0.3, shift: float = 0.0) -> LinearisedFit:
    """Two numbers z, of 40 speeds, 3 probes and 2 runs; ``shift`` is one that run 1 has and the model lacks."""
    draw = np.random.default_rng(5)
    by_weight = draw.standard_normal((40, 3, 2, 2)) + 1j * draw.standard_normal((40, 3, 2, 2))
    off = noise * (draw.standard_normal((40, 3, 2)) + 1j * draw.standard_normal((40, 3, 2)))
    off[..., 1] += shift * by_weight[..., 1, 0]
    fitted = np.ones((40, 3, 2), dtype=bool)
    rows, right = (one.reshape(-1, *one.shape[3:]) for one in (by_weight, off))
    z = np.linalg.lstsq(np.concatenate([rows.real, rows.imag]), np.concatenate([right.real, right.imag]), rcond=None)[0]
    coefficients = np.zeros((1, 40, 8, 2))
    coefficients[..., 0, 0] = coefficients[..., 3, 1] = 1.0
    return LinearisedFit(off - by_weight @ z, by_weight, coefficients, np.full(2, 1e-12), fitted)


def mask_of(run: int) -> np.ndarray:
    """The readings of a run."""
    return np.broadcast_to(np.arange(2) == run, (40, 3, 2))


def test_a_run_left_out_moves_the_answer_as_a_fit_without_it() -> None:
    linear = a_line(shift=0.5)
    moved, spread, _ = linear.leave_out(mask_of(1)) or pytest.fail("it suffices")
    kept = linear.by_weight[..., 0, :].reshape(-1, 2)
    right = linear.residual[..., 0].ravel()
    own = np.linalg.lstsq(np.concatenate([kept.real, kept.imag]), np.concatenate([right.real, right.imag]), rcond=None)
    np.testing.assert_allclose(moved[0, 0, [0, 3]], own[0], rtol=1e-6)
    assert abs(moved[0, 0, 0]) > 4 * spread[0, 0, 0]  # the half that the run adds


def test_a_right_run_is_predicted_to_its_noise() -> None:
    lines = (a_line(noise=np.sqrt(0.5), shift=shift).leave_out(mask_of(1)) for shift in (0.0, 2.0))
    assert [line and (line[2] > 3.0 or line[2]) for line in lines] == [pytest.approx(1.0, abs=0.25), True]


def test_what_a_run_alone_tells_is_not_asked_without_it() -> None:
    """The others determine nothing of the second weight: no answer without that run, and no singular matrix."""
    linear = a_line()
    by_weight = linear.by_weight.copy()
    by_weight[..., :1, 1] = 0.0
    alone = replace(linear, by_weight=by_weight, prior=np.zeros((2, 2)))
    without = [line.leave_out(mask_of(run)) for line in (alone, linear) for run in (0, 1)]
    assert [left is None for left in without] == [False, True, False, False]
