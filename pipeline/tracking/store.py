"""The way to a tracking store: its client and the experiment in it."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

from pipeline.timeout import run_within
from pipeline.tracking.database import DatabaseProblem, artifact_root, prepare_database, sqlite_uri
from pipeline.tracking.entries import name_of
from pipeline.tracking.record import TrackingSettings

if TYPE_CHECKING:
    from mlflow import MlflowClient

_SQLITE = "sqlite:///"


def open_experiment(settings: TrackingSettings, name: str) -> tuple[MlflowClient, str]:
    """A client of the store and the id of the experiment ``name`` in it, both made where they are missing.

    :raises DatabaseProblem: if an SQLite file can't be used
    :raises TimeoutError: if a server or another database gives no answer within the settings' time
    :raises mlflow.exceptions.MlflowException: if the store refuses
    """
    # MLflow takes an empty URI for a database in the working directory.
    if settings.uri.startswith("sqlite:") or not settings.uri:
        path = _database_path(settings.uri)
        prepare_database(path, settings.timeout_seconds)
        location = f"{artifact_root(path)}/{name_of(name).replace('/', '_')}"
        return _open(sqlite_uri(path), name, location)
    # Neither the look-up of a host's name nor MLflow's retries for a database heed a time limit of their own.
    return run_within(settings.timeout_seconds, lambda: _open(settings.uri, name, None))


def _database_path(uri: str) -> Path:
    database = uri.removeprefix(_SQLITE)
    if not uri.startswith(_SQLITE) or database in ("", ":memory:") or "?" in database:
        raise DatabaseProblem(
            f"'{uri}' names no SQLite file; write sqlite:///FILE (relative) or sqlite:////FOLDER/FILE"
        )
    return Path(database).absolute()


def _open(uri: str, name: str, artifact_location: str | None) -> tuple[MlflowClient, str]:
    from mlflow import MlflowClient
    from mlflow.exceptions import MlflowException

    client = MlflowClient(tracking_uri=uri, registry_uri=uri)
    experiment = client.get_experiment_by_name(name)
    if experiment is None:
        try:
            return client, client.create_experiment(name, artifact_location)
        except MlflowException:
            # Another process may have made it between the two calls.
            experiment = client.get_experiment_by_name(name)
            if experiment is None:
                raise
    if experiment.lifecycle_stage != "active":
        raise MlflowException(
            f"the experiment '{name}' was deleted there; "
            f"'mlflow experiments restore -x {experiment.experiment_id}' brings it back"
        )
    return client, experiment.experiment_id
