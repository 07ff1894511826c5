"""The schema of a machine: everything that belongs to it, in one section. SI, speeds in rpm."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Mapping, Sequence
from typing import Any, Literal

from pydantic import Field, NonNegativeFloat, ValidationInfo, field_validator

from pipeline.config.balance import WeightsConfig
from pipeline.config.motion import find_floor
from pipeline.config.operating import Conditions, States
from pipeline.config.rotor import RotorConfig
from pipeline.config.runs import (
    CandidateConfig,
    ForceConfig,
    ProbeConfig,
    ProbesConfig,
    RunConfig,
    SpeedsConfig,
    UnbalanceConfig,
)
from pipeline.config.section import NonNegativeInt, Section, rule
from pipeline.ingest.dataset import RecordingsConfig
from pipeline.ingest.run_up import RunUpConfig
from pipeline.laws.law_set import LawsConfig
from pipeline.parameters.as_built import AsBuiltConfig
from pipeline.rotor.bearings import BearingConfig, RotorFileBearingConfig
from pipeline.units import RAD_S_PER_RPM


class PredictionConfig(RunConfig):
    """An unbalance, or a force, that training never saw, and where and when to look at its vibration.

    ``operating`` are the conditions of the prediction, measured or not (SI); of data with conditions the middle ones
    where it is not given.
    """

    name: Literal["prediction"] = "prediction"
    node: NonNegativeInt
    speed_rpm: NonNegativeFloat
    operating: Conditions = Field(default_factory=dict)

    @property
    def what(self) -> str:
        """An unbalance, or a force and its frequency."""
        return (
            f"a force at {self.frequency_hz:g} Hz"
            if self.frequency_hz
            else "an unbalance"
            if self.unbalances
            else "a force"
        )


_ANY_RUN = RunConfig(name="x", forces=(ForceConfig(node=0, magnitude=1.0),))


def _follow(key: str, source: str, derive: Callable[[Any], Any], stand_in: Any) -> Any:
    """A validator of a ``key`` that is left out: it follows from the ``source`` before it. Where that one is wrong, and
    that is told, a ``stand_in`` takes its place.
    """

    def fill(cls: type[Section], value: Any, info: ValidationInfo) -> Any:
        if value is not None:
            return value
        return derive(info.data[source]) if source in info.data else stand_in

    return field_validator(key, mode="before")(classmethod(fill))


def _save_bearings(rotor: RotorConfig) -> RotorFileBearingConfig:
    if not rotor.file:
        raise ValueError("must be given, but is missing")
    return RotorFileBearingConfig(kind="rotor_file")


def _record_speeds(recordings: RecordingsConfig) -> SpeedsConfig:
    if not recordings.stated_speeds:
        raise ValueError(
            "must be given (start_rpm, stop_rpm, step_rpm), but is missing: add it; where recordings keep their own "
            "speeds, it is for designs and predictions alone"
        )
    return recordings.stated_speeds


def _record_runs(recordings: RecordingsConfig) -> list[RunConfig]:
    """Each recorded run as it could be simulated: phases as angles from x."""
    if not recordings.recorded:
        raise ValueError("must be given (a list of runs, each with unbalances or forces), but is missing")
    excited = {run.name: run for run in recordings.runs if run.unbalances or run.forces}
    return [
        RunConfig(
            name=run.name,
            unbalances=tuple(
                UnbalanceConfig(
                    node=unbalance.node,
                    magnitude=unbalance.magnitude,
                    phase=recordings.angle_from_x(unbalance.phase),
                )
                for unbalance in run.unbalances
            ),
            forces=tuple(ForceConfig(**force.model_dump()) for force in run.forces),
            **recordings.state_frequency(run),
        )
        for run in excited.values()
    ]


def _weigh(runs: Sequence[RunConfig]) -> CandidateConfig:
    """Weights at the nodes of the ``runs``, as large as their largest; forces where no run has a weight."""
    weights = [weight for run in runs for weight in run.unbalances]
    forces = [] if weights else [force for run in runs for force in run.forces]
    return CandidateConfig(
        unbalance_nodes=tuple(sorted({weight.node for weight in weights})),
        unbalance=max((weight.magnitude for weight in weights), default=1.0),
        force_nodes=tuple(sorted({force.node for force in forces})),
        force=max((force.magnitude for force in forces), default=1.0),
        whirls=tuple(dict.fromkeys(force.whirl for force in forces)),
        phases_deg=(0.0, 90.0, 180.0, 270.0),
    )


def _turn(runs: Sequence[RunConfig], speed: float) -> list[UnbalanceConfig]:
    """The weights of the first of the ``runs`` that has some, a quarter turn further; where none has, what pulls like
    the forces of the first at the ``speed`` (rad/s)."""
    forces = [force.model_dump(include={"node", "phase"}) for force in runs[0].forces]
    pulls = [force.magnitude / speed**2 for force in runs[0].forces]
    alike = [UnbalanceConfig(**force, magnitude=pull) for force, pull in zip(forces, pulls, strict=True)]
    weights = next((run.unbalances for run in runs if run.unbalances), alike)
    return [weight.model_copy(update={"phase": weight.phase + math.pi / 2}) for weight in weights]


class TitleBlock(Section):
    """Who the report of a machine is for and by whom: what is blank is left out of it."""

    customer: str = ""
    machine: str = ""
    author: str = ""
    company: str = ""
    date: str = ""
    paper: Literal["A4", "Letter"] = "A4"


class MachineConfig(Section):
    """Rotor and bearings, how it is run and seen, what was recorded of it, and what can be done with it.

    ``file`` is the machine file of the user's own that the section was read from. A rotor of a file has the bearings
    that are saved with it, where none are given. ``speeds`` and ``runs`` are those of simulated data and of designs; of
    a machine with ``recordings`` that gives none, those that were recorded. Simulated data have all speeds and runs at
    every combination of the ``operating`` conditions; at the ``unmeasured`` ones an answer is held against the modelled
    coefficients. ``prediction`` is by default the weights of the first run a quarter turn further at the middle speed,
    and ``candidates`` are weights at the nodes of the runs; both are of forces where no run has a weight. A
    ``residual_unbalance`` acts in every run and is not written down: the machine has it and nobody knows. So it is with
    what ``as_built`` says: ``stage=generate`` alone knows of it, and what the truth is judged by.
    """

    file: str | None = None
    rotor: RotorConfig
    bearings: BearingConfig = Field(default=None, validate_default=True)
    recordings: RecordingsConfig
    speeds: SpeedsConfig = Field(default=None, validate_default=True)
    runs: tuple[RunConfig, ...] = Field(default=None, validate_default=True, min_length=1)
    operating: States = Field(default_factory=dict)
    unmeasured: States = Field(default_factory=dict)
    runs_file: str | None = None
    residual_unbalance: tuple[UnbalanceConfig, ...] = ()
    as_built: AsBuiltConfig | None = None
    probes: ProbesConfig
    run_up: RunUpConfig | None = None
    prediction: PredictionConfig = Field(default=None, validate_default=True)
    candidates: CandidateConfig = Field(default=None, validate_default=True)
    balance: WeightsConfig | None = None
    laws: LawsConfig | None = None
    report: TitleBlock = TitleBlock()

    _bearings = _follow("bearings", "rotor", _save_bearings, RotorFileBearingConfig(kind="rotor_file"))
    _speeds = _follow("speeds", "recordings", _record_speeds, SpeedsConfig(start_rpm=1, stop_rpm=1, step_rpm=1))
    _runs = _follow("runs", "recordings", _record_runs, [_ANY_RUN])
    _candidates = _follow("candidates", "runs", _weigh, _weigh([_ANY_RUN]))

    @property
    def listed_probes(self) -> tuple[ProbeConfig, ...]:
        """The probes that say where they are: those of recordings, or else simulated ones."""
        return tuple(self.recordings.probes.values()) or self.probes.listed

    @property
    def floors(self) -> tuple[str, ...]:
        """The floors of probes above zero, each once."""
        return tuple(dict.fromkeys(probe.floor for probe in self.listed_probes if any(find_floor(probe.floor))))

    @field_validator("prediction", mode="before")
    @classmethod
    def _unseen_unbalance(cls, value: Any, info: ValidationInfo) -> Any:
        alone = value is None or (isinstance(value, Mapping) and set(value) == {"operating"})
        if not alone or not {"speeds", "runs"} <= info.data.keys():
            return value or PredictionConfig(node=0, speed_rpm=1, unbalances=(UnbalanceConfig(node=0, magnitude=1.0),))
        rpm = info.data["speeds"].rpm()
        middle = rpm[len(rpm) // 2]
        first, turn = info.data["runs"][0], {"forward": math.pi / 2, "backward": 0.0}
        # Where nothing turns, both make a force along a line that stands 45 deg further.
        later = [force.model_copy(update={"phase": force.phase + turn[force.whirl]}) for force in first.forces]
        weights = _turn(info.data["runs"], middle * RAD_S_PER_RPM) if middle else []
        acting: dict[str, Any] = {"forces": later, "frequency_hz": first.frequency_hz}
        at = {"node": (*weights, *later)[0].node, "speed_rpm": middle} | ({"unbalances": weights} if middle else acting)
        return PredictionConfig.model_validate(at | dict(value or {}))

    @rule
    def _is_built_of_the_same_parts(self) -> Iterator[str]:
        built = self.as_built
        if not built:
            return
        if self.rotor.file and (built.refinement > 1 or built.beam):
            key = "refinement" if built.refinement > 1 else next(iter(built.beam))
            yield f"as_built.{key} must be left out for a rotor of a file, whose elements are its own"
        elements = sum(section.elements for section in self.rotor.shaft)
        if built.shaft and (count := sum(section.elements for section in built.shaft)) != elements:
            yield f"as_built.shaft must have the {elements} elements of the model's shaft, but got {count}"
        alone = "method=time" if built.method == "time" else "pedestal_stiffness" if built.pedestal_stiffness else ""
        if alone and any(run.frequency_hz or run.frequency_ratio for run in self.runs):
            yield f"as_built.{alone} needs runs that turn with the rotor, but one does not"

    @rule
    def _turns(self) -> Iterator[str]:
        turning = [run.name for run in self.runs if not run.frequency_hz]
        if turning and not self.speeds.start_rpm:
            yield (
                f"speeds.start_rpm must be above zero where a run turns with the rotor, but it is 0, and run "
                f"'{turning[0]}' has no frequency_hz: start at a higher speed, or give a force its frequency"
            )

    @rule
    def _names_and_nodes(self) -> Iterator[str]:
        names = [run.name for run in self.runs]
        if len(set(names)) != len(names):
            yield f"must give every run a name of its own, but got {names}"
        if self.rotor.n_casings and self.as_built:
            yield "as_built must be left out where rotor.supports says what bearings stand on, but both are given"
        if self.rotor.file:
            return
        if self.bearings.saved:
            yield "must give rotor.file where bearings.kind is rotor_file, but rotor.file is null"
        placed = self.bearings.places
        if placed and (without := [node for node in self.rotor.bearing_nodes if node not in placed]):
            yield (
                f"bearings.nodes must have a bearing for every bearing node of the rotor, but node {without[0]} has "
                f"none (it has {', '.join(map(str, placed))})"
            )
        for node in self.laws.bearings if self.laws else ():
            if node not in self.rotor.bearing_nodes:
                where = ", ".join(map(str, self.rotor.bearing_nodes))
                yield f"laws.bearings must have bearing nodes of the rotor ({where}), but has node {node}"
        last = self.rotor.n_nodes - 1  # with casings, which do not turn
        turning: dict[str, Sequence[Any]] = {
            **{f"run '{run.name}'": run.unbalances for run in self.runs},
            "residual_unbalance": self.residual_unbalance,
            "prediction.unbalances": self.prediction.unbalances,
            "balance.planes": self.balance.planes if self.balance else (),
        }
        still: dict[str, Sequence[Any]] = {
            **{f"run '{run.name}'": run.forces for run in self.runs},
            "prediction.node": [self.prediction],
            "prediction.forces": self.prediction.forces,
            "probes.at": self.probes.listed,
        }
        for used, highest in ((turning, last - self.rotor.n_casings), (still, last)):
            for what, node in ((what, placed.node) for what, every in used.items() for placed in every):
                if node > highest:
                    yield f"must use nodes 0 to {highest} of the rotor, but {what} got node {node}"
