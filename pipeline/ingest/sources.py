"""The 1X vectors of all runs, from whichever format they are in."""

from __future__ import annotations

from pipeline.config.recordings import AnyRecordingsConfig, TableRecordingsConfig, UffRecordingsConfig
from pipeline.ingest.table import read_table_runs
from pipeline.ingest.tracks import RunTracks
from pipeline.ingest.uff import read_uff_runs
from pipeline.ingest.waveform import read_signal_runs


def read_runs(config: AnyRecordingsConfig) -> tuple[RunTracks, ...]:
    """The runs of the configuration, in its order. Raises DataError."""
    if isinstance(config, TableRecordingsConfig):
        return read_table_runs(config)
    if isinstance(config, UffRecordingsConfig) and not config.tacho.recorded:
        return read_uff_runs(config)
    return read_signal_runs(config)
