"""Which model the data ask for: laws of few numbers, laws that a network corrects, or a network alone.

Each is fitted to all readings, and to all but those of one state (points of equal operating conditions), which it then
predicts. A model is chosen by what it predicts, and a simpler one wins a tie; one that the readings contradict is none.

Legend: S operating points.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace

import numpy as np
from pydantic import TypeAdapter

from pipeline.config.models import ModelConfig, model_fields
from pipeline.data.operating import split_states
from pipeline.errors import ConfigError
from pipeline.identification.fit import default_setup, fit
from pipeline.identification.identified import Fit, answer_of
from pipeline.identification.quality import MISMATCH
from pipeline.identification.training import FitSetup
from pipeline.problem.measurement import Guess, Measurement

TIE = 1.1
"""Mean squares of held-out readings within this factor are equal: ten percent is what their noise makes of them."""


@dataclass(frozen=True)
class Judged:
    """A model, by what it explains and what it predicts."""

    name: str
    probability: float | None  # of as large a misfit if model and noise are right; None where noise is estimated
    chi_square: float  # over what is expected
    numbers: float  # that the fit spent
    criterion: float  # Akaike's: chi-square of all real deviations, and 2 for each number
    held_out: Mapping[str, float]  # state -> mean square over the noise of its readings, not fitted

    @property
    def rejected(self) -> bool:
        """Whether the readings contradict it."""
        return self.probability is not None and self.probability < MISMATCH

    @property
    def predicts(self) -> float:
        """Mean square over the noise of all held-out readings; 1 is noise."""
        return float(np.mean(list(self.held_out.values())))


def setup_model(setup: FitSetup, kind: str) -> FitSetup:
    """The ``setup`` with a model of this kind: ``law``, ``hybrid`` or ``network``; networks as a fit has by default."""
    model = setup.model
    usual = default_setup(Guess(model.initial_stiffness, model.initial_damping)).model
    keys = usual.model_dump() | model.model_dump() | {"kind": kind}
    chosen = {name: keys[name] for name in model_fields(kind)}
    return replace(setup, model=TypeAdapter(ModelConfig).validate_python(chosen))


def judge_models(
    measurement: Measurement, setups: Mapping[str, FitSetup], step: Callable[[str], None]
) -> tuple[Judged, ...]:
    """Judge each model; ``step`` is told what is fitted next.

    Raises ConfigError for fewer than two states, and what fits raise.
    """
    data = measurement.dataset
    states = split_states(data.speeds, data.operating)
    if len(states) < 2:
        raise ConfigError(
            "models are judged at operating conditions that they were not fitted to, but the data have "
            f"{len(states)} state: measure at a second one (an oil temperature 15 K apart, another load)"
        )
    judged = []
    for name, setup in setups.items():
        step(name)
        whole = fit(measurement, setup)
        held_out = {}
        for label, points in states:
            step(f"{name} without {label}")
            rest = np.setdiff1d(np.arange(len(data.speeds)), points)
            held_out[label] = _predict(measurement.select(points), fit(measurement.select(rest), setup))
        summary = whole.quality.summary["fit"]
        square, spent = summary["chi_square"], summary["chi_square"]["numbers"]
        judged.append(
            Judged(
                name,
                summary["mismatch"]["probability"],
                square["value"] / square["expected"],
                spent,
                2 * square["value"] + 2 * spent,
                held_out,
            )
        )
    return tuple(judged)


def _predict(measurement: Measurement, fitted: Fit) -> float:
    """Mean square of the readings' deviations from the fit's prediction, over their noise."""
    answer = answer_of(measurement, fitted.model, fitted.uncertainty)
    predicted = answer.measurement.response.predict(answer.table, answer.unbalance)
    off = np.abs(predicted - measurement.dataset.displacement) / measurement.deviation
    return float((off**2).sum() / measurement.dataset.n_readings)


def choose(judged: tuple[Judged, ...]) -> Judged:
    """The first of the models, which are given from simple to free, that is not rejected and predicts as the best does.

    Where all are rejected: the one that predicts best.
    """
    standing = [model for model in judged if not model.rejected] or list(judged)
    best = min(model.predicts for model in standing)
    return next(model for model in standing if model.predicts <= TIE * best)
