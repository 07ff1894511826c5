"""Unknown coefficients as functions of named inputs (the rotor speed today), with a flat parameter vector.

A flat vector lets any number of copies - bearings, initial guesses, seeds - be evaluated and trained at once
as leading dimensions of one tensor. Legend: ``...`` batch, P parameters, N speeds, U unknowns.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import TYPE_CHECKING, Literal

import numpy as np

from pipeline.config.schema import ModelConfig, NetworkModelConfig

if TYPE_CHECKING:
    import torch

_FIRST_LAYER_GAIN = 3.0
"""Inputs lie in [-1, 1]; first-layer weights of this size spread the bends of the units over that range."""
_OUTPUT_GAIN = 0.1
"""Small, so that an untrained network starts near its initial guess at every speed."""


@dataclass(frozen=True)
class CoefficientModel:
    """Architecture and scaling; everything but the trained numbers."""

    unknowns: tuple[str, ...]
    inputs: tuple[str, ...]
    parametrisation: Literal["log", "scaled"]
    scale: tuple[tuple[float, ...], ...]  # (bearings or 1) x U, N/m and N s/m
    hidden: tuple[int, ...] | None  # widths; None for constants
    activation: str = "tanh"
    input_scaling: Literal["rpm", "log_rpm"] = "rpm"
    input_range: tuple[float, float] = (0.0, 1.0)  # rad/s, mapped to [-1, 1]

    @property
    def sizes(self) -> list[tuple[int, int]]:
        """(inputs, outputs) of every layer; empty for constants."""
        if self.hidden is None:
            return []
        widths = [len(self.inputs), *self.hidden, len(self.unknowns)]
        return list(zip(widths[:-1], widths[1:], strict=True))

    @property
    def n_parameters(self) -> int:
        """P."""
        return sum((i + 1) * o for i, o in self.sizes) or len(self.unknowns)

    def scaled_inputs(self, speeds: np.ndarray) -> torch.Tensor:
        """(N, 1) inputs in [-1, 1] over the trained range, from speeds (N,) rad/s."""
        import torch

        transform = np.log if self.input_scaling == "log_rpm" else np.asarray
        low, high = (float(transform(edge)) for edge in self.input_range)
        half = (high - low) / 2 or 1.0
        return torch.as_tensor((transform(np.asarray(speeds, dtype=float)) - low) / half - 1.0, dtype=torch.float64)[:, None]

    def raw(self, parameters: torch.Tensor, inputs: torch.Tensor) -> torch.Tensor:
        """Network output (..., N, U) from parameters (..., P) and scaled inputs (N, 1)."""
        if self.hidden is None:
            return parameters[..., None, :].expand(*parameters.shape[:-1], len(inputs), len(self.unknowns))
        activation = _activation(self.activation)
        value, start = inputs, 0
        for layer, (n_in, n_out) in enumerate(self.sizes):
            weight = parameters[..., start : start + n_in * n_out].unflatten(-1, (n_in, n_out))
            start += n_in * n_out
            bias = parameters[..., None, start : start + n_out]
            start += n_out
            value = value @ weight + bias
            if layer < len(self.sizes) - 1:
                value = activation(value)
        return value

    def physical(self, raw: torch.Tensor, scale: torch.Tensor) -> torch.Tensor:
        """Coefficients in N/m and N s/m from network output; ``scale`` broadcasts over (..., N, U)."""
        return scale * (raw.exp() if self.parametrisation == "log" else raw)

    def scale_tensor(self) -> torch.Tensor:
        """(bearings or 1, 1, U)."""
        import torch

        return torch.tensor(self.scale, dtype=torch.float64)[:, None, :]

    def initial_parameters(self, guess: np.ndarray, generator: torch.Generator) -> torch.Tensor:
        """Parameters (M, P) that start at ``guess`` (M, U), N/m and N s/m; M bearings, or 1 where they are tied."""
        import torch

        start = torch.as_tensor(guess, dtype=torch.float64) / torch.tensor(self.scale, dtype=torch.float64)
        start = start.log() if self.parametrisation == "log" else start
        if self.hidden is None:
            return start
        members = len(start)
        pieces = []
        for layer, (n_in, n_out) in enumerate(self.sizes):
            weight = torch.randn(members, n_in * n_out, generator=generator, dtype=torch.float64) / math.sqrt(n_in)
            bias = torch.randn(members, n_out, generator=generator, dtype=torch.float64)
            if layer == len(self.sizes) - 1:
                pieces += [_OUTPUT_GAIN * weight, start]
            elif layer == 0:
                pieces += [_FIRST_LAYER_GAIN * weight, bias]
            else:
                pieces += [weight, 0.1 * bias]
        return torch.cat(pieces, dim=1)


def _activation(name: str):  # type: ignore[no-untyped-def]
    import torch

    return {"tanh": torch.tanh, "silu": torch.nn.functional.silu, "sine": torch.sin}[name]


def coefficient_model(config: ModelConfig, unknowns: tuple[str, ...], speeds: np.ndarray, scale: np.ndarray) -> CoefficientModel:
    """The model that a configuration describes, for data at ``speeds`` (S,) rad/s.

    ``scale`` (M, U) is a size of each coefficient taken from the data, see :func:`pipeline.identification.problem.data_scale`.
    """
    rows = tuple(tuple(float(v) for v in row) for row in scale)
    common = {"unknowns": unknowns, "inputs": ("speed",), "parametrisation": config.parametrisation, "scale": rows}
    if not isinstance(config, NetworkModelConfig):
        return CoefficientModel(hidden=None, **common)  # type: ignore[arg-type]
    return CoefficientModel(
        hidden=(config.width,) * config.depth,
        activation=config.activation,
        input_scaling=config.input_scaling,
        input_range=(float(speeds.min()), float(speeds.max())),
        **common,  # type: ignore[arg-type]
    )
