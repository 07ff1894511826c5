"""Single mistakes with runs, weights, rotor, runout and baseline, which :mod:`pipeline.trust.mistakes` tries.

Legend: S speeds, P channels, R runs.
"""

from __future__ import annotations

import itertools
from collections.abc import Iterator
from dataclasses import replace

import numpy as np

from pipeline.data.dataset import Excitation, VibrationDataset
from pipeline.problem.measurement import Measurement
from pipeline.trust.mistake import LEFT_OUT, Mistake, change, exchange, free_gain, scale
from pipeline.trust.quick_fit import Free


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
    for i in weights:
        weight = data.excitations[i]
        for node in planes:
            if node != weight.node:
                yield Mistake(
                    f"the weight of run '{weight.run}' at node {weight.node} is at node {node}",
                    f"the plane of the weight of run '{weight.run}'",
                    _with_weights(data, measurement, {i: replace(weight, node=node)}),
                )
        if len([e for e in data.excitations if e.run == weight.run]) > 1 or abs(np.sin(weight.phase)) > straight:
            yield Mistake(
                f"the weight of run '{weight.run}' at node {weight.node} has the wrong sign of its angle",
                "whether angles on the shaft count with the rotation (shaft_angle)",
                _with_weights(data, measurement, {i: replace(weight, phase=-weight.phase)}),
            )
    if any(abs(np.sin(data.excitations[i].phase)) > straight for i in weights):
        mirrored = {i: replace(data.excitations[i], phase=-data.excitations[i].phase) for i in weights}
        yield Mistake(
            "the angles of all weights have the wrong sign (against the rotation)",
            "shaft_angle",
            _with_weights(data, measurement, mirrored),
        )


def _with_weights(data: VibrationDataset, measurement: Measurement, changed: dict[int, Excitation]) -> Measurement:
    acting = tuple(changed.get(i, excitation) for i, excitation in enumerate(data.excitations))
    return replace(measurement, dataset=replace(data, excitations=acting), weighed=measurement.deviation)


# --- rotor, runout, residual unbalance -----------------------------------------------------------------


def of_rest(measurement: Measurement) -> Iterator[Mistake]:
    """Mistakes in rotor, baseline and runout."""
    data = measurement.dataset
    shape = data.displacement.shape
    yield from _of_rotor(measurement)
    turning = measurement.synchronous()
    if turning.sum() > 2 and rotor_planes(measurement):
        unknowns = replace(measurement.unknowns, planes=rotor_planes(measurement))
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
        size = float(np.median(np.abs(data.displacement)))
        yield Mistake(
            "a vector that is the same at all speeds is in the readings: runout",
            "slow_roll, or fit identify.model_parameters.runout",
            measurement,
            Free(np.zeros_like(constant), size * constant),
            gross=False,
        )


def rotor_planes(measurement: Measurement) -> tuple[int, ...]:
    """Nodes at which the machine's own unbalance may be thought of: its discs."""
    return tuple(dict.fromkeys(measurement.rotor.disc_nodes))


_SHARES = (-0.67, -0.2, -0.1, -0.05, -0.03, 0.03, 0.05, 0.1, 0.2)
"""Of Young's modulus: aluminium for steel, hot steel, another diameter."""


def _of_rotor(measurement: Measurement, small: float = 0.15) -> Iterator[Mistake]:
    """Another stiffness or mass; up to a share ``small`` the rotor may be the stated one."""
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
