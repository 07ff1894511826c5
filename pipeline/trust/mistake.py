"""Every single mistake that a person may have made, as the measurement without it: what :mod:`pipeline.trust.mistakes`
tries.

Legend: S speeds, P channels, R runs, E free numbers.
"""

from __future__ import annotations

import itertools
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from pipeline.data.dataset import Excitation
from pipeline.parameters.kind import turns_with_rotor
from pipeline.problem.measurement import Measurement
from pipeline.problem.response import ResponseEquations


@dataclass(frozen=True, eq=False)
class Free:
    """Numbers that an explanation leaves free, zero as stated: each adds to the readings in proportion to itself."""

    shares: np.ndarray  # (S, P, R, E) of the predicted readings
    shown: np.ndarray | float = 0.0  # (S, P, R, E) m, whatever is predicted

    def __len__(self) -> int:
        """E."""
        return int(self.shares.shape[-1])


NOTHING_FREE = Free(np.zeros((1, 1, 1, 0)))
"""What an explanation without free numbers has."""


@dataclass(frozen=True, eq=False)
class Mistake:
    """One explanation: the measurement without the mistake, and what it leaves free."""

    sentence: str  # what was done, as "the phases of all readings are leads, not lags"
    check: str  # what to look at
    measurement: Measurement
    free: Free = NOTHING_FREE
    gross: bool = True  # False: a number is a little off
    single: bool = False  # of one run, weight or probe
    penalty: float = 1.0  # on what it leaves over: it explains nothing, or leaves many numbers free
    falls_by: float = 1.0  # mean square over the noise with it over that without it, once it was tried


def alter(
    measurement: Measurement,
    weighed: np.ndarray | None = None,
    solved: ResponseEquations | None = None,
    **data: Any,
) -> Measurement:
    """Another data set, with the noise of its readings where that changes, and the response where that does not."""
    noise = measurement.deviation if weighed is None else weighed
    return replace(measurement, dataset=replace(measurement.dataset, **data), weighed=noise, solved=solved)


def change(measurement: Measurement, displacement: np.ndarray, deviation: np.ndarray) -> Measurement:
    """Other readings with their noise; the response is not solved again."""
    return alter(measurement, deviation, measurement.response, displacement=displacement, subtracted=None)


def scale(measurement: Measurement, factor: np.ndarray | complex) -> Measurement:
    """Readings times ``factor`` (broadcast to (S, P, R))."""
    return change(measurement, measurement.dataset.displacement * factor, measurement.deviation * np.abs(factor))


def exchange(measurement: Measurement, pairs: Iterable[tuple[int, int]], axis: int) -> Measurement:
    """The readings with these ``pairs`` of channels (axis 1) or runs (axis 2) in each other's place."""
    readings, order = measurement.dataset.displacement, np.arange(measurement.dataset.displacement.shape[axis])
    for i, j in pairs:
        order[[i, j]] = j, i
    return change(measurement, np.take(readings, order, axis), np.take(measurement.deviation, order, axis))


def free_gain(measurement: Measurement, chosen: np.ndarray) -> Free:
    """Size and phase of the ``chosen`` readings (mask, broadcast to (S, P, R)) are free."""
    column = chosen * np.ones(measurement.dataset.displacement.shape)
    return Free(np.stack([column, 1j * column], axis=-1))


LEFT_OUT = 3.0
"""The penalty on leaving a probe or a run out, which explains nothing."""


def list_mistakes(measurement: Measurement, names: Sequence[str]) -> Iterator[Mistake]:
    """Every mistake that is tried; ``names`` are the channels'."""
    yield from of_all_readings(measurement)
    for mistakes in (of_probes(measurement, names), of_runs(measurement), of_weights(measurement)):
        yield from (replace(mistake, single=True) for mistake in mistakes)
    yield from of_rest(measurement)


# --- readings and probes ---------------------------------------------------------------------------

_FACTORS = {
    0.5: "peak-to-peak amplitudes taken for zero-to-peak",
    2.0: "zero-to-peak amplitudes taken for peak-to-peak",
    2.0**0.5: "rms amplitudes taken for zero-to-peak",
    2.0**-0.5: "zero-to-peak amplitudes taken for rms",
    25.4: "mil taken for um",
    1 / 25.4: "um taken for mil",
}


def _call_factor(factor: float) -> str:
    return f"{1 / factor:.3g} times too large" if factor < 1 else f"{factor:.3g} times too small"


def of_all_readings(measurement: Measurement) -> Iterator[Mistake]:
    """Mistakes in conventions, which all readings share."""
    data = measurement.dataset
    yield Mistake(
        "the phases of all readings have the wrong sign (lag for lead, or the shaft turns the other way)",
        "conventions.phase, and the sense of rotation",
        change(measurement, data.displacement.conj(), measurement.deviation),
    )
    for factor, text in _FACTORS.items():
        yield Mistake(f"all readings are {_call_factor(factor)}: {text}", "the conventions", scale(measurement, factor))
    for degrees in (90, 180, 270):
        yield Mistake(
            f"all phases are turned by {degrees} deg: the tacho at the other edge or angle, or all weights",
            "tacho.edge, tacho.angle and shaft_angle",
            scale(measurement, np.exp(1j * np.radians(degrees))),
        )
    yield Mistake(
        "all readings, or all weights, are not as stated",
        "the conventions, the tacho's angle, and the unit of the weights",
        measurement,
        free_gain(measurement, np.array(True)),
        gross=False,
    )
    mirrored = tuple((node, -angle % 360.0) for node, angle in data.channels)
    if mirrored != data.channels:
        yield Mistake(
            "the angles of all probes have the wrong sign (counted against the rotation)",
            "the probes' angles, from x towards y in the sense of rotation",
            alter(measurement, channels=mirrored),
        )


def of_probes(measurement: Measurement, names: Sequence[str]) -> Iterator[Mistake]:
    """Mistakes in single probes, and exchanged ones; ``names`` are the channels'."""
    data, count = measurement.dataset, len(measurement.dataset.channels)
    for p in range(count):
        alone = (np.arange(count) == p)[:, None]
        yield Mistake(
            f"probe '{names[p]}' has the wrong sign, or stands opposite to its stated angle",
            f"the wiring, the sign of the scale and the angle of '{names[p]}'",
            scale(measurement, np.where(alone, -1.0, 1.0)),
        )
        for factor, text in _FACTORS.items():
            yield Mistake(
                f"the readings of probe '{names[p]}' are {_call_factor(factor)} (as {text})",
                f"the scale of '{names[p]}'",
                scale(measurement, np.where(alone, factor, 1.0)),
            )
        for turn in (90.0, 270.0):
            node, angle = data.channels[p]
            turned = tuple(
                (node, (angle + turn) % 360.0) if i == p else channel for i, channel in enumerate(data.channels)
            )
            yield Mistake(
                f"probe '{names[p]}' stands {turn:g} deg from its stated angle",
                f"the angle of '{names[p]}'",
                alter(measurement, channels=turned),
            )
        yield Mistake(
            f"probe '{names[p]}' is left out: it is dead, clipped, loose, or somewhere else",
            f"the signal of '{names[p]}'",
            measurement.of_channels([i for i in range(count) if i != p]),
            penalty=LEFT_OUT,
        )
        yield Mistake(
            f"the readings of probe '{names[p]}' are not as stated",
            f"scale and place of '{names[p]}'",
            measurement,
            free_gain(measurement, alone),
            gross=False,
        )
    for i, j in itertools.combinations(range(count), 2):
        yield Mistake(
            f"probes '{names[i]}' and '{names[j]}' are exchanged",
            "the cables of these two channels",
            exchange(measurement, [(i, j)], 1),
        )
    yield from _of_nodes(measurement)


def _of_nodes(measurement: Measurement) -> Iterator[Mistake]:
    """The probes of two nodes exchanged."""
    data = measurement.dataset
    nodes = list(dict.fromkeys(node for node, _ in data.channels))
    for a, b in itertools.combinations(nodes, 2):
        channels = {
            node: [p for p, (measured_node, _) in enumerate(data.channels) if measured_node == node] for node in (a, b)
        }
        if len(channels[a]) == len(channels[b]):
            yield Mistake(
                f"the probes of node {a} and those of node {b} are exchanged",
                "which cables come from which bearing, and from which end the nodes count",
                exchange(measurement, zip(channels[a], channels[b], strict=True), 1),
            )


# --- runs and weights ------------------------------------------------------------------------------


def of_runs(measurement: Measurement) -> Iterator[Mistake]:
    """Mistakes in single runs, and two that are exchanged."""
    data = measurement.dataset
    for i, j in itertools.combinations(range(len(data.runs)), 2):
        if np.array_equal(data.frequencies[:, i], data.frequencies[:, j]):
            yield Mistake(
                f"the recordings of runs '{data.runs[i]}' and '{data.runs[j]}' are exchanged",
                "the files of these runs",
                exchange(measurement, [(i, j)], 2),
            )
    for r, run in enumerate(data.runs):
        alone = np.arange(len(data.runs)) == r
        yield Mistake(
            f"the phases of run '{run}' have the wrong sign (lag for lead)",
            f"the phase convention of run '{run}'",
            change(measurement, np.where(alone, data.displacement.conj(), data.displacement), measurement.deviation),
        )
        for degrees in (90, 180, 270):
            yield Mistake(
                f"the weight of run '{run}' is {degrees} deg from its stated angle",
                f"where the weight of run '{run}' was",
                scale(measurement, np.where(alone, np.exp(-1j * np.radians(degrees)), 1.0)),
            )
        if len(data.runs) > 2:
            yield Mistake(
                f"run '{run}' is left out: it is not the run that it is called",
                f"the recording and the weights of run '{run}'",
                measurement.select(None, np.flatnonzero(~alone)),
                penalty=LEFT_OUT,
            )
        yield Mistake(
            f"the weight of run '{run}' is not as stated",
            f"mass, radius and angle of the weight of run '{run}'",
            measurement,
            free_gain(measurement, alone),
            gross=False,
        )


def of_weights(measurement: Measurement, straight: float = 0.02) -> Iterator[Mistake]:
    """Mistakes in the planes and angles of weights; one whose sine is below ``straight`` has no sign to be wrong."""
    data, rotor = measurement.dataset, measurement.rotor
    weights = [i for i, excitation in enumerate(data.excitations) if excitation.kind == "unbalance"]
    planes = dict.fromkeys([*rotor.disc_nodes, *(data.excitations[i].node for i in weights)])

    def put(changed: dict[int, Excitation]) -> Measurement:
        acting = tuple(changed.get(i, excitation) for i, excitation in enumerate(data.excitations))
        return alter(measurement, excitations=acting)

    for i in weights:
        weight = data.excitations[i]
        for node in planes:
            if node != weight.node:
                yield Mistake(
                    f"the weight of run '{weight.run}' at node {weight.node} is at node {node}",
                    f"the plane of the weight of run '{weight.run}'",
                    put({i: replace(weight, node=node)}),
                )
        if len([e for e in data.excitations if e.run == weight.run]) > 1 or abs(np.sin(weight.phase)) > straight:
            yield Mistake(
                f"the weight of run '{weight.run}' at node {weight.node} has the wrong sign of its angle",
                "whether angles on the shaft count with the rotation (shaft_angle)",
                put({i: replace(weight, phase=-weight.phase)}),
            )
    if any(abs(np.sin(data.excitations[i].phase)) > straight for i in weights):
        mirrored = {i: replace(data.excitations[i], phase=-data.excitations[i].phase) for i in weights}
        yield Mistake(
            "the angles of all weights have the wrong sign (against the rotation)",
            "shaft_angle",
            put(mirrored),
        )


# --- rotor, runout, residual unbalance -----------------------------------------------------------------


_SHARES = (-0.67, -0.2, -0.1, -0.05, -0.03, 0.03, 0.05, 0.1, 0.2)
"""Of Young's modulus: aluminium for steel, hot steel, another diameter."""


def of_rest(measurement: Measurement, small: float = 0.15) -> Iterator[Mistake]:
    """Mistakes in rotor, baseline and runout; up to a share ``small`` the rotor may be the stated one."""
    data = measurement.dataset
    shape = data.displacement.shape
    for share in _SHARES:
        for what, name in (("stiffness", "shaft's Young's modulus (or its diameters)"), ("mass", "rotor's mass")):
            changed = {what: (1 + share) * getattr(measurement.rotor, what)}
            rotor = replace(measurement.rotor, **changed)
            yield Mistake(
                f"the {name} is {abs(100 * share):.0f} % {'larger' if share > 0 else 'smaller'} than stated",
                "machine.rotor: is it this rotor's file, and of this material?",
                replace(measurement, rotor=rotor, weighed=measurement.deviation),
                gross=abs(share) > small,
            )
    turning, planes = turns_with_rotor(data), tuple(dict.fromkeys(measurement.rotor.disc_nodes))
    if turning.sum() > 2 and planes:  # at its discs the machine's own unbalance may be thought of
        unknowns = replace(measurement.unknowns, planes=planes)
        yield Mistake(
            "the machine's own unbalance is in the readings: the baseline is not subtracted, or it is twice",
            "data.baseline, or identify.unbalance_planes",
            replace(measurement, unknowns=unknowns).subtract_unbalance(),
            gross=False,
        )
    if data.subtracted is None and turning.any():
        constant = np.zeros((*shape, 2 * shape[1]), dtype=complex)
        for p in range(shape[1]):
            constant[:, p, :, 2 * p], constant[:, p, :, 2 * p + 1] = turning, 1j * turning
        size = float(np.median(np.abs(data.readings)))
        yield Mistake(
            "a vector that is the same at all speeds is in the readings: runout",
            "slow_roll, or fit identify.model_parameters.runout",
            measurement,
            Free(np.zeros_like(constant), size * constant),
            gross=False,
        )
