"""What a run was made with: the revision of the code and the versions of the packages."""

from __future__ import annotations

import getpass
import importlib.metadata
import os
import platform
import subprocess
from contextlib import suppress
from pathlib import Path

_PACKAGES = ("torch", "ross-rotordynamics", "mlflow", "numpy", "scipy", "hydra-core")
_GIT_SECONDS = 5.0
_CODE_FOLDER = Path(__file__).resolve().parents[1]


def describe_provenance(code_folder: Path = _CODE_FOLDER) -> dict[str, str]:
    """Tags of the code in ``code_folder``, the interpreter and the packages; what is not known has no tag."""
    tags = {
        "version.python": platform.python_version(),
        "mlflow.source.name": "pipeline",
        "mlflow.source.type": "LOCAL",
    }
    for package in _PACKAGES:
        with suppress(importlib.metadata.PackageNotFoundError):
            tags[f"version.{package}"] = importlib.metadata.version(package)
    with suppress(OSError, KeyError, ImportError):
        tags["mlflow.user"] = getpass.getuser()
    return tags | _describe_revision(code_folder)


def _describe_revision(folder: Path) -> dict[str, str]:
    revision = _run_git(folder, "rev-parse", "--verify", "HEAD")
    if not revision:
        return {}
    tags = {"git.revision": revision, "mlflow.source.git.commit": revision}
    changes = _run_git(folder, "status", "--porcelain")
    if changes is not None:
        tags["git.dirty"] = "true" if changes else "false"
    return tags


def _run_git(folder: Path, *arguments: str) -> str | None:
    """What git prints, or None where there is no git, no repository, no commit or no answer in time."""
    # Without optional locks "git status" never gets in the way of a person's or another stage's git.
    environment = os.environ | {"GIT_OPTIONAL_LOCKS": "0"}
    try:
        done = subprocess.run(
            ["git", "-C", str(folder), *arguments],
            capture_output=True,
            text=True,
            timeout=_GIT_SECONDS,
            env=environment,
            stdin=subprocess.DEVNULL,
            check=False,
        )
    except (OSError, subprocess.SubprocessError, UnicodeDecodeError):
        return None
    return done.stdout.strip() if done.returncode == 0 else None
