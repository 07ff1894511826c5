"""Single mistakes with readings and probes, which :mod:`pipeline.trust.mistakes` tries.

Legend: S speeds, P channels, R runs.
"""

from __future__ import annotations

import itertools
from collections.abc import Iterator, Sequence
from dataclasses import replace

import numpy as np

from pipeline.problem.measurement import Measurement
from pipeline.trust.mistake import LEFT_OUT, Mistake, change, exchange, free_gain, scale

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
            _with_channels(measurement, mirrored),
        )


def _with_channels(measurement: Measurement, channels: tuple[tuple[int, float], ...]) -> Measurement:
    dataset = replace(measurement.dataset, channels=channels)
    return replace(measurement, dataset=dataset, weighed=measurement.deviation)


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
                _with_channels(measurement, turned),
            )
        yield Mistake(
            f"probe '{names[p]}' is left out: it is dead, clipped, loose, or somewhere else",
            f"the signal of '{names[p]}'",
            _without_probe(measurement, p),
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
    yield from _of_bearings(measurement)


def _without_probe(measurement: Measurement, probe: int) -> Measurement:
    """The measurement without a channel."""
    data, rest = measurement.dataset, [p for p in range(len(measurement.dataset.channels)) if p != probe]
    fewer = replace(
        data,
        channels=tuple(data.channels[p] for p in rest),
        displacement=data.displacement[:, rest],
        subtracted=None if data.subtracted is None else data.subtracted[:, rest],
    )
    return replace(measurement, dataset=fewer, weighed=measurement.deviation[:, rest])


def _of_bearings(measurement: Measurement) -> Iterator[Mistake]:
    """The probes of two nodes exchanged."""
    data = measurement.dataset
    nodes = list(dict.fromkeys(node for node, _ in data.channels))
    for a, b in itertools.combinations(nodes, 2):
        channels = {
            node: [p for p, (measured_node, _) in enumerate(data.channels) if measured_node == node] for node in (a, b)
        }
        if len(channels[a]) != len(channels[b]):
            continue
        yield Mistake(
            f"the probes of node {a} and those of node {b} are exchanged",
            "which cables come from which bearing, and from which end the nodes count",
            exchange(measurement, zip(channels[a], channels[b], strict=True), 1),
        )
