"""What all stages share: their files' names, missing inputs, records."""

from __future__ import annotations

import hashlib
import json
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path

from pipeline.config.schema import Config
from pipeline.data.tables import fingerprint_of
from pipeline.reporting.console import say, warn
from pipeline.tracking import ChildRecord, StageRecord, TrackingSettings, track


@dataclass(frozen=True)
class Workspace:
    """Names of an experiment's files."""

    folder: Path

    @property
    def config(self) -> Path:
        """The composed configuration."""
        return self.folder / "config.yaml"

    @property
    def modelled(self) -> Path:
        """The truth of modelled data; training never reads it."""
        return self.folder / "modelled_coefficients.csv"

    @property
    def identified(self) -> Path:
        """The answer of training."""
        return self.folder / "identified_coefficients.csv"

    @property
    def history(self) -> Path:
        """Loss over the steps of training."""
        return self.folder / "history.csv"

    @property
    def training(self) -> Path:
        """Outcome, loss and time of training."""
        return self.folder / "training.json"

    @property
    def metrics(self) -> Path:
        """Errors, written by evaluate."""
        return self.folder / "metrics.json"

    def figure(self, name: str) -> Path:
        """A figure's path."""
        return self.folder / "figures" / f"{name}.png"


@dataclass(frozen=True)
class InputFiles:
    """The files that training reads, given in ``data`` or the experiment's own."""

    vibration: Path
    excitation: Path
    known: Path
    own: bool  # all three are the experiment's own


def workspace(config: Config) -> Workspace:
    """The experiment's folder."""
    return Workspace(Path(config.output))


def input_files(config: Config) -> InputFiles:
    """Where training finds its data."""
    folder, data = Path(config.output), config.data
    vibration = Path(data.vibration) if data.vibration else folder / "vibration.parquet"
    excitation = Path(data.excitation) if data.excitation else folder / "excitation.csv"
    known = Path(data.known) if data.known else folder / "known_coefficients.csv"
    return InputFiles(vibration, excitation, known, not (data.vibration or data.excitation or data.known))


def origin(config: Config) -> str:
    """Identity of what data are generated from: the machine, but what was recorded of it."""
    kept = {"rotor", "bearings", "probes", "speeds", "runs", "residual_unbalance"}
    parts = config.machine.model_dump(mode="json", include=kept)
    return hashlib.sha256(json.dumps(parts, sort_keys=True).encode()).hexdigest()[:16]


def origin_of_files(config: Config, files: InputFiles) -> str:
    """:func:`origin` and the identity of the files generated beside the vibration, which is written last.

    Files of two generations, as an interrupted ``generate`` leaves them, do not fit each other.
    """
    return f"{origin(config)} {fingerprint_of(files.excitation)} {fingerprint_of(files.known)}"


def make_missing(config: Config, stage: str, *needed: Path) -> None:
    """Run ``stage`` first if one of the files that it makes is missing, and say so."""
    from pipeline.stages import run_stage

    missing = [path for path in needed if not path.exists()]
    if missing:
        say(f"'{missing[0]}' is missing: running stage={stage} first")
        run_stage(config.model_copy(update={"stage": stage}))


def use_threads(config: Config) -> None:
    """Let torch use the configured number of threads."""
    import torch

    torch.set_num_threads(config.threads)


@dataclass(frozen=True)
class StageOutput:
    """What a stage hands to the records."""

    metrics: Mapping[str, float] = field(default_factory=dict)
    tags: Mapping[str, str] = field(default_factory=dict)
    files: Sequence[Path] = ()
    history: Sequence[Mapping[str, float]] = ()
    model: Path | None = None
    children: Sequence[ChildRecord] = ()
    exit_code: int = 0


def execute(config: Config, run: Callable[[Config], StageOutput]) -> None:
    """Run a stage and record it. The files are complete before the first word to MLflow."""
    started = time.time()
    output = run(config)
    # The comparison's many settings are of its own stage alone.
    parameters = config.model_dump(mode="json", exclude=None if config.stage == "compare" else {"comparison"})
    record = StageRecord(
        experiment=config.name if config.stage != "check" else "check",  # it looks at all of them
        stage=config.stage,
        started=started,
        ended=time.time(),
        parameters=parameters,
        tags={"pipeline.group": _group(parameters), "seed": str(config.seed)} | dict(output.tags),
        metrics=output.metrics,
        history=output.history,
        files=[path for path in output.files if path.exists()],
        model=output.model,
        children=output.children,
        status="KILLED" if output.exit_code == 130 else "FINISHED",
    )
    settings = TrackingSettings(config.tracking.enabled, config.tracking.uri, config.tracking.timeout_seconds)
    for sentence in track(record, settings):
        warn(sentence)
    if output.exit_code:
        raise SystemExit(output.exit_code)


def _group(parameters: Mapping[str, object]) -> str:
    """Stages of one experiment with the same configuration share this tag."""
    shared = {
        key: value for key, value in parameters.items() if key not in ("stage", "tracking", "check", "comparison")
    }
    return hashlib.sha256(json.dumps(shared, sort_keys=True).encode()).hexdigest()[:12]


def flat_metrics(values: Mapping[str, object], prefix: str = "") -> dict[str, float]:
    """Numbers of a nested mapping by dotted names."""
    result: dict[str, float] = {}
    for key, value in values.items():
        name = f"{prefix}{key}"
        if isinstance(value, Mapping):
            result |= flat_metrics(value, f"{name}.")
        elif isinstance(value, (int, float)) and not isinstance(value, bool):
            result[name] = float(value)
    return result
