"""The section of recordings: what says too little, or what no recordings can have, is refused."""

from __future__ import annotations

from typing import Any

import pytest
from conftest import refused
from measured_files import CONVENTIONS, probes_config, table_config
from reading import BARE, DISC, ONE, RUNS, waves, with_ingest

from pipeline.errors import ConfigError

BAD_CONFIG: dict[str, tuple[dict[str, Any], str]] = {
    **{
        f"no {missing}": (
            table_config([ONE], conventions={key: value for key, value in CONVENTIONS.items() if key != missing}),
            f"machine.recordings.conventions.{missing}: must be given",
        )
        for missing in CONVENTIONS
    },
    "an unknown unit": (
        table_config([ONE], conventions=CONVENTIONS | {"length": "umm"}),
        "um, mil or mm), but got 'umm'",
    ),
    "a unit of something else": (
        table_config([ONE], conventions=CONVENTIONS | {"length": "kg"}),
        "must be a unit of m",
    ),
    "a sense of phase": (table_config([ONE], conventions=CONVENTIONS | {"phase": "lagg"}), "did you mean 'lag'?"),
    "degrees without a unit": (
        table_config([ONE], probes={"A": {"node": 0, "angle": 45}}),
        "must carry its unit (such as 45 deg)",
    ),
    "a weight without a unit": (
        table_config([ONE | {"unbalances": [DISC | {"magnitude": 200}]}]),
        "must carry its unit (such as 100 g mm), since a number alone is in kg m, but got 200",
    ),
    "a run without excitation": (
        table_config([ONE, BARE]),
        "run 'two' must have unbalances or forces, but it has none",
    ),
    "an excited baseline": (
        table_config([ONE], baseline="one"),
        "must have nothing that excites the baseline run 'one'",
    ),
    "no such baseline": (
        table_config([ONE], baseline="onne"),
        "must have the baseline among its runs, but it is 'onne'; did you mean 'one'?",
    ),
    "two runs of one name": (table_config([ONE, ONE]), "must give every run a name of its own"),
    "no meaning of angles": (table_config([ONE], shaft_angle=None), "must say in shaft_angle how phases of unbalances"),
    "no angle of the tacho": (table_config([ONE], shaft_angle="with_rotation"), "must give tacho.angle"),
    "no file": (table_config([RUNS[0]]), "run 'one' must have a file, but it has none"),
    "no columns": (table_config([ONE], probes=probes_config()), "probe 'A' must have columns in the wide layout"),
    "one column twice": (
        table_config([ONE], probes=probes_config(columns=lambda name: {"amplitude": "a", "phase": "a"})),
        "probe 'A' must have another column of phases than 'a', but has none",
    ),
    "no phase of an unbalance": (
        table_config([{"name": "one", "file": "a", "unbalances": [{"node": 1, "magnitude": "1 g mm"}]}]),
        "machine.recordings.runs.0.unbalances.0.phase: must be given",
    ),
    "unbalances at a frequency of their own": (
        table_config([ONE | {"frequency_hz": 30}]),
        "run 'one' must have no unbalances where its forces have a frequency",
    ),
    "slow roll both ways": (
        table_config([ONE], slow_roll={"below_rpm": 300, "vectors": {"A": {"amplitude": "1 um", "phase": "1 rad"}}}),
        "must give either below_rpm or vectors, but got both",
    ),
    "slow roll of some probes": (
        table_config(
            [ONE],
            slow_roll={
                "vectors": {"A": {"amplitude": "1 um", "phase": "1 rad"}},
                "amplitude": "rms",
                "phase": "lag",
            },
        ),
        "must have one vector a probe (A, B, C, D)",
    ),
    "slow roll without conventions": (
        table_config([ONE], slow_roll={"vectors": {"A": {"amplitude": "1 um", "phase": "1 rad"}}}),
        "must give amplitude (zero_to_peak, peak_to_peak or rms) and phase",
    ),
    "comma twice": (
        table_config([ONE], csv={"delimiter": ",", "decimal": ","}),
        "must have a delimiter that is not the decimal mark",
    ),
    "no encoding": (table_config([ONE], csv={"encoding": "cp12"}), "must have an encoding such as utf-8 or cp1252"),
    "no unit of signals": (waves(signal_unit=None), "signal_unit"),
    "no kind of records": (waves(records=None), "must give records (constant_speed or run_up)"),
    "a run-up without speeds": (waves(speeds=None), "must give speeds"),
    "no scale": (waves(probes=probes_config(channel=lambda name: name)), "probe 'A' must have a scale"),
    "a scale without unit": (
        waves(probes=probes_config(channel=lambda name: name, scale=lambda name: 8)),
        "must carry its unit (such as 7.87 V/mm, 200 mV/mil",
    ),
    "a scale for lengths": (waves(signal_unit="um"), "must have no scale where signals are in um"),
    "teeth without a mark": (
        waves(tacho={"channel": "tacho", "edge": "rising", "pulses_per_revolution": 20}),
        "must give mark_channel where there are 20 pulses a revolution",
    ),
    "no edge": (waves(tacho={"channel": "tacho"}), "machine.recordings.tacho.edge: must be given"),
    "two clocks": (waves(sample_rate_attribute="fs"), "must give at most one of time, sample_rate and"),
    "no unit of time": (waves(sample_rate=None, time="t"), "must give time_unit"),
    "several files of a run-up": (
        waves(runs=[RUNS[0] | {"files": ["a.h5", "b.h5"]}]),
        "must have one file for a run-up, but it has 2",
    ),
    "file and files": (waves(runs=[ONE | {"files": ["a.h5"]}]), "must have file or files, but it has both"),
    "an unknown key": (table_config([ONE], convention={}), "did you mean 'conventions'?"),
    "an unknown key of a run": (
        table_config([ONE | {"speed": 3}]),
        "runs.0.speed: must be a key that the schema knows",
    ),
    "an unknown format": ({"format": "tabel"}, "did you mean 'table'?"),
}


@pytest.mark.parametrize("case", BAD_CONFIG)
def test_a_configuration_that_says_too_little(case: str) -> None:
    section, words = BAD_CONFIG[case]
    with refused(words, "machine.recordings", kind=ConfigError):
        with_ingest(section)
