"""Samplers whose draws depend on the study and the trial alone, not on the process that draws them."""

from __future__ import annotations

import sys
import warnings
import zlib
from collections.abc import Mapping
from typing import TYPE_CHECKING, Any

import numpy as np

from pipeline.config.tuning import TuningConfig, Value
from pipeline.tuning.attempts import list_attempts

if TYPE_CHECKING:
    import optuna


def make_sampler(config: TuningConfig, default: Mapping[str, Value] | None = None) -> optuna.samplers.BaseSampler:
    """The configured sampler; trial 0 gets the parameters of ``default``.

    An Optuna sampler keeps a random generator in its process: a resumed study would draw its first points again.
    Here each draw has a generator of its own, seeded by (seed, place of the trial, parameter), so that a study
    interrupted at any moment goes on as if it had not been.
    """
    from optuna.samplers import BaseSampler

    class Seeded(BaseSampler):
        """Delegates each draw to a new sampler."""

        place: int  # of the trial that is drawn; beyond any total where another attempt has it

        def _delegate(self, name: str = "") -> BaseSampler:
            entropy = [config.sampler_seed, self.place, zlib.crc32(name.encode())]
            return _make_delegate(config, int(np.random.SeedSequence(entropy).generate_state(1)[0]))

        def before_trial(self, study: Any, trial: Any) -> None:
            numbers = [other.number for other in list_attempts(study)]
            self.place = numbers.index(trial.number) if trial.number in numbers else sys.maxsize
            self._given = default if default and self.place == 0 else {}

        def infer_relative_search_space(self, study: Any, trial: Any) -> dict[str, Any]:
            self._relative = self._delegate()
            return {} if self._given else self._relative.infer_relative_search_space(study, trial)

        def sample_relative(self, study: Any, trial: Any, search_space: dict[str, Any]) -> dict[str, Any]:
            return self._relative.sample_relative(study, trial, search_space) if search_space else {}

        def sample_independent(self, study: Any, trial: Any, param_name: str, param_distribution: Any) -> Any:
            if param_name in self._given:
                return self._given[param_name]
            return self._delegate(param_name).sample_independent(study, trial, param_name, param_distribution)

    return Seeded()


def find_place(trial: optuna.trial.Trial) -> int:
    """The place of a trial that was just asked of a study with a :func:`make_sampler`; beyond any total without one."""
    sampler: Any = trial.study.sampler
    return sampler.place


def _make_delegate(config: TuningConfig, seed: int) -> optuna.samplers.BaseSampler:
    from optuna.samplers import GPSampler, RandomSampler, TPESampler

    if config.sampler == "random":
        return RandomSampler(seed=seed)
    if config.sampler == "tpe":
        return TPESampler(n_startup_trials=config.startup_trials, seed=seed)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # `deterministic_objective` is experimental, in Optuna's words
        return GPSampler(
            n_startup_trials=config.startup_trials,
            seed=seed,
            deterministic_objective=True,
            independent_sampler=RandomSampler(seed=seed),
        )


def make_pruner(config: TuningConfig) -> optuna.pruners.BasePruner:
    """The configured pruner; curves are compared from a third of the last phase on (steps are percent of it)."""
    from optuna.pruners import MedianPruner, NopPruner

    if config.pruner == "none":
        return NopPruner()
    return MedianPruner(n_startup_trials=config.startup_trials, n_warmup_steps=30, n_min_trials=5)
