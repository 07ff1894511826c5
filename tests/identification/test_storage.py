"""Models as files: there and back, and damaged ones refused."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
import torch
from conftest import unknown_at_all
from training import a_model

from pipeline.errors import DataError
from pipeline.identification.identified import IdentifiedModel
from pipeline.identification.model import CoefficientModel
from pipeline.identification.storage import ARCHITECTURE, WEIGHTS, load_model, save_model


def drawn(model: CoefficientModel, generator: torch.Generator) -> IdentifiedModel:
    """A model with random numbers."""
    parameters = torch.randn(len(model.scale), model.n_parameters, generator=generator, dtype=torch.float64)
    return IdentifiedModel(model, unknown_at_all((1, 5), model.unknowns), (1, 5), parameters)


@pytest.mark.usefixtures("one_thread")
@pytest.mark.parametrize("depth", [None, 1, 3])
def test_storage_round_trip(depth: int | None, tmp_path: Path, generator: torch.Generator) -> None:
    """What is saved comes back with the same bits, architecture and scaling included."""
    identified = drawn(a_model(depth, "silu", members=1), generator)
    assert sorted(path.name for path in save_model(tmp_path, identified)) == sorted([ARCHITECTURE, WEIGHTS])
    loaded = load_model(tmp_path)
    assert (loaded.model, loaded.bearing_nodes) == (identified.model, (1, 5))
    assert torch.equal(loaded.parameters, identified.parameters)
    speeds = np.array([10.0, 200.0, 601.0])
    np.testing.assert_array_equal(loaded.values(speeds), identified.values(speeds))
    assert not [path for path in tmp_path.iterdir() if path.name.startswith(".")]


DAMAGES = {
    "no weights": lambda folder: (folder / WEIGHTS).unlink(),
    "no architecture": lambda folder: (folder / ARCHITECTURE).unlink(),
    "architecture is no JSON": lambda folder: (folder / ARCHITECTURE).write_text("{"),
    "architecture is a list": lambda folder: (folder / ARCHITECTURE).write_text("[]"),
}


@pytest.mark.usefixtures("one_thread")
@pytest.mark.parametrize("damage", DAMAGES)
def test_damaged_model_is_refused(damage: str, tmp_path: Path, generator: torch.Generator) -> None:
    """With a sentence, not with a traceback; what else a model can be spoilt by: tests/journeys/test_bad_models.py."""
    save_model(tmp_path, drawn(a_model(2), generator))
    DAMAGES[damage](tmp_path)
    with pytest.raises(DataError, match="must"):
        load_model(tmp_path)
