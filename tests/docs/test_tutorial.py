"""The tutorial's first steps, as a reader types them: the machine file that they make is that of the example."""

from __future__ import annotations

import os
import re
import subprocess
import sys
from pathlib import Path

import pytest
from running import ROOT

pytestmark = pytest.mark.slow


def test_the_tutorial_makes_a_machine_file(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Its commands find the lines that they change: a template that was reworded would leave the example's values."""
    from pipeline.config.compose import compose_config

    text = (ROOT / "docs" / "recordings.md").read_text(encoding="utf-8")
    blocks = re.findall(r"(?:^ {4}.*\n)+", text[text.index("## 1.") : text.index("## 3.")], re.M)
    assert len(blocks) == 3
    (tmp_path / "examples").symlink_to(ROOT / "examples")
    subprocess.run(
        ["bash", "-euc", "\n".join(blocks)],
        cwd=tmp_path,
        env=os.environ | {"PATH": f"{Path(sys.executable).parent}:{os.environ['PATH']}", "PYTHONPATH": str(ROOT)},
        check=True,
        capture_output=True,
        timeout=120,
    )
    monkeypatch.chdir(tmp_path)
    machine = compose_config(["stage=identify", "machine.file=pump/my_pump.yaml", "tracking=none"]).machine
    assert Path(machine.rotor.file).is_file()
    recordings = machine.recordings
    assert (recordings.format, recordings.sample_rate) == ("waveform", 2500)
    assert {probe.scale for probe in recordings.probes.values()} == {"200 mV/mil"}
    assert all(Path(run.file or "").is_file() for run in recordings.runs)
    assert [one.magnitude for run in recordings.runs for one in run.unbalances] == pytest.approx([2e-4, 2e-4])
