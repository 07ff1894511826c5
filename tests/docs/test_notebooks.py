"""The notebooks of docs run from top to bottom as they are, and say what they promise."""

from __future__ import annotations

import os
import re
from pathlib import Path
from typing import Any

import pytest
from running import ROOT


def read(path: Path) -> Any:
    """A notebook."""
    import nbformat

    return nbformat.read(path, as_version=4)


def run(name: str, results: Path, monkeypatch: pytest.MonkeyPatch) -> dict[str, Any]:
    """What the notebook's names stand for after its last cell; its cells run in this process, without a kernel."""
    import matplotlib

    names: dict[str, Any] = {}
    monkeypatch.chdir(ROOT / "docs" / "notebooks")
    monkeypatch.setenv("NOTEBOOK_RESULTS", str(results))
    monkeypatch.setattr(os, "environ", os.environ | {"MPLBACKEND": "Agg"})
    with matplotlib.rc_context():  # use() changes more than the backend
        matplotlib.use("Agg")
        for number, cell in enumerate(read(ROOT / "docs" / "notebooks" / f"{name}.ipynb").cells):
            if cell.cell_type == "code":
                exec(compile(cell.source, f"{name}, cell {number}", "exec"), names)
    matplotlib.pyplot.close("all")
    return names


@pytest.mark.parametrize("path", sorted((ROOT / "docs" / "notebooks").glob("*.ipynb")), ids=lambda path: path.stem)
def test_no_output_is_kept(path: Path) -> None:
    """Outputs are of one machine and one day; git keeps the cells alone."""
    text = path.read_text(encoding="utf-8")
    assert not re.search(r'"(?:output_type|image/png)"', text)
    assert '"execution_count": null' in text


@pytest.mark.slow
def test_the_paper_is_reproduced(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    names = run("paper", tmp_path, monkeypatch)
    assert names["ends"].keys() == {1.0, 1e8}
    assert all(abs(end / 464.16883e5 - 1) < 1e-6 for end in names["ends"].values())
    assert names["errors"]["kxx"] < 0.002
    assert names["errors"]["kyy"] < 0.001
    assert names["worst"] < 0.1


@pytest.mark.slow
def test_recordings_become_coefficients(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    names = run("recordings", tmp_path, monkeypatch)
    assert 0 < names["worst"] < 1
    assert 0 < names["error"] < 0.01


@pytest.mark.slow
@pytest.mark.usefixtures("no_pictures")
def test_a_study_is_made_and_read(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    names = run("study", tmp_path, monkeypatch)
    assert len(list((tmp_path / "study").glob("trials.csv"))) == 1
    assert len(names["finalists"]) >= 5


@pytest.mark.slow
@pytest.mark.usefixtures("no_pictures")
def test_a_real_rig_says_what_it_concludes(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    names = run("a_real_rig", tmp_path, monkeypatch)
    assert sorted(names["named"]) == ["B007", "B031", "B038", "B047"]
    assert (names["of_condition"] > 2 * names["of_record"]).all()
    assert names["median"] < 0.1
    assert 520 < names["span"] < 560
    assert min(share for (_, name), share in names["shares"].items() if name.startswith("c")) > 0.3
    assert names["first"]["rpm"] == pytest.approx(1586, abs=23)
    assert names["steady"]["rpm"] == pytest.approx(1648, abs=2)
