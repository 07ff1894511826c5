"""An identified model, logged so that MLflow can load and serve it without this project being installed."""

from __future__ import annotations

import importlib.metadata
import tempfile
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from mlflow import MlflowClient
    from mlflow.entities import LoggedModel, Run
    from mlflow.models import ModelSignature

MODEL_NAME = "model"
_PACKAGE_FOLDER = Path(__file__).resolve().parents[1]
_PREDICTOR = Path(__file__).with_name("predictor.py")
_REQUIREMENTS = ("mlflow", "numpy", "pandas", "pydantic", "safetensors", "torch")
_EXAMPLE_RPM = 1500.0


def log_model(client: MlflowClient, run: Run, folder: Path, parameters: Mapping[str, str]) -> str:
    """Log ``folder`` (``model.safetensors``, ``model.json``) as a model of ``run``; returns the model's id.

    The model is code (:mod:`pipeline.tracking.predictor` and this package) with data beside it, no pickle.

    :raises Exception: what MLflow or reading the model raises; the logged model is then marked as failed
    """
    from mlflow.entities import LoggedModelOutput, LoggedModelStatus

    weights, description = folder / "model.safetensors", folder / "model.json"
    signature = _signature(folder)
    logged = client.create_logged_model(
        run.info.experiment_id, name=MODEL_NAME, source_run_id=run.info.run_id, params=dict(parameters)
    )
    try:
        with tempfile.TemporaryDirectory() as scratch:
            _save(Path(scratch, MODEL_NAME), logged, signature, weights, description)
            client.log_model_artifacts(logged.model_id, str(Path(scratch, MODEL_NAME)))
        client.log_outputs(run.info.run_id, [LoggedModelOutput(logged.model_id, step=0)])
    except BaseException:
        client.finalize_logged_model(logged.model_id, LoggedModelStatus.FAILED)
        raise
    client.finalize_logged_model(logged.model_id, LoggedModelStatus.READY)
    return logged.model_id


def _save(path: Path, logged: LoggedModel, signature: ModelSignature, weights: Path, description: Path) -> None:
    import pandas as pd
    from mlflow import pyfunc
    from mlflow.models import Model

    from pipeline.tracking.table import SPEED

    # mlflow.pyfunc.log_model would do the same through the process-wide tracking URI and the active run, and
    # would load the model once more to try the example on it.
    with _without_requirement_check():
        pyfunc.save_model(
            path=path,
            mlflow_model=Model(
                artifact_path=logged.artifact_location,
                model_uuid=logged.model_id,
                model_id=logged.model_id,
                run_id=logged.source_run_id,
            ),
            python_model=str(_PREDICTOR),
            artifacts={"weights": str(weights), "description": str(description)},
            code_paths=[str(_PACKAGE_FOLDER)],
            signature=signature,
            input_example=pd.DataFrame({SPEED: [_EXAMPLE_RPM]}),
            pip_requirements=_pinned_requirements(),
        )


def _signature(folder: Path) -> ModelSignature:
    """One speed in; a bearing node, that speed and the coefficients this model identifies out."""
    from mlflow.models import ModelSignature
    from mlflow.types import ColSpec, Schema

    from pipeline.identification.storage import identified_names
    from pipeline.tracking.table import NODE, SPEED

    columns = [NODE, SPEED, *identified_names(folder)]
    return ModelSignature(
        inputs=Schema([ColSpec("double", SPEED)]),
        outputs=Schema([ColSpec("long" if name == NODE else "double", name) for name in columns]),
    )


def _pinned_requirements() -> list[str]:
    """The predictor's packages at the versions here, less a build's own mark such as ``+cpu``."""
    return [f"{name}=={importlib.metadata.version(name).partition('+')[0]}" for name in _REQUIREMENTS]


@contextmanager
def _without_requirement_check() -> Iterator[None]:
    """MLflow compares requirements with what is installed, for which it lists every file of every package.

    That takes 0.7 s where the files are cached; and these requirements were read from what is installed.
    """
    from mlflow.utils import environment

    check = "warn_dependency_requirement_mismatches"
    original = getattr(environment, check, None)
    if original is None:
        yield
        return
    setattr(environment, check, lambda requirements: None)
    try:
        yield
    finally:
        setattr(environment, check, original)
