"""The output error: what the sensors measured against what the coefficients predict, over the sensors' noise.

Under noise of the sensors its minimum is the maximum-likelihood estimate; the residual instead multiplies the noise by
the shaft's dynamic stiffness. The rows are whitened: with the right coefficients they have unit variance.

The hidden layer of the network stays as it was drawn (random features; Rahimi and Recht 2007): the output layer is
linear, the estimate is then close to normal, and its covariance is that of the whole parametrisation. Trained hidden
layers have directions that the data leave free, along which no linearised covariance holds. The free vector z are the
output weights in an orthonormal basis of the features over the training speeds, of which each unknown has as many as
the data determine (:mod:`pipeline.identification.feature_choice`); the others stay zero.

Legend: G data sets or starts, M members (bearings, or 1 where they are alike), S speeds, P channels, R runs, B
bearings, U unknowns, A those of them that members have, K features, N balance planes, Z = A K + 2 N free numbers.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import numpy as np

from pipeline.identification.feature_basis import FeatureBasis
from pipeline.identification.response_block import Block

if TYPE_CHECKING:
    import torch

_ROUNDING = 1e-13
_VANISHED = 0.02
"""An unknown below this share of its guess has vanished."""


@dataclass(frozen=True, eq=False)
class ResponseProblem:
    """Least squares of the free vectors z, (G, 1, Z)."""

    basis: FeatureBasis
    features: torch.Tensor  # (M, S, K) at the speeds of this problem
    scale: torch.Tensor  # (M, 1, U)
    active: tuple[tuple[int, int], ...]  # A of (member, unknown)
    spread: torch.Tensor  # (8 B, A) which coefficients each active unknown moves
    known: torch.Tensor  # (S, 8 B) N/m and N s/m: the other coefficients, zero where identified
    reference: complex
    n_planes: int
    plane_scale: float  # kg m that a free number of 1 stands for
    kept: torch.Tensor  # (A, K) bool: the features that an unknown has
    blocks: tuple[Block, ...]

    @property
    def n_rows(self) -> int:
        """Real numbers that were measured."""
        return 2 * sum(block.weight[0].numel() for block in self.blocks)

    @property
    def size(self) -> int:
        """Z."""
        return len(self.active) * self.features.shape[-1] + 2 * self.n_planes

    @property
    def n_numbers(self) -> int:
        """How many numbers are fitted: Z less the features that are not kept."""
        return int(self.kept.sum()) + 2 * self.n_planes

    def fitted(self) -> torch.Tensor:
        """(Z,) bool: which numbers of the free vector are fitted."""
        import torch

        return torch.cat([self.kept.flatten(), torch.ones(2 * self.n_planes, dtype=torch.bool)])

    # --- from the free vector to coefficients -------------------------------------------------------

    def _outputs(self, free: torch.Tensor) -> torch.Tensor:
        """(G, A, K)."""
        count = self.size - 2 * self.n_planes
        return free[:, 0, :count].unflatten(-1, (len(self.active), -1)) * self.kept

    def unbalance(self, free: torch.Tensor) -> torch.Tensor:
        """(G, N) complex residual unbalance, kg m."""
        import torch

        pairs = free[:, 0, self.size - 2 * self.n_planes :].unflatten(-1, (self.n_planes, 2))
        return self.plane_scale * torch.complex(pairs[..., 0], pairs[..., 1])

    def unknowns(self, free: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
        """(G, S, A) active unknowns in N/m and N s/m, and their derivative by the network's outputs."""
        model, raw = self.basis.model, self.features @ self.coordinates(free).mT  # (G, M, S, U)
        member, unknown = [m for m, _ in self.active], [u for _, u in self.active]
        both = (model.physical(raw, self.scale), model.physical_slope(raw, self.scale))
        values, slope = (of[:, member, :, unknown].movedim(0, -1) for of in both)
        return values, slope

    def coordinates(self, free: torch.Tensor) -> torch.Tensor:
        """(G, M, U, K) outputs of every member; zero where a member does not have an unknown."""
        import torch

        members, n_unknowns = len(self.scale), self.scale.shape[-1]
        full = torch.zeros(len(free), members, n_unknowns, self.features.shape[-1], dtype=free.dtype)
        for a, (m, u) in enumerate(self.active):
            full[:, m, u] = self._outputs(free)[:, a]
        return full

    def network(self, free: torch.Tensor) -> torch.Tensor:
        """(G, M, Q) parameters of the coefficient model."""
        return self.basis.network(self.coordinates(free))

    # --- from coefficients to the sensors -----------------------------------------------------------

    def _change(self, unknowns: torch.Tensor, block: Block) -> torch.Tensor:
        """dH, (G, S, 2 B, 2 B)."""
        import torch

        eight = (unknowns @ self.spread.T + self.known).unflatten(-1, (-1, 2, 2, 2))  # (G, S, B, K or C, row, column)
        blocks = eight[..., 0, :, :] + 1j * block.frequencies[:, None, None, None] * eight[..., 1, :, :]
        n_bearings = blocks.shape[2]
        place = torch.eye(n_bearings, dtype=blocks.dtype)
        full = torch.einsum("gsbij,bc->gsbicj", blocks, place).flatten(4).flatten(2, 3)
        return full - self.reference * torch.eye(2 * n_bearings, dtype=full.dtype)

    def _predicted(self, free: torch.Tensor, block: Block, derivative: bool) -> tuple[torch.Tensor, ...]:
        """q_s (G, S, P, R); with ``derivative`` also T (G, S, P, 2 B), q_b (G, S, 2 B, R) and what the planes add."""
        import torch

        unknowns, _ = self.unknowns(free)
        change = self._change(unknowns, block)
        system = torch.eye(change.shape[-1], dtype=change.dtype) + block.receptance_bearings @ change
        n_runs, n_units = block.forced_bearings.shape[-1], block.unit_bearings.shape[-1]
        right = [block.forced_bearings, block.unit_bearings, *([block.receptance_bearings] if derivative else [])]
        solved = torch.linalg.solve(system, torch.cat(right, dim=-1).expand(*change.shape[:2], -1, -1))
        carried = block.receptance_sensors @ change
        sensors = block.forced_sensors - carried @ solved[..., :n_runs]
        units = block.unit_sensors - carried @ solved[..., n_runs : n_runs + n_units]
        moved = solved[..., :n_runs]
        if n_units:
            residual = self.unbalance(free)[:, None, :, None]
            sensors = sensors + units @ residual
            moved = moved + solved[..., n_runs : n_runs + n_units] @ residual
        if not derivative:
            return (sensors,)
        return sensors, block.receptance_sensors - carried @ solved[..., n_runs + n_units :], moved, units

    def predicted(self, free: torch.Tensor) -> list[torch.Tensor]:
        """(G, S, P, R) m of every block."""
        return [self._predicted(free, block, derivative=False)[0] for block in self.blocks]

    def deviations(self, free: torch.Tensor) -> list[torch.Tensor]:
        """(G, S, P, R) complex, whitened: predicted minus measured, of unit variance in each part."""
        return [(q - b.measured) * b.weight for q, b in zip(self.predicted(free), self.blocks, strict=True)]

    def rows(self, free: torch.Tensor) -> torch.Tensor:
        """(G, 1, rows), whitened."""
        import torch

        parts = [torch.view_as_real(d).reshape(len(free), -1) for d in self.deviations(free)]
        return torch.cat(parts, dim=-1)[:, None]

    def loss(self, free: torch.Tensor) -> torch.Tensor:
        """(G, 1) root mean square of the whitened deviations: 1 where nothing but the stated noise is left."""
        return (self.rows(free).square().sum(-1) / self.n_rows).sqrt()

    def rounding(self) -> torch.Tensor:
        """(1,) the loss that the readings round to: their size over their noise, times their precision."""
        import torch

        squared = [(b.measured * b.weight).abs().square().sum((1, 2, 3)).max() for b in self.blocks]
        return _ROUNDING * (torch.stack(squared).sum() / self.n_rows).sqrt()[None]

    def _by_unknowns(self, free: torch.Tensor, block: Block) -> tuple[torch.Tensor, torch.Tensor, torch.Tensor]:
        """Whitened deviation (G, S, P R), its derivatives by the outputs (.., A) and the planes' numbers (.., 2 N)."""
        import torch

        sensors, through, moved, units = self._predicted(free, block, derivative=True)
        n_bearings = through.shape[-1] // 2
        # d q_s / d H_ij = -T_i q_bj within each bearing, in the order (B, row, column)
        pairs = -torch.einsum(
            "gspbi,gsbjr->gsprbij",
            through.unflatten(-1, (n_bearings, 2)),
            moved.unflatten(-2, (n_bearings, 2)),
        ).flatten(-2)
        both = torch.stack([pairs, 1j * block.frequencies[:, None, None, None, None] * pairs], dim=-2)
        _, slope = self.unknowns(free)
        derivative = (both.flatten(-3) @ self.spread.to(both.dtype)) * slope[:, :, None, None]
        derivative = (derivative * block.weight[..., None]).flatten(2, 3)
        deviation = ((sensors - block.measured) * block.weight).flatten(2)
        if not self.n_planes:
            return deviation, derivative, derivative[..., :0]
        own = torch.zeros(*sensors.shape, self.n_planes, dtype=sensors.dtype)
        if units.shape[-1]:
            own = units[:, :, :, None, :].expand(own.shape) * block.weight[..., None]
        own = self.plane_scale * own.flatten(2, 3)
        return deviation, derivative, torch.stack([own, 1j * own], dim=-1).flatten(-2)

    def sensitivity(self, free: torch.Tensor) -> np.ndarray:
        """(S, rows, A) derivative of the whitened rows of each speed by the outputs, of one free vector (1, 1, Z)."""
        import torch

        parts = [self._by_unknowns(free, block)[1][0] for block in self.blocks]
        return np.asarray(torch.cat([half for part in parts for half in (part.real, part.imag)], dim=1).numpy())

    def jacobian(self, free: torch.Tensor) -> torch.Tensor:
        """(G, 1, rows, Z) derivative of :meth:`rows`: large; :meth:`normal` does without it."""
        import torch

        own = self._own_features().to(torch.complex128)
        parts = []
        for block in self.blocks:
            _, outputs, planes = self._by_unknowns(free, block)
            full = torch.einsum("gsda,ask->gsdak", outputs, own).flatten(-2)
            parts.append(torch.view_as_real(torch.cat([full, planes], dim=-1)).movedim(-1, -2).flatten(1, 3))
        return torch.cat(parts, dim=1)[:, None]

    def _own_features(self) -> torch.Tensor:
        """(A, S, K), zero where not kept."""
        return self.features[[m for m, _ in self.active]] * self.kept[:, None]

    def normal(self, free: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
        """Gradient J'r (G, 1, Z) and J'J (G, 1, Z, Z), summed speed by speed: the features are the same in all rows.

        Numbers that are not fitted have a gradient of 0 and 1 on the diagonal, so that a step leaves them.
        """
        import torch

        own = self._own_features()
        outer = self.size - 2 * self.n_planes
        gradient = torch.zeros(len(free), self.size, dtype=free.dtype)
        matrix = torch.diag((~self.fitted()).to(free.dtype)).repeat(len(free), 1, 1)
        for block in self.blocks:
            deviation, outputs, planes = self._by_unknowns(free, block)
            real = [torch.cat([part.real, part.imag], dim=2) for part in (deviation[..., None], outputs, planes)]
            right, by_output, by_plane = real
            local = by_output.mT @ by_output  # (G, S, A, A)
            gradient[:, :outer] += torch.einsum("gsa,ask->gak", (by_output.mT @ right)[..., 0], own).flatten(1)
            for a in range(len(self.active)):
                weighted = own[a][None, :, :, None] * local[:, :, a, None, :]  # (G, S, K, A)
                rows = slice(a * own.shape[-1], (a + 1) * own.shape[-1])
                matrix[:, rows, :outer] += torch.einsum("gskc,csl->gkcl", weighted, own).flatten(2)
            if self.n_planes:
                mixed = torch.einsum("gsan,ask->gakn", by_output.mT @ by_plane, own).flatten(1, 2)
                matrix[:, :outer, outer:] += mixed
                matrix[:, outer:, :outer] += mixed.mT
                matrix[:, outer:, outer:] += (by_plane.mT @ by_plane).sum(1)
                gradient[:, outer:] += (by_plane.mT @ right).sum(1)[..., 0]
        return gradient[:, None], matrix[:, None]

    # --- fewer features ------------------------------------------------------------------------------

    def truncated(self, order: int) -> ResponseProblem:
        """The same with the first ``order`` features alone, and a free vector that is as much shorter."""
        return replace(self, features=self.features[..., :order], kept=self.kept[:, :order])

    def with_features(self, free: torch.Tensor, order: int) -> torch.Tensor:
        """The free vector (G, 1, ..) of this problem as one of ``order`` features: cut, or filled up with zeros."""
        import torch

        planes = free[..., self.size - 2 * self.n_planes :]
        own = free[..., : self.size - 2 * self.n_planes].unflatten(-1, (len(self.active), -1))
        missing = order - own.shape[-1]
        return torch.cat([torch.nn.functional.pad(own, (0, missing)).flatten(-2), planes], dim=-1)

    def revived(self, free: torch.Tensor) -> torch.Tensor:
        """(0 or 1, 1, Z) the free vector (1, 1, Z) with unknowns that vanished put back to their guess; none did: 0.

        What must be positive is an exponential: once it has all but vanished, nothing draws it back.
        """
        import torch

        values = self.unknowns(free)[0][0].abs().median(dim=0).values  # (A,)
        positive = torch.tensor([self.basis.model.positive[u] for _, u in self.active])
        gone = positive & (values < _VANISHED * torch.stack([self.scale[m, 0, u] for m, u in self.active]))
        if not gone.any():
            return free[:0]
        count = self.size - 2 * self.n_planes
        own = free[0, 0, :count].unflatten(-1, (len(self.active), -1)) * ~gone[:, None]
        return torch.cat([own.flatten(), free[0, 0, count:]])[None, None]

    # --- other data ----------------------------------------------------------------------------------

    def member(self, m: int) -> ResponseProblem:
        """All bearings speak through the same sensors: the problem has one member."""
        assert m == 0
        return self

    def to(self, device: str) -> ResponseProblem:
        """The same on another device, to be used under ``torch.device(device)``; the basis stays where it is."""
        names = ("features", "scale", "spread", "known", "kept")
        moved = {name: getattr(self, name).to(device) for name in names}
        return replace(self, **moved, blocks=tuple(block.to(device) for block in self.blocks))

    def with_measured(self, measured: list[torch.Tensor]) -> ResponseProblem:
        """The same for other data (G, S, P, R) of each block."""
        blocks = [replace(block, measured=one) for block, one in zip(self.blocks, measured, strict=True)]
        return replace(self, blocks=tuple(blocks))
