"""What the data themselves limit, as docs/method.md prints it (pytest -rP shows it)."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from conftest import MachineFactory

from benchmarks.ross_oracle import ross_rotor
from pipeline.coefficients import COEFFICIENTS
from pipeline.config.compose import compose_config
from pipeline.problem.residual import bearing_equations, linear_residual, per_speed_least_squares
from pipeline.unknowns import tie, unknown_set


@pytest.mark.slow
def test_the_table_that_ross_evaluates_is_not_its_closed_form(machine: MachineFactory) -> None:
    """Mean over the speeds, percent: ROSS smooths what it computed at the very same speeds."""
    config, made = compose_config(["experiment=all_coefficients"]), machine("experiment=all_coefficients")
    element = ross_rotor(config.machine.rotor, config.machine.bearings, made.speeds).bearing_elements[0]
    used = {name: made.bearings.coefficient(name)[0] for name in ("kxx", "kyy", "cxx", "cyy")}
    off = {name: 100 * np.abs(values / np.array(getattr(element, name)) - 1).mean() for name, values in used.items()}
    assert off == pytest.approx({"kxx": 8.6e-6, "kyy": 1.28e-5, "cxx": 4.85e-4, "cyy": 3.41e-4}, rel=0.01)


@pytest.mark.parametrize(
    ("experiment", "median", "high"),
    [("all_coefficients", 0.045, 0.54), ("all_coefficients_backward", 8e-5, 6e-4)],
)
def test_single_precision_is_not_enough(experiment: str, median: float, high: float, machine: MachineFactory) -> None:
    """Displacements rounded to it: median and 95th percentile over speed of least squares, the worst coefficient."""
    made = machine(f"experiment={experiment}")
    displacement = made.dataset.displacement.astype(np.complex64).astype(complex)
    unknowns = unknown_set(dict.fromkeys(made.rotor.bearing_nodes, tie(COEFFICIENTS)))
    equations = bearing_equations(made.rotor, replace(made.dataset, displacement=displacement))
    found = per_speed_least_squares(linear_residual(equations, unknowns, made.bearings))
    off = 100 * np.abs(found / made.bearings.values - 1)
    reached = np.median(off, axis=1).max(), np.quantile(off, 0.95, axis=1).max()
    assert reached == pytest.approx((median, high), rel=0.1)
