"""Minimisers of a least-squares problem.

Each takes parameters (G, M, Q) and returns better ones; the G trainings do not influence each other, so that
each of 81 initial guesses trained together takes the same steps as alone, and stays where it ended while others go on.
``monitor`` sees every step and says when to stop.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import TYPE_CHECKING, Protocol

from pipeline.config.identification import AdamConfig, LBFGSConfig, LevenbergMarquardtConfig

if TYPE_CHECKING:
    import torch


class LeastSquares(Protocol):
    """What is minimised: the squares of rows of parameters (G, M, Q).

    By default that of one member, whose rows know their noise and are not rounded.
    """

    def rows(self, parameters: torch.Tensor, /) -> torch.Tensor:
        """(G, M, rows)."""

    def normal(self, parameters: torch.Tensor, /) -> tuple[torch.Tensor, torch.Tensor]:
        """Gradient J'r (G, M, Q) and J'J (G, M, Q, Q)."""

    def level(self, squared: torch.Tensor, /) -> torch.Tensor:
        """(G, M) a root mean square that falls with the sum (G, M) of the squared rows."""

    def loss(self, parameters: torch.Tensor, /) -> torch.Tensor:
        """(G, M) the :meth:`level` at the parameters."""
        return self.level(self.rows(parameters).square().sum(-1))

    def at(self, starts: torch.Tensor, /) -> LeastSquares:
        """The problem of these of the G starts (their indices), by default the same for all of them."""
        return self

    def on(self, device: str) -> LeastSquares:
        """The problem with its tensors on this device, by default where it is made."""
        return self

    def rounding(self) -> torch.Tensor:
        """(M,) what the rounding of the data may make of a loss of zero: losses below it are equal."""
        import torch

        return torch.zeros(1, dtype=torch.float64)

    def scatter(self) -> float:
        """Share of the loss below which a fall is lost in the scatter of the data; 0 where weights know their noise."""
        return 0.0

    def members(self) -> tuple[LeastSquares, ...]:
        """M problems, each of one member by itself: bearings that speak through the same sensors are one."""
        return (self,)


Monitor = Callable[["torch.Tensor", "torch.Tensor"], "torch.Tensor"]
"""(parameters, losses (G, M)) after a step -> which members (G, M) need no further step."""


def adam(problem: LeastSquares, parameters: torch.Tensor, config: AdamConfig, monitor: Monitor) -> torch.Tensor:
    """Adam (Kingma & Ba 2015, Algorithm 1) on the Euclidean norm of the residual (paper, Algorithm 1)."""
    import torch

    # Written out: torch.optim.Adam imports torch's compiler, which takes longer than many a fit.
    current = parameters.clone()
    mean, square = torch.zeros_like(current), torch.zeros_like(current)
    over, last = torch.zeros(len(current), 1, 1, dtype=torch.bool), config.final_rate_fraction
    for step in range(1, config.steps + 1):
        trained = current.detach().requires_grad_()
        losses = problem.loss(trained)
        (gradient,) = torch.autograd.grad(losses.sum(), trained)
        over |= monitor(current, losses.detach()).all(dim=1)[:, None, None]
        if over.all():
            return current
        mean = _MEAN_DECAY * mean + (1 - _MEAN_DECAY) * gradient
        square = _SQUARE_DECAY * square + (1 - _SQUARE_DECAY) * gradient.square()
        size = (square / (1 - _SQUARE_DECAY**step)).sqrt() + _ADAM_EPSILON
        falling = (1 + math.cos(math.pi * ((step - 1) / config.steps))) / 2  # as a cosine, to the ``last`` share
        rate = config.learning_rate * (last + (1 - last) * falling)
        current = torch.where(over, current, current - rate * mean / (1 - _MEAN_DECAY**step) / size)
    return current


# As Kingma & Ba (2015) propose.
_MEAN_DECAY, _SQUARE_DECAY, _ADAM_EPSILON = 0.9, 0.999, 1e-8


def lbfgs(problem: LeastSquares, parameters: torch.Tensor, config: LBFGSConfig, monitor: Monitor) -> torch.Tensor:
    """L-BFGS on the squared residual, each member by itself: a shared line search would couple them."""
    import torch

    result = parameters.clone()
    alone = problem.members()
    members = [(g, m) for g in range(parameters.shape[0]) for m in range(parameters.shape[1])]
    steppers = {(g, m): _lbfgs_stepper(alone[m], parameters[g, m], config.history) for g, m in members}
    done = torch.zeros(parameters.shape[:2], dtype=torch.bool)
    for _ in range(config.steps):
        for g, m in members:
            if not done[g, m]:
                result[g, m] = steppers[g, m]()
        done = monitor(result.clone(), problem.loss(result))
        if done.all():
            break
    return result


def _lbfgs_stepper(problem: LeastSquares, start: torch.Tensor, history: int) -> Callable[[], torch.Tensor]:
    """A function that takes one step for one member and returns its parameters (Q,)."""
    import torch

    trained = start[None, None].clone().requires_grad_()
    # The squared loss has no kink at zero, and divided by its start it has a size that the line search expects.
    size = problem.loss(trained).detach().square().clamp(min=1e-300)
    optimizer = torch.optim.LBFGS(
        [trained],
        max_iter=1,
        max_eval=25,
        history_size=history,
        line_search_fn="strong_wolfe",
        tolerance_grad=0,
        tolerance_change=0,
    )

    def closure() -> torch.Tensor:
        optimizer.zero_grad()
        value = (problem.loss(trained).square() / size).sum()
        value.backward()
        return value

    def step() -> torch.Tensor:
        optimizer.step(closure)
        return trained.detach()[0, 0]

    return step


_DAMPING_UP, _DAMPING_DOWN = 4.0, 0.2
_DAMPING_FLOOR, _DAMPING_CEILING = 1e-16, 1e16


def levenberg_marquardt(
    problem: LeastSquares,
    parameters: torch.Tensor,
    config: LevenbergMarquardtConfig,
    monitor: Monitor,
    by_diagonal: bool = False,
) -> torch.Tensor:
    """Damped Gauss-Newton steps ``(J'J + damping s I) d = -J'r``, each member with its own damping.

    s is the mean of the diagonal of J'J, which makes the damping a pure number, or ``by_diagonal`` that diagonal itself
    (Marquardt 1963), which does not depend on the sizes of the parameters. The systems are solved by Cholesky
    factors: torch's threaded batched LU is wrong on some MKL builds.
    """
    import torch

    current = parameters.clone()
    squared = problem.rows(current).square().sum(-1)
    damping = torch.full_like(squared, config.initial_damping)
    over = torch.zeros(len(current), dtype=torch.bool)
    for _ in range(config.steps):
        active = torch.nonzero(~over)[:, 0]
        current[active], squared[active], damping[active] = _damped_step(
            problem.at(active), current[active], squared[active], damping[active], by_diagonal
        )
        over |= monitor(current, problem.level(squared)).all(dim=1)
        if over.all():
            break
    return current


def _damped_step(
    problem: LeastSquares,
    current: torch.Tensor,
    squared: torch.Tensor,
    damping: torch.Tensor,
    by_diagonal: bool,
    tries: int = 8,
    smallest: float = 1e-12,
) -> tuple[torch.Tensor, torch.Tensor, torch.Tensor]:
    """Parameters (G, M, Q), squared residuals and dampings (G, M) after a step that climbs for no member."""
    import torch

    gradient, normal = problem.normal(current)
    diagonal = normal.diagonal(dim1=-2, dim2=-1)
    size = diagonal.mean(-1, keepdim=True).clamp(min=1e-300)
    size = diagonal.clamp(min=smallest * size) if by_diagonal else size.expand_as(diagonal)
    accepted = torch.zeros_like(squared, dtype=torch.bool)
    for _ in range(tries):
        at = torch.nonzero(~accepted.all(dim=1))[:, 0]  # starts that have a member to try
        if not len(at):
            break
        factor, info = torch.linalg.cholesky_ex(normal[at] + torch.diag_embed(damping[at, ..., None] * size[at]))
        ahead = current[at] - torch.cholesky_solve(gradient[at, ..., None], factor)[..., 0]
        tried = problem.at(at).rows(ahead).square().sum(-1)
        # NaN compares false: an overflowing step is refused like one that climbs.
        better = (tried < squared[at]) & (info == 0) & ~accepted[at]
        current[at] = torch.where(better[..., None], ahead, current[at])
        squared[at] = torch.where(better, tried, squared[at])
        factors = torch.where(better, _DAMPING_DOWN, torch.where(accepted[at], 1.0, _DAMPING_UP))
        damping[at] = (damping[at] * factors).clamp(_DAMPING_FLOOR, _DAMPING_CEILING)
        accepted[at] |= better
    return current, squared, damping


def until_still(share: float = 1e-8) -> Monitor:
    """Ends all fits once a step lowers no loss by more than this ``share`` of it."""
    import torch

    last: list[torch.Tensor] = []

    def monitor(parameters: torch.Tensor, losses: torch.Tensor) -> torch.Tensor:
        before = last.pop() if last else losses + torch.inf
        last.append(losses)
        still = (before - losses).abs() < share * losses
        return torch.full_like(still, bool(still.all()))

    return monitor
