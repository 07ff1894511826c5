"""A small machine measured as a rig is: conditions with weights in two planes, drift that probes and speeds share."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from balancing import circular
from small_rotor import DIRECT, small_machine

from pipeline.data.conditions import Conditions
from pipeline.parameters.model import model_parameters
from pipeline.problem.condition_noise import spread_conditions, to_dataset
from pipeline.problem.measurement import Measurement
from pipeline.problem.noise_levels import NoiseLevels
from pipeline.rotor.bearing_table import BearingTable

SPEEDS, PLANES = np.array([110.0, 135.0]), (2, 4)
CHANNELS = tuple((node, angle) for node in (1, 3) for angle in (20.0, 110.0))
SIZE = len(SPEEDS) * len(CHANNELS)
HEAVIEST = 5e-4
"""kg m."""
AS_FOUND = np.array([1.5e-4 - 1e-4j, -0.5e-4 + 1e-4j])
"""kg m of the machine itself."""


@dataclass(frozen=True, eq=False)
class SmallRig:
    """The stated machine, with the response as it is, and conditions drawn from it."""

    template: Measurement
    bearings: BearingTable
    conditions: Conditions
    root: np.ndarray  # (D, D) of the covariance of conditions, m


def levels_of_root(root: np.ndarray) -> NoiseLevels:
    """The levels whose conditions have this root (D, D); records without scatter."""
    record = np.zeros((len(SPEEDS), len(CHANNELS), len(CHANNELS)), dtype=complex)
    return NoiseLevels(record, root @ root.conj().T, np.inf)


def correlated_root(rng: np.random.Generator, size: float) -> np.ndarray:
    """(D, D): three quarters of the drift are shared by all probes and speeds."""
    return size * (circular(rng, SIZE, 1) @ circular(rng, 1, SIZE) / np.sqrt(SIZE) + 0.5 * np.eye(SIZE))


def small_rig(
    rng: np.random.Generator,
    count: int = 24,
    drift: float = 2e-7,
    deviations: dict[str, float] | None = None,
    truth: Sequence[float] = (),
    own_speeds: np.ndarray | None = None,
    eight: tuple[float, ...] = DIRECT,
) -> SmallRig:
    """``count`` conditions; ``drift`` m.

    Model parameters have these prior ``deviations`` by kind; the machine is off by ``truth`` (T,) of them.
    ``own_speeds`` (C, S) rad/s are those of the conditions, ``eight`` the coefficients of both bearings.
    """
    made, _ = small_machine(DIRECT)
    bearings = BearingTable((0, 5), SPEEDS, np.tile(eight, (2, len(SPEEDS), 1)))
    unbalance = HEAVIEST * rng.random((count, 2)) * np.exp(2j * np.pi * rng.random((count, 2)))
    unbalance[0] = 0
    blank = spread_conditions(unbalance, PLANES, SPEEDS, CHANNELS)
    if own_speeds is not None:
        blank = replace(blank, own_speeds=own_speeds)
    unknowns = replace(made.unknowns, planes=PLANES)
    plain = replace(made, dataset=to_dataset(blank), known=bearings, unknowns=unknowns)
    template = replace(
        plain,
        parameters=model_parameters(deviations or {}, made.rotor, plain.dataset, bearings, unknowns),
    )
    response = template.update(np.array(truth)).response if len(truth) else template.response
    exact = response.predict(bearings, AS_FOUND).transpose(2, 0, 1)  # (C, S, P)
    root = correlated_root(rng, drift)
    noise = (circular(rng, count, SIZE) @ root.T).reshape(exact.shape)
    assert [len(block.runs) for block in response.blocks] == [count]
    return SmallRig(template, bearings, replace(blank, displacement=exact + noise), root)


def with_noise(rig: SmallRig) -> Measurement:
    """The rig's readings, whose levels are known."""
    noise = replace(levels_of_root(rig.root), counts=rig.conditions.counts, weights=np.ones(len(rig.conditions.names)))
    return replace(rig.template, dataset=to_dataset(rig.conditions), drift=noise)
