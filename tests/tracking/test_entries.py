"""Names, numbers and provenance: what is made of a record before MLflow gets it."""

from __future__ import annotations

import shutil
import subprocess
from pathlib import Path

import numpy as np
import pytest
from running import ROOT

from pipeline.tracking.entries import (
    NAME_LENGTH,
    PARAMETER_LENGTH,
    TAG_LENGTH,
    clean_name,
    collect_history,
    describe_provenance,
    flatten_parameters,
    without_password,
)

pytestmark = pytest.mark.slow  # it trains, or starts processes


def test_parameters_read_like_overrides() -> None:
    parameters = {
        "a": {"b": {"c": 1.5, "d": True}, "empty": {}},
        "path": Path("x/y"),
        "array": np.array([1, 2]),
        "uri": "postgresql://anna:secret@host/db",
        "odd key!": (1, None),
    }
    assert flatten_parameters(parameters) == {
        "a.b.c": "1.5",
        "a.b.d": "true",
        "a.empty": "{}",
        "path": "x/y",
        "array": "[1, 2]",
        "uri": "postgresql://anna:***@host/db",
        "odd key_": "[1, null]",
    }
    assert flatten_parameters({}) == {}


@pytest.mark.parametrize(
    ("name", "expected"),
    [
        ("kxx/mean [%]", "kxx/mean ___"),
        ("/root", "root"),
        ("a//b/../c", "a/b/c"),
        ("", "_"),
        ("ω", "ω"),
        ("n" * 300, "n" * 250),
    ],
)
def test_names(name: str, expected: str, quiet: None) -> None:
    from mlflow.utils.validation import _validate_metric_name

    assert clean_name(name) == expected
    _validate_metric_name(expected)


def test_limits_are_those_of_mlflow(quiet: None) -> None:
    from mlflow.utils import validation

    assert (NAME_LENGTH, PARAMETER_LENGTH) == (validation.MAX_ENTITY_KEY_LENGTH, validation.MAX_PARAM_VAL_LENGTH)
    assert TAG_LENGTH == validation.MAX_TAG_VAL_LENGTH


def test_history_row_without_step_is_an_error() -> None:
    with pytest.raises(KeyError):
        collect_history([{"loss": 1.0}], 1_700_000_000.0, 1_700_000_060.0)


def test_passwords_are_masked() -> None:
    assert without_password("at http://a:b@h:1 and x://c:d@e") == "at http://a:***@h:1 and x://c:***@e"
    assert without_password("http://host:5000/a@b") == "http://host:5000/a@b"


@pytest.mark.skipif(shutil.which("git") is None, reason="needs git")
def test_provenance_of_a_repository(tmp_path: Path) -> None:
    def git(*arguments: str) -> None:
        identity = ["-c", "user.name=n", "-c", "user.email=e", "-c", "commit.gpgsign=false"]
        subprocess.run(["git", *identity, "-C", str(tmp_path), *arguments], check=True, capture_output=True)

    git("init", "-q")
    assert "git.revision" not in describe_provenance(tmp_path), "no commit yet"
    git("commit", "-q", "--allow-empty", "-m", "first")
    tags = describe_provenance(tmp_path)
    assert (len(tags["git.revision"]), tags["git.dirty"]) == (40, "false")
    (tmp_path / "new.py").touch()
    assert describe_provenance(tmp_path)["git.dirty"] == "true"


def test_provenance_without_git(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    assert not [name for name in describe_provenance(tmp_path / "gone") if name.startswith("git.")]
    monkeypatch.setenv("PATH", str(tmp_path))
    assert not [name for name in describe_provenance(ROOT) if name.startswith("git.")]
