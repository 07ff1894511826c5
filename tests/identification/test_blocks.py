"""A wide prior of the features beyond the trend: it matters where the readings say nothing, and nowhere else."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import torch
from running import composed
from small_rotor import fitted_beside_truth

from pipeline.identification.blocks import Basis
from pipeline.identification.output_error_fit import OutputErrorFit

pytestmark = pytest.mark.slow
NOISE = ["stated_noise.additive=0.05 um", "stated_noise.multiplicative=0.005"]
UNSEEN = ["machine.file=studies/coverage/friswell.yaml", *NOISE]
"""At 200 rpm this rotor hardly moves its probes."""


def fitted(*overrides: str, seed: int = 0) -> tuple[OutputErrorFit, np.ndarray]:
    """The fit of a machine, and the true unknowns (S, A)."""
    return fitted_beside_truth(composed("stage=train", *overrides), seed)


def without_prior(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(Basis, "prior_precision", lambda self, *_: torch.zeros(self.n_features, dtype=torch.float64))


def direct(fit: OutputErrorFit, truth: np.ndarray) -> np.ndarray:
    """(S, A') identified over true direct coefficients, which are exponentials."""
    positive = [fit.problem.basis.model.positive[u] for _, u in fit.problem.active]
    return np.asarray((fit.problem.unknowns(fit.weights)[0][0].numpy() / truth)[:, positive])


def test_no_coefficient_runs_away_where_the_readings_say_nothing(monkeypatch: pytest.MonkeyPatch) -> None:
    smallest = direct(*fitted(*UNSEEN)).min()
    without_prior(monkeypatch)
    before = direct(*fitted(*UNSEEN)).min()
    print(f"smallest coefficient over its true value: {smallest:.3g}, without the prior {before:.3g}")
    assert before < 0.01 < 0.1 < smallest


def test_where_they_say_something_it_changes_nothing(monkeypatch: pytest.MonkeyPatch) -> None:
    """Coefficients known to half a percent move by a thousandth at most."""
    wanted, truth = fitted("experiment=noisy_stiffness", "machine.speeds.step_rpm=50")
    without_prior(monkeypatch)
    plain, _ = fitted("experiment=noisy_stiffness", "machine.speeds.step_rpm=50")
    off = np.abs(direct(wanted, truth) / direct(plain, truth) - 1)
    print(f"moved by {off.max():.2g} at most")
    assert 0 < off.max() < 1e-3


def test_its_standard_deviation_is_that_of_the_outputs() -> None:
    """Weights drawn from the prior make outputs of this root mean square over the speeds."""
    fit, _ = fitted("experiment=noisy_stiffness", "machine.speeds.step_rpm=100")
    basis: Basis = fit.problem.basis
    n_speeds = fit.problem.features.shape[1]
    precision = basis.prior_precision(n_speeds, 0.5)
    assert not precision[: basis.n_trend].any()
    own = precision[basis.n_trend :]
    drawn = torch.randn(2000, len(own), generator=torch.Generator().manual_seed(0), dtype=torch.float64) / own.sqrt()
    outputs = drawn @ fit.problem.features[0, :, basis.n_trend :].T
    assert float(outputs.square().mean().sqrt()) == pytest.approx(0.5, rel=0.05)
    bare = replace(basis, model=replace(basis.model, trend=False))
    assert float(bare.prior_precision(n_speeds, 0.5)[-1]) < float(precision[-1])
