"""The raw records of the RK-4 campaign as the tables of examples/rk4, and on through the pipeline's own stages.

    python studies/real_rig/raw_records.py FOLDER output=OUT ['stage=[ingest,train,evaluate,runup]'] [overrides ...]

``FOLDER`` has what the archives of the deposit hold (examples/rk4/README.md says where), unpacked into one place:
``index.csv``, ``conditions.csv``, the records that the first names, ``runout_slowroll.npz`` and ``runup1.npz``. Each
.npz has ``keyphasor`` and four probes in V over 8 s (the run-up: longer), and its sample rate ``fs``. The tables
``OUT/records.csv`` and ``OUT/run_up_1x.csv`` have the columns of ``machine.recordings`` and ``machine.run_up``, and the
stages read them.

The order tracking is that of ``format: waveform``. The mark stands at the keyphasor where its negative pulse falls
through -1.0 V; 0.2 V are a mil; the slow roll's vector is subtracted from records. Vectors of records are written as
the machine's conventions say (their author conjugated them: the angle is a lag), those of the run-up as measured.
Conditions whose weights are not stated, and those of the block ``blind``, are left out.
"""

from __future__ import annotations

import math
import shlex
import sys
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd

from pipeline.__main__ import main as run_pipeline
from pipeline.config.compose import compose_stages
from pipeline.config.messages import quote_override
from pipeline.config.motion import to_motion
from pipeline.config.schema import Config
from pipeline.data.tables import read_table, write_table
from pipeline.errors import MISTAKE, DataError, exit_code, nearest, say_and_return
from pipeline.ingest.conventions import SourceUnits
from pipeline.ingest.order_tracking import Signals, find_range, fit_steady, fit_sweep
from pipeline.ingest.waveform import WaveformRecordingsConfig, WaveformRunConfig
from pipeline.reporting.console import say
from pipeline.units import RAD_S_PER_RPM

SCALE = "200 mV/mil"
SLOW_ROLL, RUN_UP = "runout_slowroll.npz", "runup1.npz"
STAGES = "stage=[ingest,train,evaluate,runup]"
INDEX = {
    **dict.fromkeys(("file", "condition_id", "speed_id", "mount_idx", "acq_idx"), "text"),
    "rpm_measured": "number or blank",
}
WEIGHTS = [(f"disk{disk}_mass_g", f"disk{disk}_angle_deg") for disk in (1, 2)]
CONDITIONS = {
    **dict.fromkeys(("condition_id", "block", "config"), "text"),
    **dict.fromkeys(("radius_mm", *(name for pair in WEIGHTS for name in pair)), "number or blank"),
}


class RawRecords:
    """The files of a folder, read as ``format: waveform`` reads time signals with a tacho."""

    def __init__(self, folder: Path, probes: Sequence[str]) -> None:
        self.folder = folder
        self.recordings = WaveformRecordingsConfig.model_validate(
            {
                "format": "waveform",
                "records": "constant_speed",
                "signal_unit": "V",
                "sample_rate_attribute": "fs",
                "probes": {name: {"node": 0, "angle": 0, "channel": name, "scale": SCALE} for name in probes},
                "tacho": {"channel": "keyphasor", "edge": "falling", "threshold": -1.0},
                "runs": [{"name": "slow_roll", "file": str(folder / SLOW_ROLL)}],
                "baseline": "slow_roll",
            }
        )

    def read(self, file: str) -> Signals:
        """The signals of a file in m. Raises DataError."""
        (signals,) = self.recordings.read_signals(WaveformRunConfig(name=Path(file).stem, file=str(self.folder / file)))
        for note in signals.notes:
            say(note)
        return signals

    def fit_record(self, file: str) -> tuple[float, np.ndarray]:
        """rad/s, and the vectors (P,) of a record at constant speed. Raises DataError."""
        return fit_steady(self.read(file), self.recordings.tracking)

    def fit_slow_roll(self) -> np.ndarray:
        """The runout (P,) m; a motor that turns slowly need not hold its speed. Raises DataError."""
        signals = self.read(SLOW_ROLL).between_pulses()
        mean = np.atleast_1d(signals.angle.speed(signals.time).mean())
        return fit_sweep(signals, mean, self.recordings.tracking)[0][0]

    def fit_run_up(self, low: float, high: float) -> tuple[np.ndarray, np.ndarray]:
        """Speeds (S,) rad/s of the revolutions from ``low`` to ``high``, and vectors (S, P) m. Raises DataError."""
        signals, tracking = self.read(RUN_UP).between_pulses(), self.recordings.tracking
        turned = signals.angle.angle(signals.time) / (2 * np.pi)
        middles = np.arange(np.ceil(turned[0]), np.floor(turned[-1])) + 0.5
        speeds = signals.angle.speed(np.interp(middles, turned, signals.time))
        lowest, highest = find_range(signals, tracking)
        speeds = np.sort(speeds[(speeds >= max(low, lowest)) & (speeds <= min(high, highest))])
        if not len(speeds):
            raise DataError(
                f"'{self.folder / RUN_UP}' must have revolutions from {low / RAD_S_PER_RPM:.0f} to "
                f"{high / RAD_S_PER_RPM:.0f} rpm, but it has none: give machine.run_up.from_rpm and to_rpm"
            )
        return speeds, fit_sweep(signals, speeds, tracking)[0]


@dataclass(frozen=True)
class Labelled:
    """A row of the index whose condition states its weights."""

    file: str
    condition: str
    config: str
    rest: tuple[str, str, str]  # speed_id, mount, acq
    rpm: float
    weights: list[complex]  # g mm at the labelled angles


def list_records(folder: Path) -> list[Labelled]:
    """In the order of the index. Raises DataError for conditions and files that are not there."""
    index, table = read_table(folder / "index.csv", INDEX), read_table(folder / "conditions.csv", CONDITIONS)
    conditions = {str(row["condition_id"]): row for row in pd.DataFrame(table).to_dict("records")}
    listed = []
    for file, name, *rest, rpm in zip(*(index[key] for key in INDEX), strict=True):
        if name not in conditions:
            raise DataError(
                f"'{folder / 'index.csv'}' must name conditions of conditions.csv, but '{name}' is none: "
                f"{nearest(name, conditions)}"
            )
        if weights := weigh(conditions[name]):
            listed.append(Labelled(file, name, str(conditions[name]["config"]), tuple(rest), rpm, weights))
    missing = [file for file in (*(row.file for row in listed), SLOW_ROLL, RUN_UP) if not (folder / file).is_file()]
    if missing:
        raise DataError(
            f"'{folder}' must hold every labelled record that its index.csv names, {SLOW_ROLL} and {RUN_UP}, but it "
            f"lacks {len(missing)}, such as '{missing[0]}': unpack all archives into this one folder"
        )
    return listed


def weigh(condition: Mapping[str, object]) -> list[complex]:
    """The weights of both discs, complex g mm at their labelled angles; nothing where they are not stated."""
    parts = [[float(condition[name]) for name in pair] for pair in WEIGHTS]
    if condition["block"] == "blind" or all(math.isnan(mass) for mass, _ in parts):
        return []
    return [
        complex(np.nan_to_num(mass) * condition["radius_mm"] * np.exp(1j * np.radians(np.nan_to_num(angle))))
        for mass, angle in parts
    ]


def split_parts(places: Iterable[Any], values: Iterable[complex]) -> dict[str, float]:
    """The columns of the probes or weights ``places``: real and imaginary parts, to six decimals."""
    parts = {}
    for place, value in zip(places, values, strict=True):
        parts |= {place.columns.real: round(value.real, 6), place.columns.imaginary: round(value.imag, 6)}
    return parts


def tabulate_records(config: Config, raw: RawRecords) -> Iterator[dict[str, object]]:
    """A row a labelled record, in the columns of ``machine.recordings``. Raises DataError."""
    recordings, listed, runout = config.machine.recordings, list_records(raw.folder), raw.fit_slow_roll()
    for row in listed:
        speed, vectors = raw.fit_record(row.file)
        rpm = speed / RAD_S_PER_RPM
        if abs(rpm - row.rpm) > 0.01 * row.rpm:
            raise DataError(
                f"'{raw.folder / row.file}' must turn at the {row.rpm:g} rpm of index.csv (to 1 %), but its keyphasor "
                f"says {rpm:.1f} rpm: copy both again"
            )
        read = SourceUnits(recordings).vectors((vectors - runout)[None], np.array([speed]))[0]
        about = dict(zip(("speed_id", "mount", recordings.columns.record), row.rest, strict=True))
        yield {
            recordings.columns.condition: row.condition,
            "config": row.config,
            **about,
            **split_parts(recordings.weights, row.weights),
            recordings.columns.speed: round(rpm, 3),
            **split_parts(recordings.probes.values(), read),
        }


def tabulate_run_up(config: Config, raw: RawRecords) -> dict[str, np.ndarray]:
    """A row a revolution of the ramp, in the columns and the voltage of ``machine.run_up``. Raises DataError."""
    asked = config.machine.run_up
    speeds, vectors = raw.fit_run_up(asked.from_rpm * RAD_S_PER_RPM, asked.to_rpm * RAD_S_PER_RPM)
    seen = vectors[:, list(raw.recordings.probes).index(asked.probe)] / to_motion(asked.unit, asked.scale)[1]
    values = (speeds / RAD_S_PER_RPM, np.abs(seen), np.degrees(np.angle(seen)))
    return dict(zip((asked.columns.speed, asked.columns.amplitude, asked.columns.phase), values, strict=True))


def write_tables(config: Config, folder: Path) -> list[Path]:
    """``records.csv`` and ``run_up_1x.csv``. Raises DataError."""
    raw, out = RawRecords(folder, list(config.machine.recordings.probes)), Path(config.output)
    records = list(tabulate_records(config, raw))
    written = [
        write_table(out / "records.csv", records),
        write_table(out / "run_up_1x.csv", tabulate_run_up(config, raw)),
    ]
    say(f"{len(records)} records of '{folder}' are in '{written[0]}', its run-up in '{written[1]}'")
    return written


def main(arguments: Sequence[str]) -> int:
    """Write the tables and run the stages on them; the exit code is that of the pipeline's own commands."""
    if not arguments or "=" in arguments[0]:
        came = " ".join(arguments) or "nothing"
        usage = "python studies/real_rig/raw_records.py FOLDER output=OUT"
        return say_and_return(f"the first word must be the folder of the raw records, but got {came}: {usage}", MISTAKE)
    overrides, tables = ["experiment=rk4", *arguments[1:]], []
    code = exit_code(lambda: tables.extend(write_tables(compose_stages(overrides)[0], Path(arguments[0]))))
    if code:
        return code
    if not any(each.startswith("stage=") for each in overrides):
        overrides.append(STAGES)
    files = zip(("machine.recordings.file", "machine.run_up.file"), map(str, tables), strict=True)
    return run_pipeline([*overrides, *(shlex.split(quote_override(key, path))[0] for key, path in files)])


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
