"""The search space: from the configuration's dimensions to a trial's values and back, and how it is drawn from.

Names: a *parameter* is a dimension of the space by its own name (``width``), a *value* a key of the configuration
by its dotted name (``model.width``). Draws depend on the study and the trial alone, not on the process that draws.
"""

from __future__ import annotations

import sys
import warnings
import zlib
from collections.abc import Mapping
from functools import partial
from typing import TYPE_CHECKING, Any

import numpy as np

from pipeline.config.promotion import apply_values, get_value
from pipeline.config.schema import Config
from pipeline.config.tuning import Dimension, TuningConfig, Value
from pipeline.errors import ConfigError
from pipeline.tuning.storage import list_attempts

if TYPE_CHECKING:
    import optuna

Space = Mapping[str, Dimension]


def applies(dimension: Dimension, parameters: Mapping[str, Value]) -> bool:
    """Whether ``dimension`` has a meaning beside the ``parameters`` chosen before it."""
    return all(parameters.get(name) in values for name, values in dimension.when.items())


def suggest(trial: optuna.trial.Trial, space: Space) -> dict[str, Value]:
    """The trial's parameters, drawn by the study's sampler where they are not given."""
    parameters: dict[str, Value] = {}
    for name, dimension in space.items():
        if applies(dimension, parameters):
            parameters[name] = dimension.suggest(trial, name)
    return parameters


def translate(space: Space, parameters: Mapping[str, Value]) -> dict[str, Value]:
    """The values of the configuration that ``parameters`` stand for."""
    every = (space[name].translate(parameter) for name, parameter in parameters.items())
    return {key: value for values in every for key, value in values.items()}


def find_default(config: Config) -> dict[str, Value]:
    """The parameters of trial 0: those that stand for the configured values.

    :raises ConfigError: where the space does not contain them, names a key that is none, or has values that the
        schema refuses
    """
    space = config.tuning.space
    if not space:
        raise ConfigError(
            "a study must have a search space, but tuning.space is empty: choose one, such as tuning=network, or add "
            "a dimension"
        )
    parameters: dict[str, Value] = {}
    for name, dimension in space.items():
        if not applies(dimension, parameters):
            continue
        fitting = dimension.find(partial(get_value, config))
        if not fitting:
            keys = dict.fromkeys(key for parameter in dimension.extremes() for key in dimension.translate(parameter))
            came = ", ".join(f"{key} = {get_value(config, key)}" for key in keys)
            raise ConfigError(
                f"tuning.space must contain the configured default, which is trial 0, but {came} and "
                f"{dimension.describe(name)}: widen tuning.space.{name} or change the configured value"
            )
        parameters[name] = fitting[0]
    for name, dimension in space.items():
        _check_values(config, name, dimension)
    return parameters


def _check_values(config: Config, name: str, dimension: Dimension) -> None:
    """The schema must take the ends of a range and every choice, beside the first choices that give it a meaning."""
    space = config.tuning.space
    beside = translate(space, {other: values[0] for other, values in dimension.when.items()})
    if any(key.startswith("optimizer.") for key in beside):
        beside = _enable_phase(config, beside)
    for parameter in dimension.extremes():
        values = dimension.translate(parameter)
        if dimension.kind == "preset":
            values = _enable_phase(config, values)
        apply_values(config, beside | values, f"tuning.space.{name}")


def _enable_phase(config: Config, values: Mapping[str, Value]) -> dict[str, Value]:
    """``values`` with steps in some phase: a preset names phases that it leaves out, a range the steps of others."""
    phases = [f"optimizer.{phase}.steps" for phase in type(config.optimizer).model_fields]
    free = [key for key in phases if key not in values]
    return dict(values) | ({free[0]: 1} if free else {})


# --- how it is drawn from ----------------------------------------------------------------------------


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


def _make_delegate(config: TuningConfig, seed: int) -> optuna.samplers.BaseSampler:
    from optuna.samplers import GPSampler, RandomSampler, TPESampler

    if config.sampler == "random":
        return RandomSampler(seed=seed)
    if config.sampler == "tpe":
        return TPESampler(n_startup_trials=config.startup_trials, seed=seed)
    with warnings.catch_warnings(action="ignore"):  # `deterministic_objective` is experimental, in Optuna's words
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
