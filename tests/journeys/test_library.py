"""The library's door: the example of docs/running.md runs as it is printed."""

from __future__ import annotations

import re
from typing import Any

import numpy as np
import pytest
from conftest import Artifacts
from running import ROOT


@pytest.mark.slow
def test_the_example_of_the_library_runs(
    artifacts: Artifacts, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    """From files to coefficients with bands, near the answer of the experiment that holds some data out."""
    text = (ROOT / "docs" / "running.md").read_text(encoding="utf-8")
    (code,) = re.findall(r"```python\n(.*?)```", text, flags=re.DOTALL)
    folder = artifacts("measured_demo", "vibration.parquet", "excitation.csv", "known_coefficients.csv")
    monkeypatch.chdir(ROOT)
    names: dict[str, Any] = {"folder": str(folder)}
    exec(compile(code, "docs/running.md", "exec"), names)  # the example, as a reader would run it
    assert capsys.readouterr().out.startswith("converged")
    table, band = names["coefficients"], names["band"]
    from pipeline.data.coefficient_files import read_coefficients

    held_out = read_coefficients(folder / "identified_coefficients.csv", table.nodes, table.speeds)
    assert (np.abs(table.values - held_out.values)[..., [0, 3, 4, 7]] < 4 * band[..., [0, 3, 4, 7]]).all()


def test_the_door_opens_when_it_is_used() -> None:
    """`import pipeline` is instant; an unknown name is an AttributeError like any other."""
    import pipeline

    assert callable(pipeline.fit)
    with pytest.raises(AttributeError, match="no attribute 'fitt'"):
        pipeline.fitt  # noqa: B018  # looking it up is what raises
