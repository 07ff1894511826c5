"""What a stage hands to the tracker and what it was made with, and the flat names and texts that MLflow accepts of it;
MLflow is not needed.
"""

from __future__ import annotations

import getpass
import importlib.metadata
import json
import math
import os
import platform
import re
import subprocess
from collections.abc import Iterator, Mapping, Sequence
from contextlib import suppress
from dataclasses import KW_ONLY, dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Any

from pipeline.errors import without_password

if TYPE_CHECKING:
    import pandas as pd

NAME_LENGTH = 250
PARAMETER_LENGTH = 6000
TAG_LENGTH = 8000
RUNNING = "RUNNING"
"""The status of a stage that goes on; its last record has another one."""


@dataclass(frozen=True)
class StageRecord:
    """What a stage hands on: its work, complete and saved; or a piece of it that is a run of its own, such as a trial.

    A stage returns what it made; what it is and when it ran is added when it is recorded.

    :param metrics: final values by name, nested or dotted; numbers are recorded, those that are not finite are not
    :param tags: such as the data's fingerprint, the seed, the outcome, ``pipeline.group``
    :param files: images go to the artifact folder ``figures``, other files to ``files``
    :param history: rows by training step: a key ``step`` and metrics, which need not be the same in each row;
        texts among them are left out, for MLflow's metrics are numbers
    :param model: a folder that holds ``model.safetensors`` and ``model.json``, logged as a loadable model
    :param example: a table of the model's inputs, and its answer to them
    :param children: logged as runs below this one: parameters, tags, metrics and history of each
    :param exit_code: of the command
    :param experiment: the name of the MLflow experiment, such as ``hydrostatic_stiffness``
    :param stage: such as ``train``
    :param title: the run's name, such as ``train ball_bearing model.width=8``; without one the ``stage``
    :param data: where the vibration lies that the tag ``data_fingerprint`` is of; none where no file has it
    :param started: start and
    :param ended: end of the stage as ``time.time()`` gives them (s)
    :param parameters: the composed configuration, nested; logged flat, and whole as ``config.yaml``
    :param status: ``FINISHED``, ``KILLED`` or ``FAILED``; ``RUNNING`` with children alone, before the stage ends
    """

    metrics: Mapping[str, Any] = field(default_factory=dict)
    tags: Mapping[str, str] = field(default_factory=dict)
    files: Sequence[Path] = ()
    _: KW_ONLY
    history: Sequence[Mapping[str, float | str]] = ()
    model: Path | None = None
    example: tuple[pd.DataFrame, ...] = ()
    children: Sequence[StageRecord] = ()
    exit_code: int = 0
    experiment: str = ""
    stage: str = ""
    title: str = ""
    data: Path | None = None
    started: float = 0.0
    ended: float = 0.0
    parameters: Mapping[str, object] = field(default_factory=dict)
    status: str = "FINISHED"


MetricValue = tuple[str, float, int, int]
"""Name, finite value, time (ms since 1970) and step: what :class:`mlflow.entities.Metric` takes, in its order."""


def clean_name(text: str) -> str:
    """``text`` as a name MLflow accepts: other characters become ``_``, at most 250 are kept."""
    # "/" makes folders of names, which must not be empty, "." or "..", nor start at the root.
    parts = [word for word in re.sub(r"[^\w .:/-]", "_", text).split("/") if word not in ("", ".", "..")]
    return "/".join(parts)[:NAME_LENGTH] or "_"


def shorten(text: str, length: int) -> str:
    """``text``, cut to ``length`` characters with an ellipsis where it is longer."""
    return text if len(text) <= length else text[: length - 3] + "..."


def simplify(value: object) -> Any:
    """``value`` as what JSON and YAML know: dict, list, str, int, float, bool and None."""
    from pydantic_core import to_jsonable_python

    return to_jsonable_python(value, fallback=lambda other: other.tolist() if hasattr(other, "tolist") else str(other))


def flatten(values: Mapping[str, Any], prefix: str = "") -> Iterator[tuple[str, Any]]:
    """What a nested mapping holds, by dotted name; an empty mapping in it is a value."""
    for key, value in values.items():
        if isinstance(value, Mapping) and value:
            yield from flatten(value, f"{prefix}{key}.")
        else:
            yield f"{prefix}{key}", value


def flatten_parameters(parameters: Mapping[str, object]) -> dict[str, str]:
    """``parameters`` by dotted name, as texts that can be pasted back as overrides (``null``, ``[1, 2]``).

    Passwords are masked.
    """
    return {
        clean_name(name): shorten(
            without_password(value if isinstance(value, str) else json.dumps(value)), PARAMETER_LENGTH
        )
        for name, value in flatten(simplify(parameters))
    }


def flatten_tags(tags: Mapping[str, object]) -> dict[str, str]:
    """``tags`` with names and lengths that MLflow accepts."""
    return {clean_name(name): shorten(without_password(str(text)), TAG_LENGTH) for name, text in tags.items()}


def collect_values(
    metrics: Mapping[str, float | None], time: float, step: int = 0
) -> tuple[list[MetricValue], list[str]]:
    """The finite metrics at ``time`` (s since 1970); and the names of those that are not finite."""
    finite = {name: float(value) for name, value in metrics.items() if value is not None and math.isfinite(value)}
    values = [(clean_name(name), value, round(1000 * time), step) for name, value in finite.items()]
    return values, [name for name in metrics if name not in finite]


def collect_history(
    history: Sequence[Mapping[str, float | str]], started: float, ended: float
) -> tuple[list[MetricValue], list[str]]:
    """The finite numbers of all rows; and the names of which some value is not finite.

    A row has no time of its own: the rows are spread evenly over the stage (``started`` to ``ended``, s).

    :raises KeyError: if a row has no ``step``
    """
    collected = [
        collect_values(
            {name: value for name, value in row.items() if name != "step" and not isinstance(value, str)},
            started + (ended - started) * number / len(history),
            int(row["step"]),
        )
        for number, row in enumerate(history, start=1)
    ]
    skipped = dict.fromkeys(name for _, names in collected for name in names)
    return [value for values, _ in collected for value in values], list(skipped)


# --- what it was made with ---------------------------------------------------------------------------


def describe_provenance(code_folder: Path = Path(__file__).parent) -> dict[str, str]:
    """Tags of the code in ``code_folder``, the interpreter and the packages; what is not known has no tag."""
    tags = {
        "version.python": platform.python_version(),
        "mlflow.source.name": "pipeline",
        "mlflow.source.type": "LOCAL",
    }
    for package in ("torch", "ross-rotordynamics", "mlflow", "numpy", "scipy", "hydra-core"):
        with suppress(importlib.metadata.PackageNotFoundError):
            tags[f"version.{package}"] = importlib.metadata.version(package)
    with suppress(OSError, KeyError, ImportError):
        tags["mlflow.user"] = getpass.getuser()
    with suppress(OSError, subprocess.SubprocessError, UnicodeDecodeError):
        tags["git.revision"] = tags["mlflow.source.git.commit"] = _run_git(code_folder, "rev-parse", "--verify", "HEAD")
        tags["git.dirty"] = "true" if _run_git(code_folder, "status", "--porcelain") else "false"
    return tags


def _run_git(folder: Path, *arguments: str, timeout_seconds: float = 5.0) -> str:
    """What git prints. Raises where there is no git, no repository, no commit or no answer in time."""
    return subprocess.run(
        ["git", "-C", str(folder), *arguments],
        capture_output=True,
        text=True,
        timeout=timeout_seconds,
        # Without optional locks "git status" never gets in the way of a person's or another stage's git.
        env=os.environ | {"GIT_OPTIONAL_LOCKS": "0"},
        stdin=subprocess.DEVNULL,
        check=True,
    ).stdout.strip()
