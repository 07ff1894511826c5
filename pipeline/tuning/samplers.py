"""Samplers whose draws depend on the study and the trial alone, not on the process that draws them."""

from __future__ import annotations

import warnings
import zlib
from collections.abc import Callable
from typing import TYPE_CHECKING, Any

import numpy as np

from pipeline.config.tuning import TuningConfig

if TYPE_CHECKING:
    import optuna


def sampler(config: TuningConfig) -> optuna.samplers.BaseSampler:
    """The configured sampler.

    An Optuna sampler keeps a random generator in its process: a resumed study would draw its first points again.
    Here each draw has a generator of its own, seeded by (seed, trial number, parameter), so that a study
    interrupted at any moment goes on as if it had not been.
    """
    from optuna.samplers import BaseSampler

    make = {"tpe": _tpe, "random": _random, "gp": _gp}[config.sampler]

    class Seeded(BaseSampler):
        """Delegates each draw to a new sampler."""

        def _drawn_by(self, number: int, name: str = "") -> BaseSampler:
            entropy = [config.sampler_seed, number, zlib.crc32(name.encode())]
            return make(config, int(np.random.SeedSequence(entropy).generate_state(1)[0]))

        def infer_relative_search_space(self, study: Any, trial: Any) -> dict[str, Any]:
            self._relative = self._drawn_by(trial.number)
            return self._relative.infer_relative_search_space(study, trial)

        def sample_relative(self, study: Any, trial: Any, search_space: dict[str, Any]) -> dict[str, Any]:
            # On a second attempt GP would take what it left in the trial for the draw of another worker.
            drawn = _left_by_gp(trial)
            if drawn:
                return {name: value for name, value in drawn.items() if name in search_space}
            return self._relative.sample_relative(study, trial, search_space)

        def sample_independent(self, study: Any, trial: Any, param_name: str, param_distribution: Any) -> Any:
            drawn_by = self._drawn_by(trial.number, param_name)
            return drawn_by.sample_independent(study, trial, param_name, param_distribution)

    return Seeded()


def _left_by_gp(trial: Any) -> dict[str, Any]:
    from optuna.samplers._gp.sampler import _RELATIVE_PARAMS_KEY, _get_params

    return _get_params(trial) if f"{_RELATIVE_PARAMS_KEY}:0" in trial.system_attrs else {}


Maker = Callable[[TuningConfig, int], "optuna.samplers.BaseSampler"]


def _tpe(config: TuningConfig, seed: int) -> optuna.samplers.BaseSampler:
    from optuna.samplers import TPESampler

    return TPESampler(n_startup_trials=config.startup_trials, seed=seed)


def _random(config: TuningConfig, seed: int) -> optuna.samplers.BaseSampler:
    from optuna.samplers import RandomSampler

    return RandomSampler(seed=seed)


def _gp(config: TuningConfig, seed: int) -> optuna.samplers.BaseSampler:
    from optuna.samplers import GPSampler, RandomSampler

    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # `deterministic_objective` is experimental, in Optuna's words
        return GPSampler(
            n_startup_trials=config.startup_trials,
            seed=seed,
            deterministic_objective=True,
            independent_sampler=RandomSampler(seed=seed),
        )


def pruner(config: TuningConfig) -> optuna.pruners.BasePruner:
    """The configured pruner; curves are compared from a third of the last phase on (steps are percent of it)."""
    from optuna.pruners import MedianPruner, NopPruner

    if config.pruner == "none":
        return NopPruner()
    return MedianPruner(n_startup_trials=config.startup_trials, n_warmup_steps=30, n_min_trials=5)
