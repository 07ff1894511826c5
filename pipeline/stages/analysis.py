"""What a command asks about an experiment: where its files are, what its stages have made of it, each thing once, and
how a stage is run and recorded.

Files have an identity: what they were made from.
"""

from __future__ import annotations

import importlib
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field, replace
from functools import wraps
from pathlib import Path
from typing import Any, TypeVar

from pipeline.config.schema import Config
from pipeline.data.coefficient_files import write_coefficients
from pipeline.data.dataset import VibrationDataset
from pipeline.data.excitation_files import write_excitation
from pipeline.data.vibration_files import write_vibration
from pipeline.errors import ConfigError, DataError
from pipeline.files import hash_file, hash_json
from pipeline.problem.configured import list_known
from pipeline.processes import settle_torch
from pipeline.reporting.console import say, warn
from pipeline.rotor.bearing_table import BearingTable
from pipeline.tracking import StageRecord, track
from pipeline.tracking.entries import flatten

_T = TypeVar("_T")


# --- an experiment, and its files ---------------------------------------------------------------------


def _file(name: str, meaning: str) -> Any:
    return property(lambda analysis: analysis.folder / name, doc=meaning)


@dataclass(frozen=True, eq=False)
class Analysis:
    """A configuration, its files, which may not be there yet, and what :func:`made_once` keeps: measurement, diagnosis,
    answer, twin, judgement. Vibration and excitation are given in ``data`` or its own."""

    config: Config
    made: dict[str, tuple[Any, Any]] = field(default_factory=dict)

    known = _file("known_coefficients.csv", "What it takes as known.")
    configuration = _file("config.yaml", "The composed configuration.")
    modelled = _file("modelled_coefficients.csv", "The truth of modelled data; training never reads it.")
    identified = _file("identified_coefficients.csv", "The answer of training.")
    history = _file("history.csv", "Loss over the steps of training.")
    training = _file("training.json", "Outcome, loss and quality of the fit.")
    metrics = _file("metrics.json", "Errors, written by evaluate.")

    @property
    def folder(self) -> Path:
        """Where its files lie."""
        return Path(self.config.output)

    @property
    def vibration(self) -> Path:
        """The readings."""
        return Path(self.config.data.vibration or self.folder / "vibration.parquet")

    @property
    def excitation(self) -> Path:
        """What excited the runs."""
        return Path(self.config.data.excitation or self.folder / "excitation.csv")

    @property
    def own(self) -> bool:
        """Whether vibration and excitation are the experiment's own."""
        return not (self.config.data.vibration or self.config.data.excitation)

    @property
    def model(self) -> tuple[Path, ...]:
        """What was trained: numbers, architecture and covariance."""
        return tuple(self.folder / name for name in ("model.safetensors", "model.json", "uncertainty.safetensors"))

    def figure(self, name: str) -> Path:
        """A figure's path."""
        return self.folder / "figures" / f"{name}.png"

    def at(self, config: Config) -> Analysis:
        """That of another stage; what was made is kept where nothing else of the configuration differs."""
        alike = config.model_copy(update={"stage": self.config.stage}) == self.config
        return replace(self, config=config) if alike else Analysis(config)

    def run(self, stage: str) -> None:
        """Run another stage of the same experiment, and record it."""
        execute(self.at(self.config.model_copy(update={"stage": stage})))

    def require(self, stage: str, *needed: Path, behind: Path | None = None) -> None:
        """Run ``stage`` first if one of the files that it makes is missing, or older than the file ``behind`` it, and
        say so."""
        since = behind.stat().st_mtime if behind and behind.exists() else 0.0
        stale = [path for path in needed if not path.exists() or path.stat().st_mtime < since]
        if stale:
            also = f", or older than '{behind}'" if behind else ""
            say(f"'{stale[0]}' is missing{also}: running stage={stage} first")
            self.run(stage)


def require_own(analysis: Analysis, stage: str) -> None:
    """Raise DataError where ``data`` names files: a stage must not write over what a user made."""
    if not analysis.own:
        raise DataError(
            f"{stage} must write the experiment's own files, but data.vibration or data.excitation names others: leave "
            "them out"
        )


def hash_machine(config: Config) -> str:
    """Return the identity of what data are generated from: the machine without its recordings."""
    kept = {"rotor", "bearings", "probes", "speeds", "runs", "residual_unbalance", "as_built"}
    # Without conditions and supports, it is the machine that it was before there were some.
    if config.machine.operating:
        kept.add("operating")
    parts = config.machine.model_dump(mode="json", include=kept)
    parts["rotor"] = {key: value for key, value in parts["rotor"].items() if key != "supports" or value}
    return hash_json(parts)


def hash_origin(analysis: Analysis) -> str:
    """:func:`hash_machine` and the identity of the files generated beside the vibration, which is written last.

    Files of two generations, as an interrupted ``generate`` leaves them, do not fit each other.
    """
    return f"{hash_machine(analysis.config)} {hash_file(analysis.excitation)} {hash_file(analysis.known)}"


def write_data(
    analysis: Analysis,
    data: VibrationDataset,
    known: BearingTable | None,
    modelled: BearingTable | None,
    generated_for: str | None = None,
) -> list[Path]:
    """Write the experiment's own data; the vibration comes last, and is the last of the files.

    Coefficients of data that were there before go. ``generated_for`` is the fingerprint of the rotor that generated
    data are of.
    """
    written = [write_excitation(analysis.excitation, data)]
    given = list_known(analysis.config, known.nodes) if known else None
    for path, table, names in ((analysis.known, known, given), (analysis.modelled, modelled, None)):
        if table is None:
            path.unlink(missing_ok=True)
        else:
            written.append(write_coefficients(path, table, names))
    marks = {"rotor": generated_for, "origin": hash_origin(analysis)} if generated_for else None
    return [*written, write_vibration(analysis.vibration, data, marks)]


# --- what its stages make of it ----------------------------------------------------------------------


def made_once(*sources: str) -> Callable[[Callable[[Analysis], _T]], Callable[[Analysis], _T]]:
    """What the function makes is kept by the analysis until one of the ``sources`` is written again: names of files of
    :class:`Analysis`."""

    def decorate(make: Callable[[Analysis], _T]) -> Callable[[Analysis], _T]:
        """``make``, whose answer is kept."""

        @wraps(make)
        def look_up(analysis: Analysis) -> _T:
            paths = [getattr(analysis, name) for name in sources]
            marks, value = analysis.made.get(make.__name__, (None, None))
            if marks != list(map(_mark, paths)):
                value = make(analysis)  # which may write the sources first
                analysis.made[make.__name__] = list(map(_mark, paths)), value
            return value

        return look_up

    return decorate


def _mark(path: Path) -> tuple[int, int, int]:
    """Tells a file from the one that was there before; zeros where there is none."""
    if not path.exists():
        return 0, 0, 0
    about = path.stat()
    return about.st_ino, about.st_size, about.st_mtime_ns


# --- its stages ---------------------------------------------------------------------------------------


@contextmanager
def say_interrupt(what: str, piece: str = "trial") -> Iterator[None]:
    """Ctrl-C in the block ends the command with 130, and a sentence says that ``what`` goes on where it was, with every
    ``piece`` that is done."""
    try:
        yield
    except KeyboardInterrupt:
        warn(f"{what} interrupted; no finished {piece} is lost, and the same command goes on")
        raise SystemExit(130) from None


def use_threads(config: Config) -> None:
    """Let torch use the configured number of threads. Raises ConfigError for a device that it does not see."""
    settle_torch(config.threads)
    import torch

    if config.training.device == "cuda" and not torch.cuda.is_available():
        raise ConfigError(
            f"training.device=cuda must have a GPU that torch sees, but torch {torch.__version__} sees none: install "
            "its CUDA build by `make env TORCH=cuda` on a machine with a GPU, or leave it out"
        )


def execute(analysis: Analysis) -> None:
    """Run a stage and record it; of ``predict`` with records of the user's own, those alone."""
    config = analysis.config
    given_records = config.stage == "predict" and config.predict.records is not None
    name = "given_records" if given_records else config.stage
    record(analysis, importlib.import_module(f"pipeline.stages.{name}").run)


def record(analysis: Analysis, run: Callable[[Analysis], StageRecord]) -> None:
    """Run and record what a stage, or a study, does. The files are complete before the first word to MLflow."""
    config, started = analysis.config, time.time()
    output = run(analysis)
    # The comparison's many settings are of its own stage alone.
    parameters = config.model_dump(mode="json", exclude=None if config.stage == "compare" else {"comparison"})
    # Stages of one experiment with the same configuration share this tag.
    apart = ("stage", "tracking", "check", "comparison", "report", "balance", "predict")
    shared = {key: parameters[key] for key in parameters if key not in apart}
    group = hash_json(shared, 12)
    made = replace(
        output,
        experiment=config.name if config.stage != "check" else "check",  # it looks at all of them
        stage=config.stage,
        title=" ".join((config.stage, config.name, *config.overrides)),
        data=None if config.stage == "compare" else analysis.vibration,  # which makes data of its own
        started=started,
        ended=time.time(),
        parameters=parameters,
        tags={"pipeline.group": group, "seed": str(config.seed)} | dict(output.tags),
        metrics={
            name: float(value)
            for name, value in flatten(output.metrics)
            if isinstance(value, int | float) and not isinstance(value, bool)
        },
        files=[path for path in output.files if path.exists()],
        status="KILLED" if output.exit_code == 130 else "FINISHED",
    )
    for sentence in track(made, config.tracking):
        warn(sentence)
    if output.exit_code:
        raise SystemExit(output.exit_code)
