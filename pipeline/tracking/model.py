"""An identified model, logged so that MLflow can load and serve it without this project being installed."""

from __future__ import annotations

import importlib.metadata
import tempfile
from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Protocol

import numpy as np

from pipeline.coefficients import COEFFICIENTS
from pipeline.units import RAD_S_PER_RPM

if TYPE_CHECKING:
    import pandas as pd
    from mlflow import MlflowClient
    from mlflow.entities import LoggedModel, Run
    from mlflow.models import ModelSignature

MODEL_NAME = "model"
SPEED, NODE = "speed_rpm", "bearing_node"
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
    signature = _describe_signature(folder)
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
    from unittest.mock import patch  # it imports asyncio

    import pandas as pd
    from mlflow import pyfunc
    from mlflow.models import Model

    # MLflow compares requirements with what is installed, for which it lists every file of every package: 0.7 s, and
    # these requirements were read from what is installed.
    check = "mlflow.utils.environment.warn_dependency_requirement_mismatches"
    # mlflow.pyfunc.log_model would do the same through the process-wide tracking URI and the active run, and
    # would load the model once more to try the example on it.
    with patch(check, create=True):
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
            pip_requirements=_pin_requirements(),
        )


def _describe_signature(folder: Path) -> ModelSignature:
    """One speed in; a bearing node, that speed and the coefficients this model identifies out."""
    from mlflow.models import ModelSignature
    from mlflow.types import ColSpec, Schema

    from pipeline.identification.storage import identified_names

    columns = [NODE, SPEED, *identified_names(folder)]
    return ModelSignature(
        inputs=Schema([ColSpec("double", SPEED)]),
        outputs=Schema([ColSpec("long" if name == NODE else "double", name) for name in columns]),
    )


def _pin_requirements() -> list[str]:
    """The predictor's packages at the versions here, less a build's own mark such as ``+cpu``."""
    return [f"{name}=={importlib.metadata.version(name).partition('+')[0]}" for name in _REQUIREMENTS]


class CoefficientModel(Protocol):
    """What can be evaluated: stiffnesses (N/m) and dampings (N s/m) by bearing node and name."""

    def coefficients(self, speed_rad_s: np.ndarray, /) -> dict[int, dict[str, np.ndarray]]: ...


def tabulate_coefficients(model: CoefficientModel, speed_rpm: np.ndarray) -> pd.DataFrame:
    """The columns of ``identified_coefficients.csv``: a row for each bearing and speed, bearing by bearing.

    :param speed_rpm: rotor speeds, shape (n,), rev/min
    :returns: ``bearing_node``, ``speed_rpm`` and the identified coefficients (N/m, N s/m); NaN where a
        bearing lacks one that another bearing has
    """
    import pandas as pd

    speeds = np.asarray(speed_rpm, dtype=float)
    bearings = model.coefficients(speeds * RAD_S_PER_RPM)
    found = {name for values in bearings.values() for name in values}
    names = [name for name in COEFFICIENTS if name in found]
    missing = np.full(speeds.shape, np.nan)
    columns = {
        NODE: np.repeat(np.array(list(bearings), dtype=np.int64), speeds.size),
        SPEED: np.tile(speeds, len(bearings)),
    }
    for name in names:
        columns[name] = np.concatenate([values.get(name, missing) for values in bearings.values()])
    return pd.DataFrame(columns)
