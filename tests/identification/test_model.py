"""The model of the coefficients: its inputs, and its derivatives against autograd."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from conftest import Machine
from training import a_model, assert_close

from pipeline.identification.model import coefficient_model

SHAPES = [(None, "tanh")] + [(depth, act) for depth in (1, 2, 3) for act in ("tanh", "silu", "sine")]


@pytest.mark.usefixtures("one_thread")
@pytest.mark.parametrize(("depth", "activation"), SHAPES)
def test_network_jacobian_equals_autograd(depth: int | None, activation: str, generator: torch.Generator) -> None:
    """The hand-written back-propagation against torch's reverse mode, for every depth and activation."""
    model = a_model(depth, activation)
    inputs = model.scaled_inputs({"speed": np.array([10.0, 90.0, 333.0, 600.0])})
    parameters = torch.randn(2, 2, model.n_parameters, generator=generator, dtype=torch.float64)
    found = model.raw_jacobian(parameters, inputs)
    assert found.shape == (2, 2, 1 if depth is None else 4, 3, model.n_parameters) or depth is None
    for g, m in np.ndindex(2, 2):
        wanted = torch.autograd.functional.jacobian(lambda p: model.raw(p, inputs), parameters[g, m])
        assert_close(found[g, m].expand_as(wanted), wanted, rtol=1e-10, atol=1e-12)


@pytest.mark.usefixtures("one_thread")
@pytest.mark.parametrize("scaling", ["rpm", "log_rpm"])
def test_inputs_are_scaled_to_one(scaling: str, hydrostatic: Machine) -> None:
    """The trained range of speeds becomes -1 to 1, evenly in rpm or its logarithm; a single speed -1."""
    config = hydrostatic.config.model.model_copy(update={"input_scaling": scaling})
    model = coefficient_model(config, ("kxx",), {"speed": hydrostatic.speeds}, np.ones((1, 1)))
    speeds = hydrostatic.speeds[[0, -1]]
    middle = np.sqrt(speeds.prod()) if scaling == "log_rpm" else speeds.mean()
    found = model.scaled_inputs({"speed": np.array([speeds[0], middle, speeds[1]])})
    assert found.dtype == torch.float64
    np.testing.assert_allclose(found.numpy(), [[-1.0], [0.0], [1.0]], atol=1e-12)
    alone = coefficient_model(config, ("kxx",), {"speed": speeds[:1]}, np.ones((1, 1)))
    np.testing.assert_allclose(alone.scaled_inputs({"speed": speeds[:1]}).numpy(), [[-1.0]])
