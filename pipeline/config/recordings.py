"""The schema of recordings, which ``stage=ingest`` reads: one class for each format."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, Annotated, Literal

from pydantic import Field, PositiveFloat, PositiveInt, model_validator

from pipeline.config.measured import (
    ConventionsConfig,
    CsvConfig,
    MeasuredConfig,
    MeasuredRunConfig,
    OrderTrackingConfig,
    ProbeConfig,
    TachoAngleConfig,
    Text,
    VectorConventionsConfig,
)
from pipeline.config.motion import SignalUnit
from pipeline.config.operating import ConditionColumns
from pipeline.config.quantities import Frequency
from pipeline.config.records import RecordsConfig
from pipeline.config.runs import check_frequency
from pipeline.config.section import Section

if TYPE_CHECKING:
    import numpy as np

Edge = Literal["rising", "falling"]


class NoRecordingsConfig(Section):
    """Nothing to read: the data are simulated, or the two files of training are there already."""

    format: Literal["none"]


class TableColumnsConfig(Section):
    """Names of columns; all but ``speed`` and ``conditions`` are of the long layout."""

    speed: Text
    conditions: ConditionColumns = Field(default_factory=dict)
    run: Text = "run"
    probe: Text = "probe"
    amplitude: Text = "amplitude"
    phase: Text = "phase"


class ColumnPairConfig(Section):
    """The two columns of a probe in the wide layout."""

    amplitude: Text
    phase: Text


class TableProbeConfig(ProbeConfig):
    """A probe with its columns (wide layout), or with the text that stands for it in the probe column (long)."""

    columns: ColumnPairConfig | None = None
    label: Text | None = None


class TableRunConfig(MeasuredRunConfig):
    """``columns``: of probes that are called otherwise in this file; ``frequency_*``: of forces, not the rotor's."""

    columns: dict[str, ColumnPairConfig] = Field(default_factory=dict)
    frequency_hz: PositiveFloat | None = None
    frequency_ratio: PositiveFloat | None = None

    @property
    def asynchronous(self) -> bool:
        """True where the response has a frequency of its own."""
        return self.frequency_hz is not None or self.frequency_ratio is not None

    def frequencies(self, speeds: np.ndarray) -> np.ndarray:
        """(S,) rad/s of the vibration at the rotor ``speeds`` (S,) rad/s."""
        hz, ratio = self.frequency_hz, self.frequency_ratio
        return 0 * speeds + 2 * math.pi * hz if hz else speeds * (ratio or 1.0)

    @model_validator(mode="after")
    def _synchronous(self) -> TableRunConfig:
        check_frequency(self.name, self.frequency_hz, self.frequency_ratio, bool(self.unbalances))
        return self


class TableRecordingsConfig(MeasuredConfig):
    """Amplitudes and phases over the speed, CSV or Excel: wide (two columns a probe) or long (a row a probe)."""

    format: Literal["table"]
    layout: Literal["wide", "long"]
    conventions: ConventionsConfig
    columns: TableColumnsConfig
    csv: CsvConfig = CsvConfig()
    tacho: TachoAngleConfig = TachoAngleConfig()
    probes: dict[str, TableProbeConfig] = Field(min_length=1)
    runs: tuple[TableRunConfig, ...] = Field(min_length=1)
    leave_out: tuple[str, ...] = ()

    @model_validator(mode="after")
    def _lawful(self) -> TableRecordingsConfig:
        self.check_shared(self.runs, self.probes, self.tacho)
        self.check_units(self.conventions.unit, self.probes)
        for run in self.runs:
            for name, probe in self.probes.items():
                if self.layout == "wide" and probe.columns is None and name not in run.columns:
                    raise ValueError(f"probe '{name}' must have columns in the wide layout, but it has none")
        return self


class SignalConfig(MeasuredConfig):
    """Time signals: in one unit, of records at constant speed or of a run-up or run-down."""

    signal_unit: SignalUnit | None = None
    records: Literal["constant_speed", "run_up"] | None = None
    tracking: OrderTrackingConfig = OrderTrackingConfig()

    def check_signals(self, probes: Mapping[str, ProbeConfig], runs: Sequence[SignalRunConfig]) -> None:
        """Raise ValueError for what time signals need."""
        if self.signal_unit is None:
            raise ValueError("must give signal_unit (V, mV, um ...) for time signals, but it is missing")
        if self.records is None:
            raise ValueError("must give records (constant_speed or run_up) for time signals, but it is missing")
        if self.records == "run_up" and self.speeds is None:
            raise ValueError("must give speeds (start_rpm, stop_rpm, step_rpm) to track in a run-up, but got null")
        self.check_units(self.signal_unit, probes)
        for run in runs:
            if len(run.files) > 1 and self.records == "run_up":
                raise ValueError(f"run '{run.name}' must have one file for a run-up, but it has {len(run.files)}")


class SignalRunConfig(MeasuredRunConfig):
    """``files``: one a speed, where each is a record at constant speed."""

    files: tuple[Text, ...] = ()

    def sources(self, file: str | None) -> tuple[str, ...]:
        """The files of this run; ``file`` is that of the runs that name none. Raises ValueError for two answers."""
        if self.files and self.file:
            raise ValueError(f"run '{self.name}' must have file or files, but it has both")
        return self.files or super().sources(file)


class UffRecordConfig(Section):
    """A dataset 58 is found by a text that one of its ID lines or its response entity is, or by its response DOF."""

    record: Text | None = None
    response: tuple[int, int] | None = None


class UffProbeConfig(ProbeConfig, UffRecordConfig):
    """A probe with its record."""

    @model_validator(mode="after")
    def _named(self) -> UffProbeConfig:
        if self.record is None and self.response is None:
            raise ValueError("must give record (an ID) or response ([node, direction] in the file), but got neither")
        return self


class UffTachoConfig(TachoAngleConfig, UffRecordConfig):
    """The record of the tacho, where the file has time signals; see :class:`TachoConfig`."""

    edge: Edge | None = None
    threshold: float | None = None
    hysteresis: PositiveFloat | None = None

    @property
    def recorded(self) -> bool:
        """True where the file has time signals."""
        return self.record is not None or self.response is not None


class UffRunConfig(SignalRunConfig):
    """``label``: a text among the ID lines of this run's records, where a file has several runs."""

    label: Text | None = None


class UffRecordingsConfig(SignalConfig):
    """Datasets 58 of universal files: complex functions of the speed, or (with the tacho's record) time signals."""

    format: Literal["uff58"]
    conventions: VectorConventionsConfig | None = None
    tacho: UffTachoConfig = UffTachoConfig()
    probes: dict[str, UffProbeConfig] = Field(min_length=1)
    runs: tuple[UffRunConfig, ...] = Field(min_length=1)

    @model_validator(mode="after")
    def _lawful(self) -> UffRecordingsConfig:
        self.check_shared(self.runs, self.probes, self.tacho)
        if not self.tacho.recorded:
            if self.conventions is None:
                raise ValueError(
                    "must give conventions (length, amplitude, phase, speed) for functions of the speed, but they are "
                    "missing: give them, or the tacho's record for time signals"
                )
            self.check_units(self.conventions.unit, self.probes)
            if any(run.files for run in self.runs):
                raise ValueError("must give one file a run for functions of the speed, but a run has files")
            return self
        if self.conventions is not None:
            raise ValueError("must leave conventions out for time signals (signal_unit and scale say all), but it has")
        if self.tacho.edge is None:
            raise ValueError("must give tacho.edge (rising or falling) where the tacho is recorded, but it is missing")
        self.check_signals(self.probes, self.runs)
        return self


class TachoConfig(TachoAngleConfig):
    """Pulses of the shaft: ``edge`` is the one at which the mark stands at the probe.

    ``threshold`` and ``hysteresis`` are in the channel's own numbers; null: from its levels. With several pulses a
    revolution, ``mark_channel`` has the one pulse a revolution that tells which of them is the mark.
    """

    channel: Text
    edge: Edge
    pulses_per_revolution: PositiveInt = 1
    threshold: float | None = None
    hysteresis: PositiveFloat | None = None
    mark_channel: Text | None = None

    @model_validator(mode="after")
    def _marked(self) -> TachoConfig:
        if self.pulses_per_revolution > 1 and self.mark_channel is None:
            raise ValueError(
                f"must give mark_channel where there are {self.pulses_per_revolution} pulses a revolution "
                "(phases would "
                "be relative to any of them), but it is null: give the channel with one pulse a revolution"
            )
        return self


class WaveformProbeConfig(ProbeConfig):
    """``channel``: a CSV column, an HDF5 path or TDMS ``group/channel``."""

    channel: Text


class WaveformRunConfig(SignalRunConfig):
    """``channels``: of probes that are called otherwise in this run's files; ``tacho``: its tacho channel."""

    channels: dict[str, Text] = Field(default_factory=dict)
    tacho: Text | None = None
    sample_rate: Frequency | None = None


class WaveformRecordingsConfig(SignalConfig):
    """Time signals with a tacho: CSV, Excel, HDF5 or TDMS, by the file's ending.

    Time is a channel (``time``), ``sample_rate``, the HDF5 attribute ``sample_rate_attribute`` in Hz, or TDMS's own.
    """

    format: Literal["waveform"]
    tacho: TachoConfig
    time: Text | None = None
    time_unit: Literal["s", "ms", "us"] | None = None
    sample_rate: Frequency | None = None
    sample_rate_attribute: Text | None = None
    csv: CsvConfig = CsvConfig()
    probes: dict[str, WaveformProbeConfig] = Field(min_length=1)
    runs: tuple[WaveformRunConfig, ...] = Field(min_length=1)

    @model_validator(mode="after")
    def _lawful(self) -> WaveformRecordingsConfig:
        self.check_shared(self.runs, self.probes, self.tacho)
        self.check_signals(self.probes, self.runs)
        rates = [self.time, self.sample_rate, self.sample_rate_attribute]
        if sum(rate is not None for rate in rates) > 1:
            raise ValueError("must give at most one of time, sample_rate and sample_rate_attribute, but got several")
        if self.time is not None and self.time_unit is None:
            raise ValueError("must give time_unit (s, ms or us) of the time channel, but it is missing")
        for run in self.runs:
            if run.sample_rate is not None and self.time is not None:
                raise ValueError(f"run '{run.name}' must have no sample_rate where there is a time channel, but it has")
        return self


class RossRecordingsConfig(MeasuredConfig):
    """Responses that ROSS saved: displacements of every node in m over the rotor speed."""

    format: Literal["ross"]
    tacho: TachoAngleConfig = TachoAngleConfig()
    probes: dict[str, ProbeConfig] = Field(min_length=1)
    runs: tuple[MeasuredRunConfig, ...] = Field(min_length=1)

    @model_validator(mode="after")
    def _lawful(self) -> RossRecordingsConfig:
        self.check_shared(self.runs, self.probes, self.tacho)
        self.check_units("m", self.probes)
        return self


AnyRecordingsConfig = (
    TableRecordingsConfig | RecordsConfig | UffRecordingsConfig | WaveformRecordingsConfig | RossRecordingsConfig
)
RecordingsConfig = Annotated[NoRecordingsConfig | AnyRecordingsConfig, Field(discriminator="format")]
