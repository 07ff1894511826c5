"""What report and summary speak of: one value, of an experiment's answer, twin and files. Nothing is fitted here.

Legend: S speeds, P channels, R runs, B bearings, W probes.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np

from pipeline.coefficients import COEFFICIENTS
from pipeline.config.schema import Config
from pipeline.data.dataset import VibrationDataset, name_direction
from pipeline.data.operating import find_nearest, name_state
from pipeline.data.tables import read_table
from pipeline.data.vibration_files import to_rpm
from pipeline.errors import DataError
from pipeline.files import hash_file
from pipeline.identification.identified import Answer
from pipeline.identification.readings import read_answer
from pipeline.ingest.conventions import SourceUnits
from pipeline.ingest.full_spectrum import FullSpectra
from pipeline.problem.measurement import Measurement
from pipeline.reporting.blocks import Mark
from pipeline.reporting.coefficient_figures import Coefficients
from pipeline.reporting.measured_figures import Trace, choose_looks, list_traces
from pipeline.rotor.bearing_table import BearingTable
from pipeline.rotor.stored import place_probes
from pipeline.twin.at_conditions import pick_middle, say_beyond
from pipeline.twin.twin import Twin

MOST_PROBES, MOST_RUNS = 8, 6
"""So many are drawn; a sentence says that there are more."""


@dataclass(frozen=True, eq=False)
class View:
    """A direction in which a node was seen."""

    name: str
    node: int
    angle: float  # degrees, from x towards y
    weights: np.ndarray  # (P,)

    def read(self, vectors: np.ndarray) -> np.ndarray:
        """(S, R) what is seen of the ``vectors`` (S, P, R) of all channels."""
        return np.asarray(vectors.transpose(0, 2, 1) @ self.weights)

    def read_noise(self, noise: np.ndarray) -> np.ndarray:
        """(S, R) root mean square of the noise of what is seen, from that of all channels (S, P, R)."""
        return np.asarray(np.sqrt(noise.transpose(0, 2, 1) ** 2 @ self.weights**2))


@dataclass(frozen=True, eq=False)
class FitContent:
    """What was identified, and how it follows the readings."""

    answer: Answer
    twin: Twin | None  # None where the prediction can't be made
    modelled: BearingTable | None  # the truth, where there is one
    training: Mapping[str, Any]  # training.json

    @cached_property
    def coefficients(self) -> Coefficients:
        """At the points of the data."""
        return Coefficients(self.answer.stated, self.modelled, self.answer.names)

    @cached_property
    def at_conditions(self) -> Coefficients:
        """Those of the twin: at the conditions of the prediction, at each speed once; without it the data's
        that are nearest."""
        if self.twin is None:
            data = self.answer.measurement.dataset
            return self.coefficients.at(find_nearest(data.speeds, data.operating, self.operating)[1])
        return Coefficients(self.answer.state(self.twin.systems["identified"]), None, self.answer.names)

    @cached_property
    def predicted(self) -> np.ndarray:
        """(S, P, R) complex, m, with the bearings of each run where they drift."""
        return read_answer(self.answer.measurement, self.answer.table, self.answer.unbalance)

    @cached_property
    def noise(self) -> np.ndarray:
        """(S, P, R) m, root mean square of each reading's noise."""
        measurement, factors = self.answer.measurement, self.training.get("fit", {}).get("noise_factor") or {}
        stated = len(factors) == len(measurement.dataset.channels)
        factor = np.array(list(factors.values())) if stated else 1.0
        return measurement.deviation_of(measurement.dataset.displacement, measurement.baseline, factor)

    @property
    def operating(self) -> Mapping[str, float]:
        """The conditions of the prediction, or those in the middle of the data, SI."""
        return self.twin.operating if self.twin else pick_middle(self.answer.measurement.dataset.operating)

    @property
    def state(self) -> str:
        """The conditions of the prediction, such as `` at 70 degC``; no words without any."""
        return f" at {name_state(self.operating)}" if self.operating else ""

    @property
    def beyond(self) -> list[str]:
        """Which of these lie outside the data, in words."""
        return say_beyond(self.answer.measurement.dataset.operating, self.operating)


@dataclass(frozen=True, eq=False, kw_only=True)
class ReportContent:
    """Everything that the sections read. ``files`` holds the JSON files of the experiment by name, where they are, and
    ``missing`` why what is not there could not be made."""

    config: Config
    measurement: Measurement
    fit: FitContent | None  # None where the data determine nothing
    files: Mapping[str, Mapping[str, Any]]
    spectra: Mapping[str, FullSpectra] = field(default_factory=dict)  # beyond 1X, of time signals, by run and node
    reference: Mapping[str, np.ndarray] = field(default_factory=dict)  # coefficients to compare with, at their speeds
    origin: Mapping[str, str] = field(default_factory=dict)  # versions, hashes, command
    missing: Mapping[str, str] = field(default_factory=dict)

    @property
    def machine_verdict(self) -> Mapping[str, Any]:
        """That of the whole machine, or why there is none."""
        none = dict.fromkeys(("reservation", "identified", "next"), "") | {
            "verdict": "none",
            "reason": self.missing.get("verdicts", "stage=verdict makes it"),
        }
        return self.files["verdicts"]["machine"] if "verdicts" in self.files else none

    @property
    def dataset(self) -> VibrationDataset:
        """The readings."""
        return self.measurement.dataset

    @cached_property
    def rpm(self) -> np.ndarray:
        """(S,)."""
        return to_rpm(self.dataset.speeds)

    @cached_property
    def probes(self) -> tuple[View, ...]:
        """Every probe: those that recorded, or the channels of the data where these are all that is known."""
        data, recordings = self.dataset, self.config.machine.recordings
        seen = [(name_channel(channel), *channel) for channel in data.channels]
        if recordings.probes and self.config.data.vibration is None:
            placed = place_probes(self.measurement.rotor, recordings).probes
            seen = [(name, probe.node, float(np.degrees(probe.angle))) for name, probe in placed.items()]
        return tuple(View(name, node, angle, data.shares(node, angle)) for name, node, angle in seen)

    @cached_property
    def shown_probes(self) -> tuple[View, ...]:
        """Those that are drawn: at bearings first, then at discs, then others."""
        ranks = dict.fromkeys(self.measurement.rotor.disc_nodes, 1)
        ranks |= dict.fromkeys(self.measurement.rotor.bearing_nodes, 0)
        return tuple(sorted(self.probes, key=lambda probe: (ranks.get(probe.node, 2), probe.node))[:MOST_PROBES])

    @cached_property
    def shown_runs(self) -> tuple[int, ...]:
        """Indices of the runs that are drawn: those that were held out last, so that none is lost."""
        held = [r for r, name in enumerate(self.dataset.runs) if name in self.config.training.holdout_runs]
        rest = [r for r in range(len(self.dataset.runs)) if r not in held]
        return tuple(sorted([*rest[: max(MOST_RUNS - len(held), 0)], *held]))

    @property
    def weighs_noise(self) -> bool:
        """Whether the loss of the fit does."""
        return self.fit is not None and "fit" in self.fit.training

    def held_out(self, run: int) -> bool:
        """Whether the run was predicted rather than fitted."""
        return self.weighs_noise and self.dataset.runs[run] in self.config.training.holdout_runs

    @cached_property
    def example(self) -> tuple[int, np.ndarray, np.ndarray]:
        """The first run that was not fitted, else the first of all: its index, and (S, P) m as it was measured and as
        the twin has it, zeros where it was not measured."""
        data, held_out = self.dataset, self.config.training.holdout_runs if self.weighs_noise else ()
        r = data.runs.index(held_out[0]) if held_out else 0
        assert self.fit is not None
        return r, data.displacement[..., r], np.where(data.present[:, [r]], self.fit.predicted[..., r], 0.0)

    @cached_property
    def looks(self) -> dict[int, dict[str, Any]]:
        """Colour and dash of each run that is drawn, the same in every figure."""
        return dict(
            zip(self.shown_runs, choose_looks([self.dataset.runs[run] for run in self.shown_runs]), strict=True)
        )

    def traces(self, *runs: int) -> list[Trace]:
        """The points of each state that the ``runs`` (all that are drawn, without any) were measured at, with looks."""
        return list_traces(self.dataset, {run: self.looks[run] for run in runs or self.shown_runs})

    @property
    def source(self) -> SourceUnits:
        """The conventions of the machine's recordings."""
        return SourceUnits(self.config.machine.recordings)

    @property
    def counted(self) -> str:
        """From where these have the angles of weights, in words."""
        recordings = self.config.machine.recordings
        mark = "" if recordings.tacho.angle is None else recordings.shaft_angle
        return {
            "with_rotation": "from the tacho mark, with the rotation",
            "against_rotation": "from the tacho mark, against the rotation",
        }.get(mark or "", "from x towards y, at the tacho pulse")

    def baseline(self) -> np.ndarray | None:
        """(S, P) complex, m: the run of the machine as it was found, which was taken off the others."""
        taken = self.dataset.subtracted
        return None if taken is None or not taken.any() else taken[..., int(np.abs(taken).sum(axis=(0, 1)).argmax())]


def list_reservations(content: ReportContent) -> list[Mark]:
    """The warning that stands beside all that follows from a rejected model."""
    reservation = content.machine_verdict["reservation"]
    return [Mark("warning", reservation)] if reservation else []


def name_channel(channel: tuple[int, float]) -> str:
    """Name a channel, such as ``node 3, x`` or ``node 3, 45°``."""
    direction = name_direction(channel[1])
    return f"node {channel[0]}, {direction if direction in 'xy' else f'{direction}°'}"


def read_reference(path: Path) -> dict[str, np.ndarray]:
    """A table of coefficients at speeds of its own. Raises DataError where it has no coefficient."""
    columns = read_table(
        path, dict.fromkeys(("bearing_node", "speed_rpm"), "number"), dict.fromkeys(COEFFICIENTS, "number or blank")
    )
    if not any(name in columns for name in COEFFICIENTS):
        raise DataError(
            f"'{path}' must have a column of a coefficient ({', '.join(COEFFICIENTS)}; N/m and N s/m), but it has "
            "none: name the columns so, or leave report.reference out"
        )
    return columns


def describe_origin(
    config: Config, measurement: Measurement, files: Sequence[Path], versions: Mapping[str, str]
) -> dict[str, str]:
    """The command, fingerprints of data, rotor and ``files``, and the ``versions`` of the program and its packages."""
    recordings, reference = config.machine.recordings, config.report.reference
    sources = dict.fromkeys(source for run in recordings.runs for source in run.sources(recordings.file))
    changed = " with changes" if versions.get("git.dirty") == "true" else ""
    origin = {
        "command": f"python -m pipeline stage=report {config.chosen}",
        "fingerprint of the data": measurement.dataset.fingerprint,
        "fingerprint of the rotor": measurement.rotor.fingerprint,
        **{path.name: f"sha256 {hash_file(path)}" for path in files if path.exists()},
        **{str(source): f"sha256 {hash_file(Path(source)) or 'not at hand'}" for source in sources},
        **({} if reference is None else {"reference": f"{reference}, sha256 {hash_file(Path(reference))}"}),
        **{name.removeprefix("version."): text for name, text in versions.items() if name.startswith("version.")},
    }
    revision = versions.get("git.revision")
    return origin | ({} if revision is None else {"revision of the program": revision[:12] + changed})
