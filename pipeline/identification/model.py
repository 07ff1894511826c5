"""Unknown coefficients as functions of named inputs (speed, operating conditions), with a flat parameter vector.

A network, a constant, or a linear combination of fixed functions of the speed (B-splines, Chebyshev polynomials, values
at nodes), which is a network without hidden layers: its output layer is fed by these functions.

A flat vector lets any number of copies - bearings, initial guesses, seeds - be evaluated and trained at once
as leading dimensions of one tensor. Legend: ``...`` batch, Q parameters, S speeds, U unknowns, F functions.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Literal

import numpy as np

from pipeline.coefficients import CoefficientName, is_direct
from pipeline.config.models import ModelConfig
from pipeline.errors import ConfigError, DataError
from pipeline.identification.inputs import SPEED, activate, evaluate_functions, fade, trend_terms
from pipeline.unknowns import outputs_of, scale_outputs

if TYPE_CHECKING:
    import torch


@dataclass(frozen=True, kw_only=True)
class CoefficientModel:
    """Architecture and scaling; everything but the trained numbers."""

    unknowns: tuple[CoefficientName, ...]
    inputs: tuple[str, ...]
    parametrisation: Literal["log", "scaled", "impedance"]
    scale: tuple[tuple[float, ...], ...]  # (bearings or 1) x U, N/m and N s/m
    hidden: tuple[int, ...] | None  # widths; None for constants, empty for fixed functions
    activation: Literal["tanh", "silu", "sine"] = "tanh"
    input_scaling: Literal["rpm", "log_rpm"] = "rpm"
    ranges: tuple[tuple[float, float], ...] = ((0.0, 1.0),)  # of each input (SI, the speed in rad/s), mapped to [-1, 1]
    trend: bool = False  # the output layer also sees the inputs and the logarithm of the speed
    fades: bool = False  # the output goes to zero beyond the data: it corrects a law
    functions: Literal["b_spline", "chebyshev", "nodes"] | None = None  # that the output layer is fed by, too
    n_functions: int = 0  # F

    @property
    def positive(self) -> tuple[bool, ...]:
        """Which unknowns are ``scale * exp(output)``; the others, of either sign, are ``scale * output``."""
        return tuple(self.parametrisation == "log" and is_direct(name) for name in self.unknowns)

    @property
    def sizes(self) -> list[tuple[int, int]]:
        """(inputs, outputs) of every layer; constants are an output layer that nothing feeds."""
        if self.hidden is None:
            return [(0, len(self.unknowns))]
        before = self.hidden[-1:] or (() if self.functions else (len(self.inputs),))
        widths = [len(self.inputs), *self.hidden]
        n_in = sum(before) + self.n_functions + self.n_trend
        return [*itertools.pairwise(widths), (n_in, len(self.unknowns))]

    @property
    def n_trend(self) -> int:
        """Inputs of the output layer beside the hidden units."""
        return len(self.inputs) + 1 if self.trend or self.fades else 0

    def _with_trend(self, hidden: torch.Tensor, inputs: torch.Tensor) -> torch.Tensor:
        """(..., S, n_in) what the output layer is fed: power laws and straight lines need no hidden units.

        Where the output fades, hidden units and inputs do, and the last input is what nobody measured, beyond the data.
        """
        import torch

        if self.fades:
            inside, beyond = fade(inputs)
            terms = torch.cat([inputs * inside, beyond], dim=-1)
            return torch.cat([hidden * inside, terms.expand(*hidden.shape[:-1], self.n_trend)], dim=-1)
        if not self.trend:
            return hidden
        at = self.inputs.index(SPEED)
        terms = trend_terms(inputs, at, self.ranges[at], self.input_scaling == "log_rpm")
        return torch.cat([hidden, terms.expand(*hidden.shape[:-1], self.n_trend)], dim=-1)

    @property
    def n_parameters(self) -> int:
        """Q."""
        return sum((i + 1) * o for i, o in self.sizes)

    @property
    def n_output(self) -> int:
        """How many of them are the output layer's, the last ones."""
        return (self.sizes[-1][0] + 1) * self.sizes[-1][1]

    def scaled_inputs(self, points: Mapping[str, np.ndarray], wide: float = 1.5) -> torch.Tensor:
        """(S, inputs) in [-1, 1] over the trained range, from ``points``: ``speed`` in rad/s, conditions in SI, (S,).

        The speed counts by its logarithm where that is asked for, and so does an operating condition that varies by the
        factor ``wide`` or more: a load acts as a power, while an oil temperature in kelvin varies by a few percent.
        Raises DataError for an input that is not given; what the model does not depend on is ignored.
        """
        import torch

        lacking = [name for name in self.inputs if name not in points]
        if lacking:
            raise DataError(
                f"the coefficients are functions of {' and '.join(self.inputs)}, but {lacking[0]} is not given: say at "
                f"which {lacking[0]} they are wanted"
            )
        columns = []
        for name, span in zip(self.inputs, self.ranges, strict=True):
            as_power = name == SPEED or (span[0] > 0 and span[1] / span[0] >= wide)
            transform = np.log if self.input_scaling == "log_rpm" and as_power else np.asarray
            low, high = (float(transform(edge)) for edge in span)
            half = (high - low) / 2 or 1.0
            columns.append((transform(np.asarray(points[name], dtype=float)) - low) / half - 1.0)
        return torch.as_tensor(np.stack(columns, axis=1), dtype=torch.float64)

    def _feed(self, parameters: torch.Tensor, inputs: torch.Tensor) -> tuple[list[torch.Tensor], list[torch.Tensor]]:
        """(..., S, n_in) what each layer is fed by, and (..., S, n_out) slopes of the hidden units."""
        import torch

        if self.functions == "nodes":
            inputs = inputs.clamp(-1.0, 1.0)  # nothing is known beyond the nodes: constant
        first = inputs[:, : self.sizes[0][0]]  # none for constants
        fed, slopes = [first.expand(*parameters.shape[:-1], *first.shape)], []
        for weight, bias in self.layers(parameters)[:-1]:
            value, slope = activate(self.activation, fed[-1] @ weight + bias)
            fed.append(value)
            slopes.append(slope)
        if self.functions:
            speeds = inputs[:, 0].cpu().numpy()
            functions = torch.as_tensor(evaluate_functions(self.functions, self.n_functions, speeds))
            beside = functions.expand(*parameters.shape[:-1], *functions.shape)
            fed[-1] = torch.cat([fed[-1], beside], dim=-1) if self.hidden else beside
        fed[-1] = self._with_trend(fed[-1], inputs)
        return fed, slopes

    def raw(self, parameters: torch.Tensor, inputs: torch.Tensor) -> torch.Tensor:
        """Network output (..., S, U) from parameters (..., Q) and scaled inputs (S, inputs)."""
        weight, bias = self.layers(parameters)[-1]
        return self._feed(parameters, inputs)[0][-1] @ weight + self._one(inputs) * bias

    def _one(self, inputs: torch.Tensor) -> torch.Tensor:
        """(S, 1) what the bias of the output layer is multiplied by."""
        import torch

        return fade(inputs)[0] if self.fades else torch.ones_like(inputs[:, :1])

    def _backward(self, parameters: torch.Tensor, inputs: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
        """(..., S, U, Q - n_output) derivative of :meth:`raw` by all layers but the last, back-propagated; and
        (..., S, n_in + 1) what the last one is fed by, and 1: times an identity of U, its derivative.
        """
        import torch

        layers, (fed, slopes) = self.layers(parameters), self._feed(parameters, inputs)
        fed = [torch.nn.functional.pad(values, (0, 1), value=1.0) for values in fed]
        identity = torch.eye(len(self.unknowns), dtype=parameters.dtype)
        # Of U outputs to a layer's sums.
        sensitivity = identity.expand(*parameters.shape[:-1], len(inputs), *identity.shape)
        blocks = [sensitivity[..., :0]]
        for layer in range(len(layers) - 1, 0, -1):
            weight = layers[layer][0][..., : slopes[layer - 1].shape[-1], :]  # the trend has nothing before it
            sensitivity = (sensitivity @ weight.mT[..., None, :, :]) * slopes[layer - 1][..., None, :]
            blocks.insert(0, (fed[layer - 1][..., None, :, None] * sensitivity[..., None, :]).flatten(-2))
        return torch.cat(blocks, dim=-1), fed[-1]

    def raw_jacobian(self, parameters: torch.Tensor, inputs: torch.Tensor) -> torch.Tensor:
        """(..., S, U, Q) derivative of :meth:`raw` by the parameters.

        Ten times faster than nested vmap and jacrev, which a test compares it with.
        """
        import torch

        before, fed = self._backward(parameters, inputs)
        last = fed[..., None, :, None] * torch.eye(len(self.unknowns), dtype=fed.dtype)[:, None]
        return torch.cat([before, last.flatten(-2)], dim=-1)

    def raw_normal(
        self, parameters: torch.Tensor, inputs: torch.Tensor, gradient: torch.Tensor, curvature: torch.Tensor
    ) -> tuple[torch.Tensor, torch.Tensor]:
        """J'g (..., Q) and J'CJ (..., Q, Q) of the Jacobian J, for a ``gradient`` g (..., S, U) and a symmetric
        ``curvature`` C (..., S, U, U) by :meth:`raw`.

        Most of J is the last layer's, which only repeats what that is fed by: with J never written down, a step takes a
        third of the time.
        """
        import torch

        before, fed = self._backward(parameters, inputs)
        weighed, units, out = curvature @ before, fed.shape[-1], len(self.unknowns)
        beside = (fed.mT @ weighed.flatten(-2)).unflatten(-1, weighed.shape[-2:]).flatten(-3, -2)  # of last by first
        last = fed.new_empty(*parameters.shape[:-1], units, out, units, out)
        for i, j in itertools.combinations_with_replacement(range(out), 2):
            last[..., i, :, j] = last[..., j, :, i] = (fed * curvature[..., i, j, None]).mT @ fed
        first = torch.cat([before.flatten(-3, -2).mT @ weighed.flatten(-3, -2), beside.mT], dim=-1)
        second = torch.cat([beside, last.flatten(-2).flatten(-3, -2)], dim=-1)
        slopes = (before.mT @ gradient[..., None])[..., 0].sum(-2), (fed.mT @ gradient).flatten(-2)
        return torch.cat(slopes, dim=-1), torch.cat([first, second], dim=-2)

    def layers(self, parameters: torch.Tensor) -> list[tuple[torch.Tensor, torch.Tensor]]:
        """Weights (..., n_in, n_out) and biases (..., 1, n_out) of every layer: views of the flat vector."""
        layers, start = [], 0
        for n_in, n_out in self.sizes:
            weight = parameters[..., start : start + n_in * n_out].unflatten(-1, (n_in, n_out))
            bias = parameters[..., None, start + n_in * n_out : start + (n_in + 1) * n_out]
            layers.append((weight, bias))
            start += (n_in + 1) * n_out
        return layers

    def physical(
        self, raw: torch.Tensor, scale: torch.Tensor, base: torch.Tensor | float = 0.0
    ) -> tuple[torch.Tensor, torch.Tensor]:
        """Coefficients in N/m and N s/m from network output, and their derivative by it.

        ``scale`` broadcasts over (..., S, U); cross-coupled coefficients are added to their ``base``.
        """
        import torch

        values, slope = scale_outputs(raw, scale, torch.tensor(self.positive), base)
        return values, slope.expand_as(raw)

    def raw_from(self, values: torch.Tensor, scale: torch.Tensor, least: float = 1e-3) -> torch.Tensor:
        """The network output that gives ``values`` (..., U); what must be positive is kept above a floor."""
        import torch

        return torch.as_tensor(outputs_of(values, scale, torch.tensor(self.positive), least))

    def scale_tensor(self) -> torch.Tensor:
        """(bearings or 1, 1, U)."""
        import torch

        return torch.tensor(self.scale, dtype=torch.float64)[:, None, :]

    def initial_parameters(
        self, guess: np.ndarray, generator: torch.Generator, first_gain: float = 3.0, output_gain: float = 0.1
    ) -> torch.Tensor:
        """Parameters (M, Q) that start at ``guess`` (M, U), N/m and N s/m; M members.

        Inputs lie in [-1, 1]: first-layer weights of ``first_gain`` spread the bends of the units over that range.
        Output weights of ``output_gain`` are small, so that an untrained network starts near its guess at every speed.
        """
        import torch

        values, scale = torch.as_tensor(guess, dtype=torch.float64), torch.tensor(self.scale, dtype=torch.float64)
        start = self.raw_from(values, scale, least=0.0)
        members, pieces = len(start), []
        for layer, (n_in, n_out) in enumerate(self.sizes):
            weight = torch.randn(members, n_in * n_out, generator=generator, dtype=torch.float64) / math.sqrt(
                max(n_in, 1)
            )
            bias = torch.randn(members, n_out, generator=generator, dtype=torch.float64)
            if layer == len(self.sizes) - 1:
                pieces += [output_gain * weight, start]
            elif layer == 0:
                pieces += [first_gain * weight, bias]
            else:
                pieces += [weight, 0.1 * bias]
        return torch.cat(pieces, dim=1)

    def spread_parameters(
        self,
        guess: np.ndarray,
        generator: torch.Generator,
        steep: float = 1.0,
        reach: float = 1.2,
        condition_share: float = 1 / 3,
    ) -> torch.Tensor:
        """As :meth:`initial_parameters`, with the bends of the first hidden units spread evenly over the inputs, and a
        little beyond them (``reach``).

        For hidden layers that are not trained: drawn freely, some leave gaps that no output layer fills. Over its range
        a condition bends coefficients less (``condition_share``) than the speed does over its own: 20 K are a factor of
        two in an oil's viscosity, where the speed has seven, and both act by their product. Lines are no bends. A unit
        bends within half of the inputs' range, or within a part of that, ``steep`` times smaller.
        """
        import torch

        parameters = self.initial_parameters(guess, generator)
        if not self.hidden:
            return parameters
        members, width, n_in = len(parameters), self.hidden[0], len(self.inputs)
        jitter = torch.rand(members, width, generator=generator, dtype=torch.float64)
        places = reach * (2 * (torch.arange(width, dtype=torch.float64) + jitter) / width - 1)
        slopes = steep * (0.5 + torch.rand(members, width, generator=generator, dtype=torch.float64))
        directions = torch.ones(members, n_in, width, dtype=torch.float64)
        if n_in > 1:  # the bends lie across random directions, and reach from corner to corner along them
            directions = torch.randn(members, n_in, width, generator=generator, dtype=torch.float64)
            share = [1.0 if name == SPEED else condition_share for name in self.inputs]
            directions = directions * torch.tensor(share, dtype=torch.float64)[:, None]
            directions = directions / directions.norm(dim=1, keepdim=True)
            places = places * directions.abs().sum(1)
        parameters[:, : n_in * width] = (slopes[:, None] * directions).flatten(1)
        parameters[:, n_in * width : (n_in + 1) * width] = -slopes * places
        return parameters

    def features(self, parameters: torch.Tensor, inputs: torch.Tensor) -> torch.Tensor:
        """(M, S, K) what the output layer is linear in, the last hidden units and 1, for (M, Q) and inputs (S, 1)."""
        import torch

        bias_input = self._one(inputs).expand(len(parameters), len(inputs), 1)
        fed = self._feed(parameters, inputs)[0][-1]
        return torch.cat([fed.expand(len(parameters), *fed.shape[-2:]), bias_input], dim=-1)

    def with_output_at(
        self, parameters: torch.Tensor, inputs: torch.Tensor, values: torch.Tensor, ridge: float = 1e-9
    ) -> torch.Tensor:
        """Parameters (M, Q) whose last layer is fitted, by linear least squares, to give ``values`` (M, S, U).

        The hidden layers stay as they are: a start near an answer that is known roughly. A ``ridge`` keeps the weights
        small enough to train on from.
        """
        import torch

        targets = self.raw_from(values, self.scale_tensor())
        if self.hidden is None:
            return targets.mean(dim=1)
        fed = self.features(parameters, inputs)
        small = ridge * len(inputs) * torch.eye(fed.shape[-1], dtype=fed.dtype)
        factor = torch.linalg.cholesky(fed.mT @ fed + small)
        output = torch.cholesky_solve(fed.mT @ targets, factor)  # (M, h + 1, U)
        return torch.cat([parameters[:, : -self.n_output], output.flatten(1)], dim=1)


def coefficient_model(
    config: ModelConfig, unknowns: tuple[CoefficientName, ...], points: Mapping[str, np.ndarray], scale: np.ndarray
) -> CoefficientModel:
    """The model that a configuration describes, for data at ``points``: name -> (S,), the speed in rad/s.

    ``scale`` (M, U) is the size of each unknown, N/m and N s/m. Operating conditions that vary are inputs beside the
    speed. Raises ConfigError for such conditions where the model is made of functions of the speed alone.
    """
    sizes = tuple(tuple(float(v) for v in row) for row in scale)
    constant = CoefficientModel(
        unknowns=unknowns, inputs=(SPEED,), parametrisation=config.parametrisation, scale=sizes, hidden=None
    )
    if not config.varies:
        return constant
    inputs = tuple(name for name, values in points.items() if name == SPEED or np.ptp(values) > 0)
    if config.of_speed_alone and len(inputs) > 1:
        raise ConfigError(
            f"model.kind={config.kind} is made of functions of the speed alone, but the data have {inputs[1]}, too: "
            "choose model=network_operating"
        )
    ranges = tuple((float(points[name].min()), float(points[name].max())) for name in inputs)
    return replace(constant, **{"inputs": inputs, "ranges": ranges, "input_scaling": "log_rpm"} | config.shape)
