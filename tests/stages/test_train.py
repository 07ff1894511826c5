"""stage=train: what is not identifiable is not trained, unless it is forced."""

from __future__ import annotations

from pathlib import Path

import pytest
from conftest import Run

from pipeline.errors import IdentifiabilityError


@pytest.mark.slow
def test_training_of_what_is_not_identifiable(run: Run, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """It stops with the sentence, and force=true goes on with the same sentence as a line."""
    chosen = ("experiment=compressor_journal_and_isotropic", "machine.speeds.step_rpm=300")
    with pytest.raises(IdentifiabilityError, match=r"8: not identifiable, because .*rank 1 of 2.*backward.*force=true"):
        run("train", chosen, tmp_path / "x")
    assert not (tmp_path / "x" / "model.json").exists()
    run("train", [*chosen, "force=true", "optimizer.levenberg_marquardt.steps=2"], tmp_path / "x")
    assert "bearing at node 8: not identifiable" in capsys.readouterr().out
    assert (tmp_path / "x" / "model.json").exists()
