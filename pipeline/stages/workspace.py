"""Names of an experiment's files, and the identity of what they are made from."""

from __future__ import annotations

import hashlib
import json
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from pipeline.config.schema import Config
from pipeline.files import hash_file


def _file(name: str, meaning: str) -> Any:
    return property(lambda workspace: workspace.folder / name, doc=meaning)


@dataclass(frozen=True)
class Workspace:
    """Names of an experiment's files."""

    folder: Path
    config = _file("config.yaml", "The composed configuration.")
    modelled = _file("modelled_coefficients.csv", "The truth of modelled data; training never reads it.")
    identified = _file("identified_coefficients.csv", "The answer of training.")
    history = _file("history.csv", "Loss over the steps of training.")
    training = _file("training.json", "Outcome, loss and quality of the fit.")
    metrics = _file("metrics.json", "Errors, written by evaluate.")

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
    return f"{origin(config)} {hash_file(files.excitation)} {hash_file(files.known)}"
