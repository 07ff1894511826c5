"""One run-down of a drawn machine on a soft base tells the base and the unbalance, as studies/soft_ground says."""

from __future__ import annotations

from pathlib import Path

import pytest
import run_down


@pytest.mark.slow
def test_one_run_down_tells_base_and_unbalance(tmp_path: Path) -> None:
    """Within the limits of the study: 5 % and 5 degrees, and 10 % of the base's receptance."""
    judged = run_down.run(tmp_path, 103)
    assert max(*judged["unbalance_percent"], *judged["unbalance_deg"], judged["response_median_percent"] / 2) < 5
