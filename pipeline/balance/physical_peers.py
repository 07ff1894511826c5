"""The physical model and its blend with influence coefficients, as methods that learn from conditions."""

from __future__ import annotations

import numpy as np

from pipeline.balance.blend import Blend, blend
from pipeline.balance.consistency import find_contradictions
from pipeline.balance.peers import Peer
from pipeline.balance.physical import Physical, fit_physical
from pipeline.data.conditions import Conditions
from pipeline.errors import IdentifiabilityError
from pipeline.identification.training import FitSetup
from pipeline.problem.measurement import Measurement


def physical_peers(template: Measurement, setup: FitSetup, rate: float) -> dict[str, Peer]:
    """``physical``: the rotor of the ``template``, fitted to what the influence coefficients find consistent.

    ``blend`` corrects it by influence coefficients. Both leave out conditions that contradict their labels, at the
    false alarms ``rate``. One fit serves both.
    """
    fitted: dict[tuple[object, ...], tuple[Physical, Conditions]] = {}

    def fit(train: Conditions) -> tuple[Physical, Conditions]:
        key = (train.names, train.speeds.tobytes())
        if key not in fitted:
            sound = leave_out(train, rate)
            fitted[key] = fit_physical(template, setup, sound), sound
        return fitted[key]

    def physical(train: Conditions, speeds: np.ndarray) -> Physical:
        model, _ = fit(train)
        return model if np.array_equal(speeds, train.speeds) else model.at(speeds)

    def blended(train: Conditions, speeds: np.ndarray) -> Blend:
        if not np.array_equal(train.speeds, speeds):
            raise IdentifiabilityError(
                "a blend with influence coefficients must be measured at the speeds that it predicts, but these were "
                "not: the physical model alone tells them"
            )
        return blend_with_influence(*fit(train))

    return {"physical": physical, "blend": blended}


def blend_with_influence(physical: Physical, sound: Conditions) -> Blend:
    """The blend, with the noise of the influence coefficients where the conditions suffice to estimate it."""
    try:
        _, influence = find_contradictions(sound)
        return blend(physical, sound, influence.noise, influence.weights, influence.growth)
    except IdentifiabilityError:  # too few to judge one by the others
        return blend(physical, sound, physical.noise, np.ones(len(sound.names)))


def leave_out(train: Conditions, rate: float) -> Conditions:
    """The conditions that do not contradict their labels; all where they are too few to judge one by the others."""
    try:
        return train.without([contradiction.name for contradiction in find_contradictions(train, rate)[0]])
    except IdentifiabilityError:
        return train
