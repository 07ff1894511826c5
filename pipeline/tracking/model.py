"""An identified model, logged so that MLflow can load and serve it without this project being installed."""

from __future__ import annotations

import importlib.metadata
import tempfile
from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from pipeline.coefficients import COEFFICIENTS
from pipeline.config.operating import column_of
from pipeline.data.coefficient_files import tabulate_coefficients
from pipeline.data.operating import list_columns
from pipeline.rotor.bearing_table import BearingTable
from pipeline.tracking.entries import StageRecord, flatten_parameters
from pipeline.units import RAD_S_PER_RPM

if TYPE_CHECKING:
    import pandas as pd
    from mlflow import MlflowClient
    from mlflow.entities import LoggedModel, Run
    from mlflow.models import ModelSignature

    from pipeline.identification.identified import IdentifiedModel

SPEED = "speed_rpm"


def log_model(client: MlflowClient, run: Run, record: StageRecord) -> str:
    """Log the record's model (``model.safetensors``, ``model.json``) as a model of ``run``; returns the model's id.

    The model is code (:mod:`pipeline.tracking.predictor` and this package) with data beside it, no pickle.

    :raises Exception: what MLflow or reading the model raises; the logged model is then marked as failed
    """
    from mlflow.entities import LoggedModelOutput, LoggedModelStatus
    from mlflow.models import infer_signature

    folder = record.model or Path()
    artifacts = {"weights": folder / "model.safetensors", "description": folder / "model.json"}
    example, answer = record.example
    logged = client.create_logged_model(
        run.info.experiment_id,
        name="model",
        source_run_id=run.info.run_id,
        params=flatten_parameters(record.parameters),
    )
    try:
        with tempfile.TemporaryDirectory() as scratch:
            path = Path(scratch, "model")
            _save(path, logged, infer_signature(example, answer), artifacts, example)
            client.log_model_artifacts(logged.model_id, str(path))
        client.log_outputs(run.info.run_id, [LoggedModelOutput(logged.model_id, step=0)])
    except BaseException:
        client.finalize_logged_model(logged.model_id, LoggedModelStatus.FAILED)
        raise
    client.finalize_logged_model(logged.model_id, LoggedModelStatus.READY)
    return logged.model_id


def list_conditions(identified: IdentifiedModel) -> tuple[str, ...]:
    """The operating conditions that the coefficients depend on."""
    laws = identified.laws.inputs
    inputs = () if identified.model.hidden is None else identified.model.inputs
    return tuple(dict.fromkeys(name for name in (*inputs, *laws) if name != "speed"))


def exemplify(identified: IdentifiedModel) -> tuple[pd.DataFrame, pd.DataFrame]:
    """A question to the model and its answer: the middle of each condition that it is a function of, and a usual value
    for a law's."""
    import pandas as pd

    model, usual = identified.model, {"oil_temperature": 323.15, "load": 1000.0}
    conditions = {
        name: np.array(
            [np.mean(model.ranges[model.inputs.index(name)])] if name in model.inputs else [usual.get(name, 1.0)]
        )
        for name in list_conditions(identified)
    }
    example = pd.DataFrame({SPEED: np.array([1500.0])} | list_columns(conditions))
    return example, tabulate_identified(identified, example[SPEED].to_numpy(), conditions)


def read_conditions(identified: IdentifiedModel, table: pd.DataFrame) -> dict[str, np.ndarray]:
    """Name -> (n,) SI, of the conditions that the coefficients depend on, from the columns of a table."""
    columns = {name: column_of(name) for name in list_conditions(identified)}
    return {name: column.to_si(table[column.column].to_numpy()) for name, column in columns.items()}


def _save(
    path: Path,
    logged: LoggedModel,
    signature: ModelSignature,
    artifacts: Mapping[str, Path],
    example: pd.DataFrame,
) -> None:
    from unittest.mock import patch  # it imports asyncio

    from mlflow import pyfunc
    from mlflow.models import Model

    # MLflow compares requirements with what is installed, for which it lists every file of every package: 0.7 s, and
    # these requirements were read from what is installed.
    packages = ["mlflow", "numpy", "pandas", "pydantic", "safetensors", "torch"]
    packages += ["pint"] if len(example.columns) > 1 else []
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
            python_model=str(Path(__file__).with_name("predictor.py")),
            artifacts={name: str(artifact) for name, artifact in artifacts.items()},
            code_paths=[str(Path(__file__).resolve().parents[1])],
            signature=signature,
            input_example=example,
            # Without a build's own mark such as ``+cpu``.
            pip_requirements=[f"{name}=={importlib.metadata.version(name).partition('+')[0]}" for name in packages],
        )


def tabulate_identified(
    model: IdentifiedModel, speed_rpm: np.ndarray, operating: Mapping[str, np.ndarray] | None = None
) -> pd.DataFrame:
    """The columns of ``identified_coefficients.csv``: a row for each bearing and speed, bearing by bearing.

    :param speed_rpm: rotor speeds, shape (n,), rev/min
    :param operating: conditions at them by name, shape (n,), SI
    :returns: ``bearing_node``, ``speed_rpm``, the conditions and the identified coefficients (N/m, N s/m); NaN where a
        bearing lacks one that another bearing has
    """
    import pandas as pd

    nodes, speeds = model.bearing_nodes, np.asarray(speed_rpm, dtype=float) * RAD_S_PER_RPM
    known = BearingTable(nodes, speeds, np.zeros((len(nodes), len(speeds), len(COEFFICIENTS))), operating or {})
    named = dict(zip(nodes, model.unknowns.by_bearing, strict=True))
    return pd.DataFrame(tabulate_coefficients(model.table(known), named))
