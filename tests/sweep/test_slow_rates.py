"""The table of docs/run_up.md is what the program computes."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from pipeline.sweep.bias import find_slow_rate

RPM = np.pi / 30
PAGE = Path(__file__).resolve().parents[2] / "docs" / "run_up.md"


@pytest.mark.parametrize("damping", ["0.005", "0.01", "0.02", "0.05", "0.1"])
def test_the_printed_rates(damping: str) -> None:
    line = next(row for row in PAGE.read_text(encoding="utf-8").splitlines() if row.startswith(f"| {damping} |"))
    found = [find_slow_rate(rpm * RPM, float(damping), 0.01) / RPM for rpm in (600, 1600, 6000)]
    assert found == pytest.approx([float(cell) for cell in line.split("|")[2:5]], rel=0.01)
