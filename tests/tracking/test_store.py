"""The store: a database made once or not at all, and surroundings that are put back."""

from __future__ import annotations

import logging
import os
from pathlib import Path

import pytest

from pipeline.errors import StorageError
from pipeline.tracking.store import prepare_database, quiet_mlflow


@pytest.mark.slow
def test_surroundings_are_put_back(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("MLFLOW_HTTP_REQUEST_TIMEOUT", "77")
    monkeypatch.delenv("MLFLOW_HTTP_REQUEST_MAX_RETRIES", raising=False)
    with quiet_mlflow(4.0):
        level = logging.getLogger("mlflow").level
        assert os.environ["MLFLOW_HTTP_REQUEST_TIMEOUT"] == "2"
    assert os.environ["MLFLOW_HTTP_REQUEST_TIMEOUT"] == "77"
    assert "MLFLOW_HTTP_REQUEST_MAX_RETRIES" not in os.environ
    assert logging.getLogger("mlflow").level < level
    assert os.environ["MLFLOW_DISABLE_TELEMETRY"] == "true"


@pytest.mark.slow
def test_failed_creation_leaves_no_database(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, quiet: None) -> None:
    from mlflow.store.tracking import sqlalchemy_store

    def half_made(uri: str, root: str) -> None:
        Path(uri.removeprefix("sqlite:///")).write_text("half")
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(sqlalchemy_store, "SqlAlchemyStore", half_made)
    with pytest.raises(StorageError, match="No space left on device"):
        prepare_database(tmp_path / "mlflow.db", 1.0)
    assert [path.name for path in tmp_path.iterdir()] == ["mlflow.db-lock"]
