"""What a fit by the output error predicts in place of fitting it: ranges of speed, operating conditions, runs.

Legend: S operating points.
"""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from pipeline.config.identification import TrainingConfig
from pipeline.data.operating import write_condition
from pipeline.errors import ConfigError
from pipeline.problem.measurement import Measurement


def held_out_points(speeds: np.ndarray, operating: Mapping[str, np.ndarray], training: TrainingConfig) -> np.ndarray:
    """(S,) mask of the points that are not fitted: single speeds, a range of them, operating conditions.

    ``speeds`` (S,) rad/s; ``operating`` has (S,) values in SI by name. Raises ConfigError as the functions below.
    """
    return np.asarray(
        held_out_speeds(len(speeds), training.holdout_every)
        | held_out_range(speeds, training)
        | held_out_conditions(operating, training, len(speeds))
    )


def held_out_speeds(count: int, every: int) -> np.ndarray:
    """(S,) mask of every ``every``-th speed; never the first and last, which would test extrapolation."""
    mask = np.zeros(count, dtype=bool)
    if every:
        mask[every // 2 : -1 : every] = True
        mask[:1] = False
    return mask


def held_out_range(speeds: np.ndarray, training: TrainingConfig, same: float = 1e-9) -> np.ndarray:
    """(S,) mask of the ``speeds`` (S,) rad/s in ``training.holdout_range``. Raises ConfigError for none or all."""
    if training.holdout_range is None:
        return np.zeros(len(speeds), dtype=bool)
    low, high = training.holdout_range
    mask = (speeds > low * (1 - same)) & (speeds < high * (1 + same))
    if mask.all() or not mask.any():
        raise ConfigError(
            "training.holdout_range must hold some of the speeds and leave some, but it holds "
            f"{int(mask.sum())} of {len(speeds)}"
        )
    return np.asarray(mask)


def held_out_conditions(
    operating: Mapping[str, np.ndarray], training: TrainingConfig, n_points: int, nearly: float = 1e-3
) -> np.ndarray:
    """(S,) mask of the points at one of the conditions ``training.holdout_operating``, ``nearly`` (a share).

    Raises ConfigError for a condition that the data lack, for a value that no point has, and where none is left.
    """
    mask = np.zeros(n_points, dtype=bool)
    for name, wanted in training.holdout_operating.items():
        if name not in operating:
            raise ConfigError(
                f"training.holdout_operating must name conditions of the data ({', '.join(operating) or 'none'}), but "
                f"got '{name}'"
            )
        here = np.abs(operating[name] - wanted) <= nearly * abs(wanted)
        if not here.any():
            values = ", ".join(dict.fromkeys(write_condition(name, value) for value in operating[name]))
            raise ConfigError(
                f"training.holdout_operating must be a condition that was measured ({values}), but {name} got "
                f"{write_condition(name, wanted)}"
            )
        mask |= here
    if mask.all() and n_points:
        raise ConfigError("training.holdout_operating must leave points to train on, but it holds all of them")
    return mask


def held_out_runs(measurement: Measurement, training: TrainingConfig) -> np.ndarray:
    """Indices of the runs that are predicted rather than fitted. Raises ConfigError as :func:`prepare_output_error`."""
    runs = measurement.dataset.runs
    for name in training.holdout_runs:
        if name not in runs:
            raise ConfigError(f"training.holdout_runs must name runs of the data ({', '.join(runs)}), but got '{name}'")
    held_out = np.array([runs.index(name) for name in training.holdout_runs], dtype=int)
    if len(held_out) == len(runs):
        raise ConfigError("training.holdout_runs must leave a run to train on, but it names all of them")
    return np.sort(held_out)
