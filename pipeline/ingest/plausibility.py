"""What measured data look like when a unit or a convention is wrong."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from itertools import combinations
from typing import Any

import numpy as np

from pipeline.coefficients import COEFFICIENTS
from pipeline.config.measured import MeasuredProbeConfig
from pipeline.config.quantities import middle
from pipeline.data.dataset import VibrationDataset
from pipeline.data.simulate import solve_response
from pipeline.errors import ConfigError, DataError
from pipeline.rotor.bearing_table import BearingTable
from pipeline.rotor.model import RotorModel
from pipeline.write_numbers import write_number, write_rough


def note_size(
    dataset: VibrationDataset, rotor: RotorModel, stiffness: float, damping: float, far_off: float = 300.0
) -> list[str]:
    """A sentence where amplitudes of a run are far from the model's, median over speeds and channels.

    The model is the rotor on isotropic bearings of ``stiffness`` (N/m) and ``damping`` (N s/m), a guess. No bearing
    changes the vibration by the factor ``far_off``; a forgotten unit (um for m, mm for um) changes it by a thousand.
    """
    given = {"kxx": stiffness, "kyy": stiffness, "cxx": damping, "cyy": damping}
    values = np.array([given.get(name, 0.0) for name in COEFFICIENTS])
    shape = (len(rotor.bearing_nodes), len(dataset.speeds), len(COEFFICIENTS))
    bearings = BearingTable(rotor.bearing_nodes, dataset.speeds, np.broadcast_to(values, shape))
    response = solve_response(rotor, bearings, dataset.excitations, dataset.runs, dataset.frequencies)
    modelled = np.abs(dataset.sensor_matrix(rotor) @ response)
    measured, far = np.abs(dataset.displacement), dict[str, float]()
    for r, run in enumerate(dataset.runs):
        both = (modelled[..., r] > 0) & (measured[..., r] > 0)
        ratio = float(np.median(measured[both, r] / modelled[both, r])) if both.any() else 1.0
        if not 1 / far_off <= ratio <= far_off:
            far[run] = ratio
    if not far:
        return []
    ratio, runs = max(far.values(), key=lambda ratio: abs(np.log(ratio))), ", ".join(f"'{run}'" for run in far)
    text = f"{write_rough(ratio)} times larger" if ratio > 1 else f"{write_rough(1 / ratio)} times smaller"
    return [
        f"the amplitudes of run {runs} are {text} than the rotor's on bearings of {write_rough(stiffness)} N/m "
        "(median): is a unit wrong, of the lengths or of the unbalances?"
    ]


def require_clearance(dataset: VibrationDataset, stated: Mapping[int, Mapping[str, Any]], most: float = 3.0) -> None:
    """Raise DataError where an amplitude leaves the radial clearance that is ``stated`` at its node, by the key of what
    states it; of a guess the one that is ``most`` standard deviations larger."""
    for node, (key, source) in ((node, item) for node, sources in stated.items() for item in sources.items()):
        number = getattr(source, "radial_clearance", np.inf)
        clearance = middle(number) * getattr(number, "within", 1.0) ** most
        here = [c for c, channel in enumerate(dataset.channels) if channel[0] == node]
        largest = np.abs(dataset.displacement[:, here]).max(axis=(0, 1), initial=0.0)
        if largest.max() > clearance:
            raise DataError(
                f"amplitudes at node {node} must lie within the radial clearance of its bearing "
                f"({key}.radial_clearance: at most {1e6 * clearance:g} um), but run "
                f"'{dataset.runs[int(largest.argmax())]}' has {write_number(1e6 * largest.max())} um, "
                f"{write_number(largest.max() / clearance, digits=3)} times "
                "as much: check the unit (um called mm are 1000 times too large, um called mil 25.4 times), or correct "
                "the clearance"
            )


def note_whirl(dataset: VibrationDataset) -> list[str]:
    """A sentence for each run of unbalances whose orbits turn backward at most speeds: an unbalance turns forward."""
    return [
        f"the orbits of run '{run}' turn backward at {100 * share:.0f} % of speeds and nodes, and an "
        "unbalance turns the shaft forward, from x to y: check the sense of the phase (lag or lead) and the "
        "probes' angles"
        for run, share in measure_backward(dataset).items()
        if share > 0.5
    ]


def measure_backward(dataset: VibrationDataset) -> dict[str, float]:
    """The share of speeds and nodes at which the orbits of each run of unbalances turn backward."""
    shares, orbits = {}, np.array([*dataset.orbits.values()]).reshape(-1, len(dataset.speeds), 2, len(dataset.runs))
    for r, run in enumerate(dataset.runs):
        x, y = orbits[:, dataset.present[:, r], :, r].transpose(2, 0, 1)
        if {excitation.kind for excitation in dataset.excitation_of(r)} == {"unbalance"} and x.size:
            shares[run] = float((np.abs(x - 1j * y) > np.abs(x + 1j * y)).mean())
    return shares


def note_alike(dataset: VibrationDataset, repeated: float = 0.1) -> list[str]:
    """A sentence for each pair of runs that state the same weights and whose readings are no repetition, or that state
    others and have the same readings.

    Readings of a run that was repeated differ by the share ``repeated`` at most (median).
    """
    every, notes = map(dataset.excitation_of, range(len(dataset.runs))), list[str]()
    stated = [frozenset(e for e in acting if e.magnitude) for acting in every]
    for a, b in combinations([r for r, acting in enumerate(stated) if acting], 2):
        pair = dataset.displacement[..., [a, b]]
        first, second = pair[(pair != 0).all(axis=-1)].T
        off = float(np.median(np.abs(first - second) / np.abs(first))) if len(first) else np.nan
        runs = f"runs '{dataset.runs[a]}' and '{dataset.runs[b]}'"
        if stated[a] == stated[b] and off > repeated:
            notes.append(
                f"{runs} state the same weights, but their readings differ by {write_rough(100 * off)} % (median): "
                "correct the weight or the file of one; if one repeats the other, the machine changed between them"
            )
        elif stated[a] != stated[b] and off == 0:
            notes.append(f"{runs} have the same readings, but state other weights: correct the file of one")
    return notes


def note_dead(run: str, sizes: Mapping[str, float], dead: float = 0.01) -> list[str]:
    """A sentence for each probe of a ``run`` that reads next to nothing, from the root mean squares of all, m.

    Below the share ``dead`` of what the probes read (median) one is not connected.
    """
    usual = float(np.median(list(sizes.values())))
    return [
        f"probe '{probe}' of run '{run}' reads {write_rough(100 * size / usual)} % of what the probes read (median): "
        "is it dead, or is its scale that of another unit?"
        for probe, size in sizes.items()
        if 0 < size < dead * usual
    ]


def note_clipping(where: str, signals: Mapping[str, np.ndarray], clipped: float = 0.01) -> list[str]:
    """A sentence for each probe whose signal stays at its largest or smallest value: it left its range.

    That is more than the share ``clipped`` of its samples; a sine of a thousand levels has one in a hundred there.
    """
    notes = []
    for probe, signal in signals.items():
        ends = [signal == signal.max(), signal == signal.min()]
        held = max(float((end[1:] & end[:-1]).mean()) for end in ends) if np.ptp(signal) > 0 else 0.0
        if held > clipped:
            notes.append(
                f"{where}, probe '{probe}': the signal stays at one end of its range in {write_rough(100 * held)} % "
                "of the samples: it is clipped, so that its amplitudes are too small; measure again with a wider range"
            )
    return notes


def note_ringing(
    where: str,
    force: np.ndarray,
    signals: Mapping[str, np.ndarray],
    samples: int,
    last: float = 0.05,
    faded: float = 0.03,
) -> list[str]:
    """A sentence for each probe that still rings at the end of a segment of so many ``samples`` with an impact.

    That is where the ``last`` share of a segment has an amplitude of more than the share ``faded`` of its largest one:
    a window that cuts a decay off at the share r spoils the peak of a mode by r. A force that lasts is no impact.
    """
    left = {}
    for name, signal in {"": force, **signals}.items():
        segments = signal[: len(signal) // samples * samples].reshape(-1, samples)
        swing = np.abs(segments - np.median(segments, axis=1, keepdims=True))
        end = np.sqrt(2 * (swing[:, -round(last * samples) :] ** 2).mean(axis=1))
        left[name] = end / np.maximum(swing.max(axis=1), np.finfo(float).tiny)
    impacts = left.pop("") < faded
    return [
        f"{where}, probe '{name}': {write_rough(100 * share)} % of the largest motion after an impact is left at the "
        "end of a segment, so that responses leak and modes look too damped; record until it has rung down, and take "
        "segments as long (averaging.segment)"
        for name, share in ((name, float((shares * impacts).max())) for name, shares in left.items())
        if share > faded
    ]


def note_sweep(where: str, force: np.ndarray, samples: int, few: float = 0.25, fewest: int = 8) -> list[str]:
    """A sentence for a ``force`` of which each line is in ``few`` of its segments of so many ``samples``, by power.

    Of n segments with powers p, ``(sum p)^2 / sum p^2`` count: half of them where a force is random and lasts, all of
    equal sweeps, one or two of a single sweep. Fewer than ``fewest`` don't tell.
    """
    segments = force[: len(force) // samples * samples].reshape(-1, samples)
    power = np.abs(np.fft.rfft(segments * np.hanning(samples), axis=1)) ** 2
    total = power.sum(axis=0)
    counted = (total**2 / np.maximum((power**2).sum(axis=0), np.finfo(float).tiny))[total >= 0.01 * total.max()]
    if len(segments) < fewest or np.median(counted) > few * len(segments):
        return []
    return [
        f"{where}: a frequency of the force is in {write_rough(np.median(counted))} of {len(segments)} segments, as of "
        "a single sweep, whose responses leak under Hann's window: they and their noise may be up to 25 % off; take "
        "averaging.window: boxcar with a segment for each of several equal sweeps, or a random force"
    ]


def note_casing(probes: Mapping[str, MeasuredProbeConfig], nodes: Sequence[int], n_nodes: int) -> list[str]:
    """A sentence for the probes on a casing that is none of the model's, which follow the shaft's ``n_nodes``.

    Raises ConfigError for one that is at none of the bearing ``nodes``.
    """
    casing = {name: p.node for name, p in probes.items() if p.mounted == "casing" and p.node < n_nodes}
    for name, node in casing.items():
        if node not in nodes:
            raise ConfigError(
                f"machine.recordings.probes.{name} must be at a bearing ({', '.join(map(str, nodes))}) where it "
                f"has mounted: casing, but it is at node {node}: no casing is in the model there, leave the probe out"
            )
    if not casing:
        return []
    return [
        f"probes on the casing ({', '.join(casing)}) are taken for the shaft's motion: that holds where the bearing is "
        "much stiffer than what it stands on, and the coefficients are then those of the support; elsewhere the "
        "shaft moves by the film's deflection more"
    ]
