"""The 1X vectors of all runs, from whichever format they are in."""

from __future__ import annotations

from pipeline.config.ingest import IngestConfig, NoIngestConfig, TableIngestConfig, UffIngestConfig
from pipeline.errors import ConfigError
from pipeline.ingest.table import read_table_runs
from pipeline.ingest.tracks import RunTracks
from pipeline.ingest.uff import read_uff_runs
from pipeline.ingest.waveform import read_signal_runs


def read_runs(config: IngestConfig) -> tuple[RunTracks, ...]:
    """The runs of the configuration, in its order. Raises DataError, and ConfigError where there is nothing to read."""
    if isinstance(config, NoIngestConfig):
        raise ConfigError(
            "ingest must say what to read, but ingest.format is none: choose ingest=table, ingest=uff58 or "
            "ingest=waveform, "
            "or a file of your own in conf/ingest (docs/ingest.md)"
        )
    if isinstance(config, TableIngestConfig):
        return read_table_runs(config)
    if isinstance(config, UffIngestConfig) and not config.tacho.recorded:
        return read_uff_runs(config)
    return read_signal_runs(config)
