"""The logged model's code: MLflow copies this file beside the weights and runs it when a model is loaded."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import pandas as pd
from mlflow.models import set_model
from mlflow.pyfunc.model import PythonModel, PythonModelContext


class CoefficientPredictor(PythonModel):
    """A table of rotor speeds (``speed_rpm``) and conditions in, a table of bearing coefficients (SI) out."""

    def load_context(self, context: PythonModelContext) -> None:
        """Read the network from the model's own files."""
        from pipeline.identification.storage import load_model

        self._model = load_model(Path(context.artifacts["weights"]).parent)

    # MLflow reads these annotations when the class is made, and warns its users where there are none.
    def predict(
        self, context: PythonModelContext, model_input: pd.DataFrame, params: dict[str, Any] | None = None
    ) -> pd.DataFrame:
        """The coefficients at the speeds; see :func:`pipeline.tracking.model.tabulate_identified`."""
        from pipeline.tracking.model import SPEED, read_conditions, tabulate_identified

        operating = read_conditions(self._model, model_input)
        return tabulate_identified(self._model, model_input[SPEED].to_numpy(), operating)


set_model(CoefficientPredictor())
