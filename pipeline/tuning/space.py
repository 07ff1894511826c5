"""The search space: from the configuration's dimensions to a trial's values and back.

Names: a *parameter* is a dimension of the space by its own name (``width``), a *value* a key of the configuration
by its dotted name (``model.width``).
"""

from __future__ import annotations

from collections.abc import Mapping
from functools import partial
from typing import TYPE_CHECKING

from pipeline.config.promotion import apply_values, get_value
from pipeline.config.schema import Config
from pipeline.config.tuning import Dimension, Value
from pipeline.errors import ConfigError

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
    values: dict[str, Value] = {}
    for name, parameter in parameters.items():
        values |= space[name].translate(parameter)
    return values


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
        if applies(dimension, parameters):
            parameters[name] = _find_default(config, name, dimension)
    for name, dimension in space.items():
        _check_values(config, name, dimension)
    return parameters


def _find_default(config: Config, name: str, dimension: Dimension) -> Value:
    fitting = dimension.find(partial(get_value, config))
    if fitting:
        return fitting[0]
    keys = dict.fromkeys(key for parameter in dimension.extremes() for key in dimension.translate(parameter))
    came = ", ".join(f"{key} = {get_value(config, key)}" for key in keys)
    raise ConfigError(
        f"tuning.space must contain the configured default, which is trial 0, but {came} and "
        f"{dimension.describe(name)}: widen tuning.space.{name} or change the configured value"
    )


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
