"""Weighted linear least squares of the residual, in a model's features: a start that needs no guess.

And the weights of a problem that come nearest to coefficients that are known roughly, or to the modes of a base that
the peaks of the readings show.

Legend: S speeds, M members, U unknowns, A those of them that members have, K features, Z weights.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from pipeline.data.dataset import project_direction
from pipeline.identification.problem import OutputError
from pipeline.impedance import list_places, to_coordinates
from pipeline.parameters.kind import turns_with_rotor
from pipeline.parameters.weights import size_excitations
from pipeline.problem.expansion import expand
from pipeline.problem.measurement import Measurement
from pipeline.problem.noise import whiten
from pipeline.problem.ranking import find_distinct
from pipeline.problem.residual import LinearResidual, linear_residual

if TYPE_CHECKING:
    import torch


def linear_start(training: Measurement, features: np.ndarray, scale: np.ndarray, rounds: int = 3) -> np.ndarray | None:
    """Unknowns (M, S, U) as combinations of the ``features`` (M, S, K); None for too few sensors.

    ``scale`` (M, U) are sizes of the unknowns, N/m and N s/m. The noise of the residual depends on the coefficients: in
    so many ``rounds`` the weights are made again.
    """
    less = training.subtract_unbalance()
    expansion = expand(less.response, less.dataset.displacement, less.deviation)
    if expansion is None:
        return None
    residual = linear_residual(expansion.equations, less.unknowns, less.known)
    values = _combine(whiten(residual, expansion.force_root), features, scale)
    for _ in range(rounds - 1):
        root = expansion.residual_root(less.response, less.table(values))
        values = _combine(whiten(residual, root), features, scale)
    return values


def _combine(
    white: LinearResidual,
    features: np.ndarray,
    scale: np.ndarray,
    rounds: int = 3,
    outlier: float = 3.0,
    tiny: float = 1e-300,
) -> np.ndarray:
    """(M, S, U) least squares of ``A (Phi a) + y``, robust: rows beyond ``outlier`` standard deviations count less."""
    members, n_speeds, _, n_unknowns = white.matrix.shape
    values = np.zeros((members, n_speeds, n_unknowns))
    for m in range(members):
        present = white.unknowns.present[m]
        matrix = white.matrix[m][..., present] * scale[m, present]
        weight = np.ones(matrix.shape[:2])
        for _ in range(rounds):
            # Orthogonal at each speed: as many rows as unknowns are left of it, whatever the number of runs.
            few = np.asarray(np.linalg.qr(np.dstack([matrix, white.offset[m]]) * weight[..., None], mode="r"))
            rows = np.einsum("sru,sk->sruk", few[..., :-1], features[m])
            solution = np.linalg.lstsq(rows.reshape(few[..., -1].size, -1), -few[..., -1].ravel(), rcond=1e-10)[0]
            outputs = features[m] @ solution.reshape(rows.shape[2], rows.shape[3]).T
            rest = np.einsum("sru,su->sr", matrix, outputs) + white.offset[m]
            # A normal value's median modulus is 0.6745 of its deviation. Rows of runs that were not measured are zero.
            size = outlier * max(np.median(np.abs(rest[matrix.any(axis=2)])) / 0.6745, tiny)
            weight = np.sqrt(np.minimum(1.0, size / np.maximum(np.abs(rest), tiny)))
        values[m][:, present] = outputs * scale[m, present]
    return values


# --- weights near given coefficients -------------------------------------------------------------------


def start_at(problem: OutputError, values: np.ndarray) -> torch.Tensor:
    """(1, 1, Z) the weights that come nearest to unknowns (M, S, U), without residual unbalance, of the stated model.

    ``problem`` is that of the training speeds, where the features are orthonormal: their coordinates are projections.
    """
    import torch

    raw = _outputs(problem, values)
    coordinates = torch.stack([problem.features[m].T @ raw[m, :, u] for m, u in problem.active])  # (A, K)
    kept = (coordinates * problem.kept).flatten()
    return problem.weigh(coefficients=kept, parameters=problem.sensors.solved_at)


def robust_start(problem: OutputError, values: np.ndarray, rounds: int = 20, smallest: float = 1e-12) -> torch.Tensor:
    """As :func:`start_at`, of rough unknowns (M, S, U): single speeds that are far off count less (Huber 1964)."""
    import torch

    raw = _outputs(problem, values)
    rows: list[torch.Tensor] = []
    for m, u in problem.active:
        features, target = problem.features[m], raw[m, :, u]
        weight, solution = torch.ones_like(target), torch.zeros(features.shape[-1], dtype=target.dtype)
        for _ in range(rounds):
            weighted = features * weight[:, None]
            ridge = smallest * torch.eye(len(solution), dtype=target.dtype)
            solution = torch.linalg.solve(features.T @ weighted + ridge, weighted.T @ target)
            off = (target - features @ solution).abs()
            weight = 1 / (off / off.median().clamp(min=smallest)).clamp(min=1.0)
        rows.append(solution * problem.kept[len(rows)])
    return problem.weigh(coefficients=torch.stack(rows).flatten())


def _outputs(problem: OutputError, values: np.ndarray) -> torch.Tensor:
    """(M, S, U) outputs of the model that give unknowns (M, S, U)."""
    import torch

    model = problem.basis.model
    if model.parametrisation != "impedance":
        return model.raw_from(torch.tensor(values), problem.scale)
    eight = problem.measurement.table(values).values
    outputs = to_coordinates(eight, problem.measurement.dataset.speeds)[..., list_places(model.unknowns)]
    return torch.as_tensor(outputs[: len(values)])


# --- modes of a base -----------------------------------------------------------------------------------


def read_modes(problem: OutputError, tries: int = 4, first_softening: float = 1.0, seed: int = 0) -> torch.Tensor:
    """(G, 1, Z) starts at which a base has the modes that the readings themselves show, the likeliest first.

    A quick reading of peaks: as if the rotor were rigid and light beside its base, a reading is a sum of modes with
    residues that are free at each probe, by the weights and by the residual unbalance. For given frequencies, damping
    and softening the residues follow from linear least squares (variable projection, Golub and Pereyra 1973), so that
    few numbers are searched, from the stated ones and from ``tries`` - 1 drawn about them. The shape of a mode is the
    real vector that comes nearest to its residues; where bearings push, it is what makes the weights' forces of them.
    """
    import torch
    from scipy.optimize import least_squares

    fitted = _PeakFit(problem.measurement)
    generator, first = np.random.default_rng(seed), np.zeros((3, fitted.count))
    first[2] = first_softening
    ends = []
    for i in range(tries):
        drawn = generator.standard_normal(first.shape) * np.array([[0.5], [0.5], [0.0]])
        start = (first + (drawn if i else 0.0))[: len(fitted.kinds)]
        ends.append(least_squares(lambda at: fitted.solve(at)[0], start.ravel(), max_nfev=40))
    order = find_distinct([float(end.cost) for end in ends], most=tries)
    made = [fitted.weigh(problem, ends[i].x) for i in order]
    return torch.cat(made)


class _PeakFit:
    """The readings of a measurement as modes with free residues."""

    def __init__(self, measurement: Measurement, share: float = 0.25, floor: float = 0.15) -> None:
        """Readings count by a ``share`` of their size and a ``floor`` of the probe's median acceleration."""
        self.measurement, data = measurement, measurement.dataset
        names = ("support_stiffness", "support_damping", "base_softening")
        every = {name: [(t, p) for t, p in enumerate(measurement.parameters) if p.kind == name] for name in names}
        self.kinds = [every[name] for name in names if every[name]]
        self.count = len(self.kinds[0])
        self.at_speed, self.at_run = np.nonzero(data.present & turns_with_rotor(data))
        self.w = data.frequencies[self.at_speed, self.at_run][:, None]
        self.size = size_excitations(data)[self.at_speed, self.at_run][:, None]
        self.read = data.displacement[self.at_speed, :, self.at_run]
        median = np.median(np.abs(self.read) * self.w**2, axis=0)
        self.deviation = np.hypot(share * np.abs(self.read), floor * median / self.w**2)
        weights = np.zeros(len(data.runs), dtype=complex)  # kg m
        for weight in data.excitations:
            weights[data.runs.index(weight.run)] += weight.magnitude * np.exp(1j * weight.phase)
        self.weights, self.scale = weights[self.at_run][:, None], max(float(np.abs(weights).max()), 1e-300)

    def solve(self, values: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Rows, the prior's first, and the residues (P, 2, modes) of the weights and of the residual unbalance."""
        each = values.reshape(len(self.kinds), -1)
        steps = [v * [p.deviation for _, p in kind] for v, kind in zip(each, self.kinds, strict=True)]
        stated = [np.array([p.stated for _, p in kind]) for kind in self.kinds]
        softer = sum((self.size * step for step in steps[2:]), np.zeros(1))
        stiffness, damping = stated[0] * np.exp(steps[0] - softer), stated[1] * np.exp(steps[1])
        modes = self.w**2 / (stiffness - self.w**2 + 1j * self.w * damping)
        columns = np.hstack([modes * self.weights, modes * self.scale])
        rows, residues = [values], []
        for read, deviation in zip(self.read.T, self.deviation.T, strict=True):
            matrix, right = columns / deviation[:, None], read / deviation
            residues.append(np.linalg.lstsq(matrix, right, rcond=1e-10)[0])
            off = matrix @ residues[-1] - right
            rows += [off.real, off.imag]
        return np.concatenate(rows), np.array(residues).reshape(len(residues), 2, -1)

    def weigh(self, problem: OutputError, values: np.ndarray) -> torch.Tensor:
        """(1, 1, Z) the weights of a problem at these numbers, and at the shapes and unbalances of their residues."""
        import torch

        measurement, rotor, residues = self.measurement, self.measurement.rotor, self.solve(values)[1]
        parameters = measurement.parameter_values
        parameters[[t for kind in self.kinds for t, _ in kind]] = values
        shapes, pushed = np.zeros_like(rotor.participation), np.zeros((2, self.count), dtype=complex)
        for r in range(self.count):
            parts = np.stack([residues[:, 0, r].real, residues[:, 0, r].imag], axis=1)
            left, singular, right = np.linalg.svd(parts, full_matrices=False)
            shape = left[:, 0] * np.sqrt(singular[0])
            force = complex(*right[0]) * np.sqrt(singular[0])
            pushed[:, r] = force, shape @ residues[:, 1, r] / (shape @ shape) * self.scale
            for (node, angle), size in zip(measurement.dataset.channels, shape, strict=True):
                if 0 <= node - rotor.n_nodes < len(rotor.casings):
                    shapes[node - rotor.n_nodes, :, r] += size * np.array(project_direction(angle))
        # Equal and opposite unbalances at the ends tell what both bearings push: f = (a + b) / 2, c = u (a - b).
        unbalance = float(np.median(np.abs(pushed[1]) / np.abs(pushed[0])))
        for sign, node in zip((1, -1), rotor.bearing_nodes, strict=False):
            if node in rotor.casings and not shapes[at := rotor.casings.index(node)].any():
                push = pushed[0] + sign * pushed[1] / (2 * unbalance)
                shapes[at, :, : self.count] = push.real, -push.imag
        for t, parameter in enumerate(measurement.parameters):
            if parameter.kind == "base_participation":
                parameters[t] = (shapes - rotor.participation).flat[parameter.place] / parameter.deviation
        planes = torch.zeros(2 * problem.places.n_planes, dtype=torch.float64)
        planes[[0, -2]] += torch.tensor([unbalance, -unbalance], dtype=torch.float64) / problem.plane_scale
        return problem.weigh(parameters=torch.as_tensor(parameters), planes=planes)
