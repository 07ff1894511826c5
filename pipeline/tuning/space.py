"""The search space: from the configuration's dimensions to a trial's values and back.

Names: a *parameter* is a dimension of the space by its own name (``width``), a *value* a key of the configuration
by its dotted name (``model.width``).
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import TYPE_CHECKING, Any

from pipeline.config.promotion import apply_values, get_value
from pipeline.config.schema import Config
from pipeline.config.tuning import Choice, Dimension, FloatRange, IntegerRange, Preset, Value
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
        if not applies(dimension, parameters):
            continue
        if isinstance(dimension, IntegerRange):
            parameters[name] = trial.suggest_int(name, dimension.low, dimension.high, log=dimension.log)
        elif isinstance(dimension, FloatRange):
            parameters[name] = trial.suggest_float(name, dimension.low, dimension.high, log=dimension.log)
        else:
            chosen: Any = trial.suggest_categorical(name, dimension.options())
            parameters[name] = chosen
    return parameters


def translate(space: Space, parameters: Mapping[str, Value]) -> dict[str, Value]:
    """The values of the configuration that ``parameters`` stand for."""
    values: dict[str, Value] = {}
    for name, parameter in parameters.items():
        dimension = space[name]
        if isinstance(dimension, Preset):
            values |= dimension.choices[str(parameter)]
        else:
            values[dimension.key] = parameter
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


def _find_default(config: Config, name: str, dimension: Dimension) -> Any:
    if isinstance(dimension, Preset):
        fitting = [
            choice
            for choice, values in dimension.choices.items()
            if all(_is_same(get_value(config, key), value) for key, value in values.items())
        ]
        if fitting:  # the one that says most
            return max(fitting, key=lambda choice: len(dimension.choices[choice]))
        keys = dict.fromkeys(key for values in dimension.choices.values() for key in values)
        came = ", ".join(f"{key} = {get_value(config, key)}" for key in keys)
        raise _refuse_default(name, came, f"the choices of {name} are {', '.join(dimension.choices)}")
    value = get_value(config, dimension.key)
    came = f"{dimension.key} = {value}"
    if isinstance(dimension, Choice):
        if not any(_is_same(value, choice) for choice in dimension.choices):
            raise _refuse_default(name, came, f"the choices of {name} are {', '.join(map(str, dimension.choices))}")
    elif not dimension.low <= value <= dimension.high:
        raise _refuse_default(name, came, f"{name} goes from {dimension.low:g} to {dimension.high:g}")
    return value


def _is_same(value: Any, choice: Value) -> bool:
    if isinstance(value, (int, float)) and isinstance(choice, (int, float)):
        return math.isclose(value, choice)
    return bool(value == choice)


def _refuse_default(name: str, came: str, space: str) -> ConfigError:
    return ConfigError(
        f"tuning.space must contain the configured default, which is trial 0, but {came} and {space}: "
        f"widen tuning.space.{name} or change the configured value"
    )


def _check_values(config: Config, name: str, dimension: Dimension) -> None:
    """The schema must take the ends of a range and every choice, beside the first choices that give it a meaning."""
    source, space = f"tuning.space.{name}", config.tuning.space
    beside = translate(space, {other: of[0] for other, of in dimension.when.items()})
    if any(key.startswith("optimizer.") for key in beside):
        beside = _enable_phase(config, beside)
    if isinstance(dimension, Preset):
        for values in dimension.choices.values():
            apply_values(config, beside | _enable_phase(config, values), source)
        return
    for value in dimension.choices if isinstance(dimension, Choice) else (dimension.low, dimension.high):
        apply_values(config, beside | {dimension.key: value}, source)


def _enable_phase(config: Config, values: Mapping[str, Value]) -> dict[str, Value]:
    """``values`` with steps in some phase: a preset names phases that it leaves out, a range the steps of others."""
    phases = [f"optimizer.{phase}.steps" for phase in type(config.optimizer).model_fields]
    free = [key for key in phases if key not in values]
    return dict(values) | ({free[0]: 1} if free else {})
