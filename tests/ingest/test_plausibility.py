"""What the model says of readings: the motion of a casing is no motion of the shaft."""

from __future__ import annotations

from config.test_motion import ON, said
from conftest import refused
from measured_files import PAIR, probes_config, table_config
from reading import RUNS, parsed

from pipeline.errors import ConfigError
from pipeline.ingest.plausibility import note_casing


def test_the_motion_of_a_casing_is_warned_of_at_a_bearing_and_refused_elsewhere() -> None:
    probes = parsed(
        table_config(
            [RUNS[0] | {"file": "a.csv"}],
            conventions=said("velocity", "mm/s"),
            probes=probes_config(**ON, **PAIR),
        )
    ).probes
    (words,) = note_casing(probes, (0, 2), 6)
    assert "probes on the casing (A, B, C, D) are taken for the shaft's motion" in words
    with refused("machine.recordings.probes.C must be at a bearing (0, 5)", "it is at node 2", kind=ConfigError):
        note_casing(probes, (0, 5), 6)
