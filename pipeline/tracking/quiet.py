"""MLflow without log lines, telemetry and long waits."""

from __future__ import annotations

import logging
import math
import os
import warnings
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager

_LOGGERS = ("mlflow", "alembic", "sqlalchemy.engine", "urllib3.connectionpool")
_NEVER = logging.CRITICAL + 1


@contextmanager
def quiet_mlflow(timeout_seconds: float) -> Iterator[None]:
    """MLflow is imported, silent, and gives up on a server after ``timeout_seconds`` (s) while this lasts.

    Environment, log levels and warning filters are the process's own: one such block at a time, and nothing
    but logging in it. Telemetry stays off afterwards.

    :raises ImportError: if MLflow is not installed
    """
    from unittest.mock import patch  # it imports asyncio

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
    # MLflow uses deprecated parts of SQLAlchemy, which a user can't change. A warning that is raised as an error while
    # SQLAlchemy sets up its classes would leave them broken for the whole process.
    with patch.dict(os.environ, environment), warnings.catch_warnings(), ExitStack() as put_back:
        warnings.simplefilter("ignore")
        import mlflow  # noqa: F401  # for its effect: it sets the levels of these loggers when it is imported

        for logger in map(logging.getLogger, _LOGGERS):
            put_back.callback(logger.setLevel, logger.level)
            logger.setLevel(_NEVER)
        yield
