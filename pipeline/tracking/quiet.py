"""MLflow without its chatter, its telemetry and its long waits."""

from __future__ import annotations

import logging
import math
import os
import warnings
from collections.abc import Iterator
from contextlib import contextmanager

_LOGGERS = ("mlflow", "alembic", "sqlalchemy.engine", "urllib3.connectionpool")
_NEVER = logging.CRITICAL + 1


@contextmanager
def quiet_mlflow(timeout_seconds: float) -> Iterator[None]:
    """MLflow is imported, silent, and gives up on a server after ``timeout_seconds`` (s) while this lasts.

    Environment, log levels and warning filters are the process's own: one such block at a time, and nothing
    but logging in it. Telemetry stays off afterwards.

    :raises ImportError: if MLflow is not installed
    """
    os.environ["MLFLOW_DISABLE_TELEMETRY"] = "true"
    os.environ["DO_NOT_TRACK"] = "1"
    environment = {
        # One retry, so each of the two attempts may take half of the time.
        "MLFLOW_HTTP_REQUEST_TIMEOUT": str(max(1, math.floor(timeout_seconds / 2))),
        "MLFLOW_HTTP_REQUEST_MAX_RETRIES": "1",
        "MLFLOW_SUPPRESS_PRINTING_URL_TO_STDOUT": "true",
        "MLFLOW_ENABLE_ARTIFACTS_PROGRESS_BAR": "false",
        "MLFLOW_UV_AUTO_DETECT": "false",
    }
    before = {name: os.environ.get(name) for name in environment}
    os.environ.update(environment)
    levels: dict[str, int] = {}
    try:
        # What MLflow uses of SQLAlchemy's deprecated side is nothing a user can mend; raised as an error
        # half-way through SQLAlchemy's set-up of its classes it would spoil them for the whole process.
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            import mlflow  # noqa: F401  # for its effect: it sets the levels of these loggers when it is imported

            for name in _LOGGERS:
                levels[name] = logging.getLogger(name).level
                logging.getLogger(name).setLevel(_NEVER)
            yield
    finally:
        for name, level in levels.items():
            logging.getLogger(name).setLevel(level)
        for name, value in before.items():
            if value is None:
                os.environ.pop(name, None)
            else:
                os.environ[name] = value
