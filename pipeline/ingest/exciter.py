"""Responses of a standing or turning rotor to a measured force: impact, shaker, or the current of a magnetic bearing.

Averages over segments of the signals, without what the force does not explain (Bendat and Piersol, Random Data, 2010):

    H1 = S_xy / S_xx,   Hv = H1 / g,   g^2 = |S_xy|^2 / (S_xx S_yy)

of the force x and a motion y, whose coherence is g^2. H1 is without bias where the noise is the motion's, Hv (Rocklin,
Crowley and Vold 1985) where force and motion are as noisy as each other. The mean square of the noise of H is
``(1 - g^2) S_yy / (S_xx (n - 1))``, twice that which the book gives for one part of n averages; one of them is spent on
H. Near a sharp mode a segment blurs the response, by the inverse square of its length: a third of what segments of half
the length change counts as noise, too. The speed of the rotor and the frequency have nothing to do with each other.

Legend: n averages, F spectral lines of a segment, L of them that are wanted, P probes.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any, ClassVar, Literal

import numpy as np
from pydantic import Field, NonNegativeFloat, PositiveFloat, model_validator

from pipeline.config.measured import MeasuredConfig, TachoAngleConfig
from pipeline.config.motion import Unit, to_motion
from pipeline.config.quantities import Force, ShaftAngle
from pipeline.config.runs import SpeedsConfig
from pipeline.config.section import NonNegativeInt, Section, Text, ascending, rule
from pipeline.errors import DataError
from pipeline.ingest.conventions import to_displacement
from pipeline.ingest.plausibility import note_clipping, note_ringing, note_sweep
from pipeline.ingest.waveform import SignalRunConfig, StoredSignalsConfig, WaveformProbeConfig
from pipeline.write_numbers import write_number


class ReferenceConfig(Section):
    """The channel of the force, or of the current that makes it; ``size`` is the force that one of its numbers stands
    for, such as ``1 V / (22.5 mV/N)``, ``1 A * (35 N/A)`` or ``1 N``."""

    channel: Text
    size: Force


class AveragingConfig(Section):
    """Segments of so many seconds are averaged: random forces with Hann's ``window``, which overlap by half, impacts
    and steps of a sine as they are (boxcar), each within its segment. Responses are at the lines of a segment's
    spectrum that are nearest to frequencies from ``start_hz`` to ``stop_hz``.
    """

    segment: PositiveFloat
    window: Literal["hann", "boxcar"] = "hann"
    estimator: Literal["H1", "Hv"] = "H1"
    start_hz: PositiveFloat
    stop_hz: PositiveFloat
    step_hz: PositiveFloat

    _span = ascending("start_hz", "stop_hz")


class ExciterRunConfig(SignalRunConfig):
    """One place and direction of the force, at a constant speed of the rotor."""

    node: NonNegativeInt
    angle: ShaftAngle
    speed_rpm: NonNegativeFloat = 0.0

    @model_validator(mode="before")
    @classmethod
    def _push(cls, value: Any) -> Any:
        """A force along a line is half a forward and half a backward one."""
        if not isinstance(value, Mapping) or not {"node", "angle"} <= value.keys():
            return value
        phases = {"forward": value["angle"], "backward": f"-({value['angle']})"}
        half = {"node": value["node"], "magnitude": 0.5}
        return {"forces": [half | {"phase": phase, "whirl": whirl} for whirl, phase in phases.items()]} | dict(value)


class ExciterRecordingsConfig(StoredSignalsConfig, MeasuredConfig):
    """Time signals of probes and of a measured force, at constant speeds or with the rotor at rest (0 rpm)."""

    format: Literal["exciter"]
    signal_unit: Unit
    reference: ReferenceConfig
    averaging: AveragingConfig
    probes: dict[str, WaveformProbeConfig] = Field(min_length=1)
    runs: tuple[ExciterRunConfig, ...] = Field(min_length=1)

    by_frequency: ClassVar[bool] = True
    tacho: ClassVar[TachoAngleConfig] = TachoAngleConfig()

    @rule
    def _lawful(self) -> Iterator[str]:
        yield from self.check_units(self.signal_unit)
        asked = self.averaging
        apart = {"hann": 2.0, "boxcar": 1.0}[asked.window] / asked.segment
        if asked.step_hz < apart * (1 - 1e-9):
            yield (
                f"averaging.step_hz must be {write_number(apart, digits=3)} or more for segments of {asked.segment:g} "
                f"s, since nearer lines share their noise, but got {asked.step_hz:g}: take longer segments, or fewer "
                "lines"
            )
        if any(getattr(self, key) for key in ("baseline", "speeds", "slow_roll", "conditions_file")):
            yield "must have no baseline, speeds, slow_roll or conditions_file for an exciter: leave them out"

    @property
    def stated_speeds(self) -> SpeedsConfig:
        """From the lowest to the highest of the tests."""
        rpm = sorted(run.speed_rpm for run in self.runs)
        return SpeedsConfig(start_rpm=rpm[0], stop_rpm=rpm[-1], step_rpm=rpm[-1] - rpm[0] or 1.0)

    def state_frequency(self, run: Any) -> dict[str, float | None]:
        """Keys of a simulated run with the middle of the frequencies."""
        return {"frequency_hz": (self.averaging.start_hz + self.averaging.stop_hz) / 2}

    def describe(self) -> str:
        """What the numbers in the files are taken for."""
        return f"{self.averaging.estimator} of signals in {self.signal_unit} over {self.reference.channel}"

    def read_responses(self) -> tuple[FrequencyResponse, ...]:
        """The averages of each run, over all its files. Raises DataError for files that do not suffice."""
        return tuple(map(self._average, self.runs))

    def _average(self, run: ExciterRunConfig, tie: float = 1 / 36) -> FrequencyResponse:
        """Periodograms of neighbours that overlap by half have the share ``tie`` in common (Welch 1967)."""
        names, said = {name: probe.channel for name, probe in self.probes.items()}, self.averaging
        lengths = [said.segment / shorter for shorter in ((1, 2) if said.window == "hann" else (1,))]
        sums, segments, notes = [np.zeros(())] * len(lengths), 0, list[str]()
        for path in map(Path, run.sources(self.file)):
            time, channels, read = self.read_channels(path, run, [self.reference.channel, *names.values()])
            where = f"'{path}' (run '{run.name}')"
            shown = {name: channels[channel].astype(float) for name, channel in names.items()}
            force, motions = self.reference.size * channels[self.reference.channel].astype(float), [*shown.values()]
            made = [measure_spectra(time, force, np.stack(motions), length, said.window, where) for length in lengths]
            notes += [*read, *note_clipping(where, shown)]
            samples = 2 * len(made[0][0]) - 2
            lasting = said.window == "hann"
            notes += note_sweep(where, force, samples) if lasting else note_ringing(where, force, shown, samples)
            sums = [before + n * spectra for before, (_, spectra, n) in zip(sums, made, strict=True)]
            frequencies, segments = made[0][0], segments + made[0][2]
        n = segments / (1 + 2 * tie * (segments - 1) / segments * (said.window == "hann"))
        if n < 3:
            raise DataError(
                f"run '{run.name}' must have at least 3 segments of {said.segment:g} s, but it has {segments}: record "
                "longer, or take shorter ones (averaging.segment)"
            )
        wanted = np.arange(said.start_hz, said.stop_hz + said.step_hz / 2, said.step_hz)
        if wanted[-1] > frequencies[-1]:
            raise DataError(
                f"run '{run.name}' must be sampled at more than twice averaging.stop_hz, but its spectra end at "
                f"{frequencies[-1]:g} Hz: give a lower one"
            )
        # Segments of all lengths have these lines.
        lines = np.unique(len(lengths) * np.maximum(np.rint(wanted / frequencies[1] / len(lengths)), 1).astype(int))
        if not (sums[0][0, lines].real > 0).all():
            raise DataError(f"run '{run.name}' must have a force at every line, but has none: check reference.channel")
        reach = int(said.step_hz / frequencies[1] / 2)
        response, noise, coherence = average(sums[0], n, lines, reach, said.estimator)
        for shorter in sums[1:]:  # their leakage is four times as large
            noise = np.hypot(noise, np.abs(average(shorter, n, lines // 2, 0, said.estimator)[0] - response) / 3)
        ones, w = np.ones(len(lines), dtype=complex), 2 * np.pi * frequencies[lines]
        units = [to_motion(self.signal_unit, probe.scale) for probe in self.probes.values()]
        metres = np.stack([to_displacement(size * ones, order, w) for order, size in units], axis=1)
        return FrequencyResponse(
            run, frequencies[lines], metres * response, np.abs(metres) * noise, coherence, n, tuple(notes)
        )


@dataclass(frozen=True, eq=False)
class FrequencyResponse:
    """Motion over force at some lines."""

    run: ExciterRunConfig
    frequencies: np.ndarray  # (L,) Hz
    response: np.ndarray  # (L, P) complex, m/N
    noise: np.ndarray  # (L, P) m/N, root mean square of what it is off by
    coherence: np.ndarray  # (L, P)
    averages: float
    notes: tuple[str, ...]


def measure_spectra(
    time: np.ndarray,
    force: np.ndarray,
    motions: np.ndarray,
    segment: float,
    window: str,
    where: str,
    even: float = 1e-2,
) -> tuple[np.ndarray, np.ndarray, int]:
    """Means over segments of so many seconds: (F,) Hz, and the spectra (1 + 2 P, F) S_xx, S_xy and S_yy of a ``force``
    and ``motions`` (P, samples); how many segments there are.

    Raises DataError for a record shorter than a segment, and samples that are not ``even`` (a share of their distance).
    """
    from scipy.signal import csd

    steps, size = np.diff(time), len(time)
    mean = float(steps.mean())
    if np.abs(steps - mean).max() > even * mean:
        raise DataError(f"{where} must be sampled evenly for averages of spectra, but it is not: resample it")
    samples = 2 * round(segment / mean / 2)
    if not 8 <= samples <= size:
        raise DataError(
            f"{where} must be as long as a segment ({segment:g} s) of 8 samples or more, but it has {size} samples in "
            f"{write_number(size * mean, digits=4)} s: take other ones (averaging.segment)"
        )
    overlap = samples // 2 if window == "hann" else 0
    settings: dict[str, Any] = {"window": window, "nperseg": samples, "noverlap": overlap}
    frequencies, crossed = csd(force, np.stack([force, *motions]), 1 / mean, **settings)
    spectra = np.concatenate([crossed, csd(motions, motions, 1 / mean, **settings)[1]])
    return frequencies, spectra, (size - overlap) // (samples - overlap)


def average(
    spectra: np.ndarray, n: float, lines: np.ndarray, beside: int, estimator: str
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Motions over force at ``lines`` (indices) of the ``spectra`` (1 + 2 P, F) of n averages: (L, P) response,
    complex, root mean square of its noise, and coherence.

    What the force does not explain is smooth: its mean over so many lines ``beside`` each is known better than that of
    one line.
    """
    count = len(spectra) // 2
    force, crossed, motion = spectra[0].real, spectra[1 : 1 + count], spectra[1 + count :].real
    explained = np.abs(crossed) ** 2 / np.maximum(force, np.finfo(float).tiny)
    rest = np.maximum(motion - explained, 0.0)
    near = np.clip(lines[:, None] + np.arange(-beside, beside + 1), 1, len(force) - 1)
    coherence = explained[:, lines] / np.maximum(motion[:, lines], np.finfo(float).tiny)
    response = crossed[:, lines] / force[lines] / (np.sqrt(coherence) if estimator == "Hv" else 1.0)
    noise = np.sqrt(rest[:, near].mean(axis=-1) / force[lines] / (n - 1))
    return response.T, noise.T, coherence.T
