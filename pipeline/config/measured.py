"""The schema of measured data in any format: conventions, probes, runs, runout, tacho.

No convention has a default: a file that does not say how its numbers are meant spoils more than noise does. The
equations behind the words are in :mod:`pipeline.ingest.conventions`. Values are SI, speeds in rpm.
"""

from __future__ import annotations

from abc import abstractmethod
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, ClassVar, Literal

from pydantic import BeforeValidator, Field, PositiveFloat, create_model

from pipeline.config.messages import suggest
from pipeline.config.motion import MotionConfig, Sensitivity, find_volts, to_motion
from pipeline.config.operating import Conditions, Differences
from pipeline.config.quantities import (
    Deviation,
    ShaftAngle,
    WeightMagnitude,
    define_coefficients,
)
from pipeline.config.runs import ForceConfig, ProbeConfig, SpeedsConfig, UnbalanceConfig
from pipeline.config.section import Section, Text, rule

if TYPE_CHECKING:
    from pipeline.ingest.exciter import FrequencyResponse
    from pipeline.ingest.order_tracking import Signals
    from pipeline.ingest.records import Records
    from pipeline.ingest.tracks import RunTracks

AmplitudeKind = Literal["zero_to_peak", "peak_to_peak", "rms"]
PhaseSense = Literal["lag", "lead"]
SpeedUnit = Literal["rpm", "Hz", "rad/s"]


AS_MODELLED = "bearings"
"""In place of a file of known coefficients: those of the machine's ``bearings``."""


class KnownConfig(
    create_model(  # type: ignore[misc]  # a key for each of the eight coefficients
        "_Known", __base__=Section, **define_coefficients(None)
    )
):
    """Known coefficients of every bearing that do not change with the speed, such as ``{cxy: 0 N s/m}``."""


def _parse_known(value: Any) -> Any:
    """A mapping has its own errors; what is neither that nor a text is told as such."""
    if isinstance(value, Mapping):
        return KnownConfig.model_validate(dict(value))
    if value is not None and not isinstance(value, (str, KnownConfig)):
        raise ValueError(f"must be a file, '{AS_MODELLED}', or values such as {{cxy: 0 N s/m}}, but got {value!r}")
    return value


Known = Annotated[Text | KnownConfig | None, BeforeValidator(_parse_known)]
"""The coefficients that are not identified: a file, the machine's ``bearings``, or values."""


class VectorConventionsConfig(MotionConfig):
    """The meaning of complex numbers over the speed: unit and kind of size, sense of the angle, unit of the speed."""

    amplitude: AmplitudeKind
    phase: PhaseSense
    speed: SpeedUnit


class ConventionsConfig(VectorConventionsConfig):
    """The meaning of amplitudes, phases and speeds in a table."""

    phase_unit: Literal["deg", "rad"]


class MeasuredProbeConfig(ProbeConfig):
    """A probe: its node of the rotor, and its angle from x towards y, which is the sense of rotation.

    ``scale`` is its sensitivity, where numbers are voltages. ``mounted`` is what moves the probe of a velocity or an
    acceleration: the shaft (a shaft rider, a laser), or the casing beside a bearing. ``measures`` is what it shows at a
    bearing that has a support, whose casing moves.
    """

    angle: ShaftAngle
    scale: Sensitivity | None = None
    mounted: Literal["shaft", "casing"] | None = None


class MeasuredUnbalanceConfig(UnbalanceConfig):
    """An unbalance (kg m) that was on the shaft in a run; ``phase`` as ``shaft_angle`` says."""

    magnitude: WeightMagnitude
    phase: ShaftAngle


class MeasuredForceConfig(ForceConfig):
    """A rotating force F e^{jp} [1, -j] (forward) or [1, +j] (backward) on x and y, time zero at the tacho pulse."""

    phase: ShaftAngle
    whirl: Literal["forward", "backward"]


class MeasuredRunConfig(Section):
    """One run: where its data are (``sheet`` of an Excel workbook), and what excited it; nothing only in the baseline.

    ``operating`` are its operating conditions. A run may come several times, each time at others.
    """

    name: Text
    file: Text | None = None
    sheet: Text | None = None
    operating: Conditions = Field(default_factory=dict)
    unbalances: tuple[MeasuredUnbalanceConfig, ...] = ()
    forces: tuple[MeasuredForceConfig, ...] = ()

    def sources(self, file: str | None) -> tuple[str, ...]:
        """The files of this run; ``file`` is that of the runs that name none. Raises ValueError where there is none."""
        if not (self.file or file):
            raise ValueError(f"run '{self.name}' must have a file, but it has none (and there is no file for all)")
        return (self.file or file or "",)


def _check_repeated(runs: Sequence[MeasuredRunConfig]) -> Iterator[str]:
    """What is wrong with runs of one name that differ in more than their operating conditions, or not in these."""
    states = [tuple(sorted(run.operating.items())) for run in runs]
    if len(set(states)) < len(states):
        yield (
            f"must give every run a name of its own, or operating conditions of its own, but '{runs[0].name}' is there "
            f"{len(runs)} times"
        )
    if any((run.unbalances, run.forces) != (runs[0].unbalances, runs[0].forces) for run in runs):
        yield f"must have the same excitation in runs of one name, but those of '{runs[0].name}' differ"


class SlowRollVectorConfig(Section):
    """The runout that one probe sees."""

    amplitude: Deviation
    phase: ShaftAngle


class SlowRollConfig(Section):
    """Runout to subtract: the mean 1X vector of each probe and run below a speed, or a given vector a probe."""

    below_rpm: PositiveFloat | None = None
    vectors: dict[str, SlowRollVectorConfig] = Field(default_factory=dict)
    amplitude: AmplitudeKind | None = None
    phase: PhaseSense | None = None

    @rule
    def _one_way(self) -> Iterator[str]:
        if (not self.below_rpm) == (not self.vectors):
            got = "both" if self.vectors else "neither"
            yield f"must give either below_rpm or vectors, but got {got}"
        if self.vectors and not (self.amplitude and self.phase):
            yield (
                "must give amplitude (zero_to_peak, peak_to_peak or rms) and phase (lag or lead) where it has vectors, "
                "but one is missing"
            )


class TachoAngleConfig(Section):
    """The angle of the tacho probe from x towards y; null where no unbalance is measured from its mark."""

    angle: ShaftAngle | None = None


class AnyRecordingsConfig(Section):
    """What every format of recordings answers, and where there is nothing to read.

    Beside what stands below that is whether there is something to read (``recorded``), the stage that makes an
    experiment's own data (``made_by``), the ``file`` of the runs that name none and the ``speeds`` that run-ups are
    interpolated to.
    """

    if TYPE_CHECKING:  # each format has its own

        @property
        def format(self) -> str:
            """The name of the format."""

        @property
        def shaft_angle(self) -> Literal["with_rotation", "against_rotation", "from_x"] | None:
            """How angles of weights are measured."""

        @property
        def tacho(self) -> TachoAngleConfig:
            """Its angle, and its pulses."""

        @property
        def probes(self) -> Mapping[str, MeasuredProbeConfig]:
            """By name."""

        @property
        def runs(self) -> Sequence[MeasuredRunConfig]:
            """Each with what excited it; one may come several times, at other operating conditions."""

    by_frequency: ClassVar[bool] = False
    """Whether a run is a response to a force at many frequencies."""

    @property
    def vectors(self) -> VectorConventionsConfig:
        """The meaning of the vectors of records; um zero-to-peak, phase lead for recordings of runs."""
        return VectorConventionsConfig(length="um", amplitude="zero_to_peak", phase="lead", speed="rpm")

    @property
    def planes(self) -> tuple[int, ...]:
        """The nodes of the planes whose weights each record states; none for recordings of runs."""
        return ()

    def angle_from_x(self, angle: float) -> float:
        """rad from x at the pulse of an unbalance whose ``angle`` (rad) is measured as ``shaft_angle`` says."""
        if self.shaft_angle in (None, "from_x") or self.tacho.angle is None:
            return angle
        return self.tacho.angle + angle if self.shaft_angle == "with_rotation" else self.tacho.angle - angle

    def read_signals(self, run: MeasuredRunConfig) -> list[Signals]:
        """The time signals of a run, a value a file, in m; none where there are vectors alone. Raises DataError."""
        return []

    def read_responses(self) -> tuple[FrequencyResponse, ...]:
        """The averages of each run, of recordings that are :attr:`by_frequency`. Raises DataError."""
        # Callers ask for :attr:`by_frequency` first.
        raise NotImplementedError(f"recordings of format {self.format} have no measured force")

    def read_records(self, file: str | None = None) -> Records:
        """The records of a table that states :attr:`planes`, or of another ``file`` like it. Raises DataError."""
        raise NotImplementedError(f"recordings of format {self.format} state no planes")  # callers ask for these first


class NoRecordingsConfig(AnyRecordingsConfig):
    """Nothing to read: the data are simulated, or the two files of training are there already."""

    format: Literal["none"]

    recorded: ClassVar[Literal[False]] = False
    made_by: ClassVar[Literal["generate"]] = "generate"
    file: ClassVar[None] = None
    stated_speeds: ClassVar[None] = None
    shaft_angle: ClassVar[None] = None
    tacho: ClassVar[TachoAngleConfig] = TachoAngleConfig()
    probes: ClassVar[Mapping[str, MeasuredProbeConfig]] = {}
    runs: ClassVar[tuple[MeasuredRunConfig, ...]] = ()


class OrderTrackingConfig(Section):
    """The fit of 1X vectors to time signals; see :mod:`pipeline.ingest.order_tracking`.

    ``most_lag`` is the share of its speed by which a swept peak may lag before there is a warning.
    """

    orders: Annotated[int, Field(ge=1, le=10)] = 3
    degree: Annotated[int, Field(ge=0, le=8)] | None = None
    revolutions: Annotated[float, Field(ge=2)] | None = None
    most_lag: Annotated[float, Field(gt=0, lt=0.5)] = 0.01

    def shortest(self, fewest: float = 8.0) -> float:
        """Revolutions of the shortest window."""
        return self.revolutions or fewest


class MeasuredConfig(AnyRecordingsConfig):
    """All formats share these keys; each adds ``probes`` and ``runs``. Runs that name no file are in ``file``.

    ``known`` gives the coefficients that are not identified: a table, ``bearings`` (those of the machine), or
    values that hold for every bearing and speed. Where all eight are identified, there is none. ``conditions_file`` is
    a table of operating conditions by run, and speed or time; those that differ by no more than ``same_conditions``
    are one.
    ``synthetic`` says that the recordings were modelled with the machine's bearings: answers are judged by them.
    """

    file: Text | None = None
    baseline: Text | None = None
    shaft_angle: Literal["with_rotation", "against_rotation", "from_x"] | None = None
    speeds: SpeedsConfig | None = None
    interpolation: Literal["cubic", "linear"] = "cubic"
    slow_roll: SlowRollConfig | None = None
    known: Known = None
    conditions_file: Text | None = None
    same_conditions: Differences = Field(default_factory=dict)
    synthetic: bool = False

    recorded: ClassVar[Literal[True]] = True
    made_by: ClassVar[Literal["ingest"]] = "ingest"

    @property
    def stated_speeds(self) -> SpeedsConfig | None:
        """The speeds that the recordings themselves state."""
        return self.speeds

    def state_frequency(self, run: Any) -> dict[str, float | None]:
        """Keys of a simulated run with the frequency of a recorded one, where that is not the rotor's."""
        return {key: getattr(run, key, None) for key in ("frequency_hz", "frequency_ratio")}

    @property
    def most_lag(self) -> float:
        """The share of its speed by which the swept peak of a time signal may lag."""
        return 0.0

    @abstractmethod
    def describe(self) -> str:
        """What the numbers in the files are taken for."""

    def read(self) -> tuple[RunTracks, ...]:
        """The 1X vectors of all runs. Raises DataError."""
        return tuple(self.read_run(run, Path(run.sources(self.file)[0])) for run in self.runs)

    def read_run(self, run: Any, path: Path) -> RunTracks:
        """The 1X vectors of a run, which is of the format's own class, in its only file. Raises DataError."""
        raise NotImplementedError(f"recordings of format {self.format} are records")  # callers ask for planes first

    def check_units(self, unit: str) -> Iterator[str]:
        """What is wrong with probes that do not fit numbers in ``unit``."""
        voltage = find_volts(unit) is not None
        for name, probe in self.probes.items():
            if voltage and not probe.scale:
                yield (
                    f"probe '{name}' must have a scale (such as 7.87 V/mm or 100 mV/g) for a signal in {unit}, but it "
                    "has none"
                )
            if not voltage and probe.scale:
                yield f"probe '{name}' must have no scale where signals are in {unit}, but it has {probe.scale}"
            order, _ = to_motion(unit, probe.scale)
            if order and not probe.mounted:
                yield (
                    f"probe '{name}' must say what it moves with where it measures "
                    f"{'velocities' if order == 1 else 'accelerations'}, but it has no 'mounted': give mounted: casing "
                    "(beside a bearing) or mounted: shaft (a shaft rider, a laser)"
                )
            if order and probe.measures == "shaft relative to casing":
                yield (
                    f"probe '{name}' must measure displacements where it measures the shaft relative to casing, but "
                    f"{'velocities' if order == 1 else 'accelerations'} are absolute: give measures: casing (with "
                    "mounted: casing) or measures: shaft (with mounted: shaft)"
                )
            elif probe.measures == "casing" and probe.mounted == "shaft":
                yield (
                    f"probe '{name}' must move with the casing where it measures the casing, but has mounted: shaft: "
                    "give mounted: casing, or measures: shaft"
                )
            if not order and probe.mounted == "casing":
                yield (
                    f"probe '{name}' must measure velocities or accelerations where it has mounted: casing, but its "
                    "displacements are the shaft's: leave mounted out"
                )

    def check_angles(self, angles: str, step: str) -> Iterator[str]:
        """What is wrong with the place that ``angles`` of weights are measured from; ``step`` is what to do about the
        tacho."""
        if not self.shaft_angle:
            yield (
                f"must say in shaft_angle how {angles} are measured (with_rotation or against_rotation from the mark, "
                "or from_x at the pulse), but it is missing"
            )
        if self.shaft_angle != "from_x" and self.tacho.angle is None:
            yield f"must give tacho.angle where {angles} are measured from the mark, but it is missing: {step}"

    @rule
    def _fits_together(self) -> Iterator[str]:
        if self.planes:  # each row of a table of records says what acted
            return
        names = [run.name for run in self.runs]
        for run in self.runs:
            yield from _check_repeated([other for other in self.runs if other.name == run.name])
        if self.baseline and self.baseline not in names:
            yield f"must have the baseline among its runs, but it is '{self.baseline}'{suggest(self.baseline, names)}"
        for run in self.runs:
            run.sources(self.file)
            excited = bool(run.unbalances or run.forces)
            if excited and run.name == self.baseline:
                yield f"must have nothing that excites the baseline run '{run.name}', but it has some"
            if not excited and run.name != self.baseline:
                yield (
                    f"run '{run.name}' must have unbalances or forces, but it has none: add them, or name it "
                    "as baseline"
                )
        if any(run.unbalances for run in self.runs):
            yield from self.check_angles(
                "phases of unbalances", "give it, or the phases from x with shaft_angle=from_x"
            )
        vectors = set(self.slow_roll.vectors if self.slow_roll else ())
        if vectors and vectors != set(self.probes):
            yield (
                f"slow_roll.vectors must have one vector a probe ({', '.join(self.probes)}), but it has "
                f"{', '.join(vectors)}"
            )
