"""Names of an experiment's files, the identity of what they are made from, and the nodes that they speak of."""

from __future__ import annotations

import hashlib
import json
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from pipeline.config.schema import Config
from pipeline.errors import DataError
from pipeline.files import hash_file


def _file(name: str, meaning: str) -> Any:
    return property(lambda workspace: workspace.folder / name, doc=meaning)


@dataclass(frozen=True)
class Workspace:
    """Names of an experiment's files; vibration and excitation are given in ``data`` or its own."""

    folder: Path
    vibration: Path
    excitation: Path
    known: Path
    own: bool  # vibration and excitation are the experiment's own
    config = _file("config.yaml", "The composed configuration.")
    modelled = _file("modelled_coefficients.csv", "The truth of modelled data; training never reads it.")
    identified = _file("identified_coefficients.csv", "The answer of training.")
    history = _file("history.csv", "Loss over the steps of training.")
    training = _file("training.json", "Outcome, loss and quality of the fit.")
    metrics = _file("metrics.json", "Errors, written by evaluate.")

    @property
    def model(self) -> tuple[Path, ...]:
        """What was trained: numbers, architecture and covariance."""
        return tuple(self.folder / name for name in ("model.safetensors", "model.json", "uncertainty.safetensors"))

    def figure(self, name: str) -> Path:
        """A figure's path."""
        return self.folder / "figures" / f"{name}.png"


def locate_files(config: Config) -> Workspace:
    """Return the places of the experiment's files, which may not be there yet."""
    folder, data = Path(config.output), config.data
    return Workspace(
        folder,
        Path(data.vibration or folder / "vibration.parquet"),
        Path(data.excitation or folder / "excitation.csv"),
        folder / "known_coefficients.csv",
        own=not (data.vibration or data.excitation),
    )


def require_own(work: Workspace, stage: str) -> None:
    """Raise DataError where ``data`` names files: a stage must not write over what a user made."""
    if not work.own:
        raise DataError(
            f"{stage} must write the experiment's own files, but data.vibration or data.excitation names others: leave "
            "them out"
        )


def hash_machine(config: Config) -> str:
    """Return the identity of what data are generated from: the machine without its recordings."""
    kept = {"rotor", "bearings", "probes", "speeds", "runs", "residual_unbalance", "as_built"}
    if config.machine.operating:  # without any, it is the machine that it was before there were some
        kept.add("operating")
    parts = config.machine.model_dump(mode="json", include=kept)
    return hashlib.sha256(json.dumps(parts, sort_keys=True).encode()).hexdigest()[:16]


def hash_origin(config: Config, work: Workspace) -> str:
    """:func:`hash_machine` and the identity of the files generated beside the vibration, which is written last.

    Files of two generations, as an interrupted ``generate`` leaves them, do not fit each other.
    """
    return f"{hash_machine(config)} {hash_file(work.excitation)} {hash_file(work.known)}"
