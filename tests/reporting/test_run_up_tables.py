"""Tables of a run-up: what a fit identified is held against it."""

from __future__ import annotations

import json
from pathlib import Path

import pytest
from conftest import Artifacts
from stages.test_ingest import NEEDED, config_of

from pipeline.reporting.run_up_tables import compare_identified
from pipeline.stages.analysis import Analysis
from pipeline.stages.measurement import restore


@pytest.mark.slow
def test_a_run_up_after_a_fit_is_held_against_it(
    artifacts: Artifacts, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """The fit did not see the run-up: its first critical speed agrees, in a band that could have refuted it."""
    folder = artifacts.copied("rk4", NEEDED, tmp_path)
    (analysis := Analysis(config_of(folder))).run("runup")
    first = json.loads((folder / "run_up.json").read_text(encoding="utf-8"))["identified"]["first"]
    assert first["sentence"] in capsys.readouterr().out
    assert first["within"]
    assert first["share_of_interval"] < 1
    assert first["band_percent"] < 4
    every = first["critical_speeds"]
    assert every[0]["rpm"] == first["identified_rpm"]
    assert [one["rpm"] for one in every] == sorted(one["rpm"] for one in every)
    assert all(0 < one["deviation_rpm"] < 0.02 * one["rpm"] for one in every)
    # Where none is, there is nothing to compare.
    assert compare_identified(restore(analysis), {"natural_frequency": {"rpm": 300.0, "deviation_rpm": 1.0}}) == {}
