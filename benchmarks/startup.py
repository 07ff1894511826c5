"""How long a command takes from the shell, against ``python -c "import torch"``."""

from __future__ import annotations

import os
import subprocess
import sys
from collections.abc import Sequence
from functools import cache
from pathlib import Path
from tempfile import TemporaryDirectory

from benchmarks.measure import BENCHMARKS, Aim, Times, in_turns

_ROOT = Path(__file__).resolve().parents[1]
_TORCH = 'python -c "import torch"'
_TRAIN = ("stage=train", "experiment=ball_bearing")
_TURNS = 5


@BENCHMARKS.add("help", "python -m pipeline --help", _TORCH, Aim(1.5, "below"))
def help_text() -> Times:
    """Nothing heavy is imported for it."""
    with TemporaryDirectory() as folder:
        return _against_torch(Path(folder), ["--help"])


@BENCHMARKS.add("train", "stage=train experiment=ball_bearing tracking=none, data there", _TORCH, Aim(1.5))
def train() -> Times:
    """The whole command, the training included."""
    with TemporaryDirectory() as folder:
        given = [*_TRAIN, "tracking=none", f"output={folder}/made"]
        _pipeline(Path(folder), *given)
        return _against_torch(Path(folder), given)


@BENCHMARKS.add("train_rotor_file", "the same with a rotor from a ROSS file seen before", _TORCH, Aim(1.5))
def train_rotor_file() -> Times:
    """The assembled rotor is kept, so that ROSS is not imported again."""
    with TemporaryDirectory() as folder:
        rotor = _saved_rotor(Path(folder) / "rotor.toml")
        given = [
            *_TRAIN,
            "tracking=none",
            f"output={folder}/made",
            f"machine.rotor.file={rotor}",
            "machine.bearings.kind=rotor_file",
        ]
        given.append("machine.rotor.bearing_nodes=[]")
        _pipeline(Path(folder), *given)
        return _against_torch(Path(folder), given)


@BENCHMARKS.add("train_mlflow", "the same with MLflow, in a database that exists", _TORCH, Aim(2.5))
def train_mlflow() -> Times:
    """Everything is logged, the model too."""
    with TemporaryDirectory() as folder:
        given = [*_TRAIN, f"output={folder}/made", f"tracking.uri=sqlite:///{folder}/mlflow.db"]
        _pipeline(Path(folder), *given)
        return _against_torch(Path(folder), given)


@BENCHMARKS.add("mistake", "the refusal of a data file with a mistake", _TORCH, Aim(3, "below"))
def mistake() -> Times:
    """A text where a number should be, in the last row of the vibration."""
    import pandas as pd

    with TemporaryDirectory() as folder:
        made = Path(folder) / "made"
        _pipeline(Path(folder), "stage=generate", "experiment=ball_bearing", "tracking=none", f"output={made}")
        table = pd.read_parquet(made / "vibration.parquet").astype({"amplitude_m": object})
        table.loc[table.index[-1], "amplitude_m"] = "much"
        table.to_csv(made / "bad.csv", index=False)
        given = [*_TRAIN, "tracking=none", f"output={folder}/other", f"data.vibration={made}/bad.csv"]
        given += [f"data.excitation={made}/excitation.csv", f"data.known={made}/known_coefficients.csv"]
        return _against_torch(Path(folder), given, code=2)


def _saved_rotor(file: Path) -> Path:
    from benchmarks.machines import machine
    from benchmarks.ross_oracle import ross_rotor

    made = machine("experiment=ball_bearing")
    ross_rotor(made.config.machine.rotor, made.config.machine.bearings, made.speeds).save(file)
    return file


def _against_torch(folder: Path, arguments: Sequence[str], code: int = 0) -> Times:
    """The command in ``folder``, whose exit code must be ``code``; both sides warm."""
    _pipeline(folder, *arguments, code=code)
    _process(folder, ["-c", "import torch"])
    return in_turns(
        lambda: _pipeline(folder, *arguments, code=code), lambda: _process(folder, ["-c", "import torch"]), _TURNS
    )


def _pipeline(folder: Path, *arguments: str, code: int = 0) -> None:
    _process(folder, ["-m", "pipeline", *arguments], code)


def _process(folder: Path, words: Sequence[str], code: int = 0) -> None:
    done = subprocess.run([sys.executable, *words], cwd=folder, env=_environment(), capture_output=True, text=True)
    if done.returncode != code:
        raise RuntimeError(f"{' '.join(words)} must end with code {code}, but got {done.returncode}: {done.stderr}")


@cache
def _environment() -> dict[str, str]:
    """A user's: the pipeline chooses its own number of threads."""
    ours = {"OPENBLAS_NUM_THREADS", "OMP_NUM_THREADS"}
    return {key: value for key, value in os.environ.items() if key not in ours} | {"PYTHONPATH": str(_ROOT)}
