"""How well the coefficients are known: the covariance of the weights, carried to whatever follows from it.

The covariance is the mean square error of the weights: of the noise (the inverse of the information, the Cramer-Rao
bound of the network's output layer) and of what the functions of the speed can't follow
(:mod:`pipeline.identification.model_error`). Legend: M members, S speeds, B bearings, F features, K members of their
basis, L local functions, A active unknowns, Th numbers of bearing laws, N balance planes, T model parameters, Z = A (K
+ L) + Th + 2 N + T weights.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from pipeline.data.sensors import NOMINAL_95
from pipeline.errors import DataError
from pipeline.files import write_beside
from pipeline.identification.blocks import Places, carry_covariance, law_term, select_active, slopes_by_weights
from pipeline.identification.identified import IdentifiedModel
from pipeline.identification.inputs import points_of
from pipeline.identification.model_error import (
    Unfitted,
    evaluate_local,
    measure_tolerances,
    none_unfitted,
    widen,
)
from pipeline.identification.quality import Quality
from pipeline.problem.slopes import deviate
from pipeline.rotor.bearing_table import BearingTable

if TYPE_CHECKING:
    import torch

    from pipeline.identification.output_error_fit import OutputErrorFit
    from pipeline.identification.output_error_start import OutputErrorStart
    from pipeline.identification.problem import OutputError

UNCERTAINTY = "uncertainty.safetensors"


@dataclass(frozen=True, eq=False)
class Uncertainty:
    """What is needed for a deviation at any speed."""

    identified: IdentifiedModel
    weights: np.ndarray  # (M, F, K) output weights of an orthonormal basis
    covariance: np.ndarray  # (Z, Z)
    precision: np.ndarray  # (A, K) of the weights before the data
    functions: tuple[np.ndarray, np.ndarray]  # rows (N, A K) and aims (N,) of a prior of functions; N = 0 for none
    residual_unbalance: np.ndarray  # (N,) complex, kg m
    planes: np.ndarray  # (N,) nodes
    as_found: np.ndarray  # complex, kg m at each node, what the baseline shows; empty where no bearing drifts
    noise: np.ndarray  # floor of a reading, m, share of it, and floors of P channels, before a channel's factor
    plane_scale: float  # kg m of a weight of 1
    parameters: np.ndarray  # (T,) model parameters, in prior deviations
    n_local: int  # L
    unfitted: Unfitted  # the part of the covariance that is of tolerances

    def sensitivity(self, speeds: np.ndarray, operating: Mapping[str, np.ndarray] | None = None) -> np.ndarray:
        """(B, S, 8, A (K + L) + Th) derivative of the coefficients by the weights of features and local functions, and
        by the numbers of bearing laws.
        """
        points, unknowns = points_of(speeds, operating), self.identified.unknowns
        return unknowns.expand_slopes(slopes_by_weights(*self._slopes(points), self._carrier(points))[0])

    def _slopes(self, points: Mapping[str, np.ndarray]) -> tuple[torch.Tensor, torch.Tensor]:
        """(1, S, A, A) and (1, S, A, Th) derivative of the active unknowns by the outputs and the numbers of laws."""
        every = (array[None] for array in self.identified.corrected(points))
        return select_active(self.identified.unknowns.active, *every)[1:]

    def _carrier(self, points: Mapping[str, np.ndarray]) -> torch.Tensor:
        """(A, S, K + L) derivative of the outputs by the weights."""
        import torch

        model = self.identified.model
        basis = model.features(self.identified.parameters, model.scaled_inputs(points)) @ torch.as_tensor(self.weights)
        local = torch.as_tensor(evaluate_local(model, points, self.n_local)).expand(*basis.shape[:2], -1)
        return torch.cat([basis, local], dim=-1)[[m for m, _ in self.identified.unknowns.active]]

    def deviation(
        self,
        speeds: np.ndarray,
        operating: Mapping[str, np.ndarray] | None = None,
        covariance: np.ndarray | None = None,
        widest: float = 5.0,
    ) -> np.ndarray:
        """(B, S, 8) standard deviations, N/m and N s/m; NaN for coefficients that were not identified.

        A coefficient that is an exponential has a log-normal error: its deviation is that whose nominal 95 % interval
        has the upper end of the log-normal one. The two differ where the coefficient is known to a few tens of percent.
        ``covariance`` (Z, Z) is a part of the whole one, which is the default. Beyond the ``widest`` deviation of its
        logarithm a coefficient is not known at all. Of coordinates of the impedance, see :meth:`_by_draws`.
        """
        identified, whole = self.identified, self.covariance if covariance is None else covariance
        if identified.model.parametrisation == "impedance":
            return self._by_draws(points_of(speeds, operating), whole)
        with np.errstate(over="ignore", invalid="ignore"):  # of coefficients that ran away
            points, unknowns = points_of(speeds, operating), identified.unknowns
            slopes = unknowns.expand_slopes(np.concatenate(self._slopes(points), axis=-1)[0])  # (B, S, 8, A + Th)
            deviation = deviate(slopes, self._spread(points, whole))
            members = identified.values(speeds, operating)[: unknowns.n_members]
            values = np.abs(unknowns.expand(members, np.zeros_like(deviation)))
            share = np.minimum(deviation / np.where(values > 0, values, np.inf), widest)
            positive = np.abs(unknowns.expansion[..., list(identified.model.positive)]).sum(axis=-1)  # (B, 8)
            deviation = np.where(positive[:, None] > 0, values * np.expm1(NOMINAL_95 * share) / NOMINAL_95, deviation)
        return np.where(unknowns.identified[:, None], deviation, np.nan)

    def state(self, table: BearingTable) -> BearingTable:
        """The ``table`` with the :meth:`deviation` of each of its coefficients."""
        return replace(table, deviation=self.deviation(table.speeds, table.operating))

    def _by_draws(self, points: Mapping[str, np.ndarray], covariance: np.ndarray, count: int = 512) -> np.ndarray:
        """(B, S, 8) deviations whose nominal 95 % interval about the answer holds that of drawn coordinates.

        Coordinates are normal, and coefficients are not: ``count`` places that fill the normal distribution evenly
        (Sobol 1967) are carried to them, the same at every speed.
        """
        import torch
        from scipy.special import ndtri

        identified, model = self.identified, self.identified.model
        raw, spreads = model.raw(identified.parameters, model.scaled_inputs(points)), self._spread(points, covariance)
        active = np.array(identified.unknowns.active)  # (A, 2) of (member, unknown)
        term, deviations = law_term(identified.laws, identified.unknowns, points), np.zeros(raw.shape)
        for m in range(len(raw)):
            mine = np.flatnonzero(active[:, 0] == m)
            spread = spreads[:, mine[:, None], mine]
            jitter = 1e-10 * np.trace(spread, axis1=1, axis2=2)[:, None, None] + 1e-30
            root = np.linalg.cholesky(spread + jitter * np.eye(len(mine)))  # (S, n, n)
            normal = ndtri(torch.quasirandom.SobolEngine(len(mine)).draw(2 * count, dtype=torch.float64)[1:].numpy())
            drawn = raw[m].repeat(2 * count, 1, 1)  # the answer itself is the first
            drawn[1:, :, active[mine, 1]] += torch.as_tensor(np.einsum("suv,nv->nsu", root, normal))
            scale, drawn = model.scale_tensor(), drawn[:, None]
            every = term.correct(model, identified.theta[None], drawn, scale, slopes=False)[0][:, 0].numpy()
            low, high = np.quantile(every, [0.025, 0.975], axis=0)
            deviations[m] = np.maximum(high - every[0], every[0] - low) / NOMINAL_95
        return identified.unknowns.expand_deviation(deviations)

    def _spread(self, points: Mapping[str, np.ndarray], covariance: np.ndarray) -> np.ndarray:
        """(S, A + Th, A + Th) covariance of the outputs and of the numbers of laws."""
        outer = self.places.numbers.stop
        return carry_covariance(covariance[:outer, :outer], self._carrier(points).numpy())

    @property
    def without_tolerances(self) -> np.ndarray:
        """(Z, Z) covariance without the tolerances: noise, misfit, and what the functions of the speed can't follow."""
        return np.asarray(self.covariance - self.unfitted.covariance())

    @property
    def places(self) -> Places:
        """Where the blocks lie among the weights, local functions among those of the coefficients."""
        coefficients = len(self.precision) * (self.weights.shape[-1] + self.n_local)
        n_planes, n_parameters = len(self.planes), len(self.parameters)
        numbers = len(self.covariance) - coefficients - 2 * n_planes - n_parameters
        return Places(coefficients, numbers, n_planes, n_parameters)

    @property
    def machine_covariance(self) -> np.ndarray:
        """Covariance of what coefficients follow from (A (K + L) + Th) and of model parameters (T), without planes."""
        places = np.r_[: self.places.numbers.stop, self.places.parameters]
        return np.asarray(self.covariance[np.ix_(places, places)])

    def unbalance_deviation(self) -> np.ndarray:
        """(N,) standard deviation of the residual unbalance's magnitude, kg m: the mean one of its two parts."""
        variance = np.diag(self.covariance)[self.places.planes].reshape(-1, 2).mean(axis=1)
        return np.asarray(self.plane_scale * np.sqrt(variance))


def measure_uncertainty(fit: OutputErrorFit, quality: Quality) -> Uncertainty:
    """The uncertainty of a fit: of noise and functions, as much wider as its deviations say, and of the tolerances."""
    problem, error = fit.problem.scaled(quality.inflation**-0.5), fit.error(quality.inflation)
    unfitted = measure_tolerances(problem, fit.weights, error.fitted, len(error.matrix))
    return _state(fit.identified, problem, fit.weights, error.matrix + unfitted.covariance(), error.n_local, unfitted)


def expect_uncertainty(start: OutputErrorStart, precision: float) -> Uncertainty:
    """That of the fit that will be made, at its likely start: of noise, of tolerances as if they were fitted, and of
    the kinds of bearings that are likely. The fit drops superfluous functions, so it may know more.

    ``precision`` is that of the readings over what their stated noise gives them.
    """
    problem, weights = widen(start.problem.scaled(precision), start.weights)
    covariance = problem.covariance(weights)[0]
    covariance = start.searched.mix(covariance) if start.searched else covariance
    return _state(
        start.problem.identified(start.weights), problem, weights, covariance, 0, none_unfitted(len(covariance))
    )


def _state(
    identified: IdentifiedModel,
    problem: OutputError,
    weights: torch.Tensor,
    covariance: np.ndarray,
    n_local: int,
    unfitted: Unfitted,
) -> Uncertainty:
    noise = problem.measurement.noise
    return Uncertainty(
        identified,
        problem.basis.weights.numpy(),
        covariance,
        np.asarray((problem.precision * problem.kept).numpy()),
        (problem.functions.rows.numpy(), problem.functions.aims.numpy()),
        np.asarray(problem.unbalance(weights)[0].numpy()),
        np.array(problem.measurement.unknowns.planes, dtype=np.int64),
        np.array(problem.measurement.as_found, dtype=complex),
        np.array([noise.additive, noise.multiplicative, *np.ravel(noise.floors)]),
        problem.plane_scale,
        problem.model_parameters(weights)[0].numpy(),
        n_local,
        unfitted,
    )


def save_uncertainty(folder: Path, uncertainty: Uncertainty | None) -> Path:
    """Write ``uncertainty.safetensors``, empty for a loss that states no deviations. Raises StorageError."""
    from safetensors.numpy import save

    parts = (
        {}
        if uncertainty is None
        else {
            "weights": uncertainty.weights,
            "covariance": uncertainty.covariance,
            "precision": uncertainty.precision,
            "prior_rows": uncertainty.functions[0],
            "prior_aims": uncertainty.functions[1],
            "residual_unbalance": np.stack([uncertainty.residual_unbalance.real, uncertainty.residual_unbalance.imag]),
            "planes": uncertainty.planes,
            "as_found": np.stack([uncertainty.as_found.real, uncertainty.as_found.imag]),
            "noise": uncertainty.noise,
            "plane_scale": np.array([uncertainty.plane_scale]),
            "parameters": uncertainty.parameters,
            "n_local": np.array([uncertainty.n_local]),
            "tolerance_kinds": uncertainty.unfitted.kinds,
            "tolerance_moves": uncertainty.unfitted.moves,
            "tolerances": uncertainty.unfitted.second,
        }
    )
    content = save({name: np.ascontiguousarray(array) for name, array in parts.items()})
    return write_beside(folder / UNCERTAINTY, lambda beside: beside.write_bytes(content))


def load_uncertainty(folder: Path, identified: IdentifiedModel) -> Uncertainty | None:
    """Read what :func:`save_uncertainty` wrote; None where it states none. Raises DataError for a damaged file."""
    from safetensors import SafetensorError
    from safetensors.numpy import load_file

    path = folder / UNCERTAINTY
    try:
        parts = load_file(path)
        if not parts:
            return None
        unbalance = parts["residual_unbalance"][0] + 1j * parts["residual_unbalance"][1]
        uncertainty = Uncertainty(
            identified,
            parts["weights"],
            parts["covariance"],
            parts["precision"],
            (parts["prior_rows"], parts["prior_aims"]),
            unbalance,
            parts["planes"],
            parts["as_found"][0] + 1j * parts["as_found"][1],
            parts["noise"],
            float(parts["plane_scale"][0]),
            parts["parameters"],
            int(parts["n_local"][0]),
            Unfitted(parts["tolerance_kinds"], parts["tolerance_moves"], parts["tolerances"]),
        )
        if (
            uncertainty.places.n_numbers != len(identified.theta)
            or len({*uncertainty.covariance.shape, len(uncertainty.unfitted.moves)}) != 1
            or len(uncertainty.weights) != len(identified.parameters)
        ):
            raise ValueError("its numbers do not fit the model")
    except (OSError, SafetensorError, KeyError, IndexError, ValueError) as error:
        raise DataError(
            f"'{path}' must belong to the model beside it, but {error}: train again with stage=train"
        ) from None
    return uncertainty
