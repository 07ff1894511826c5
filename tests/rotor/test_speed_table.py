"""Bearings of coefficients at some speeds: straight lines between them, and nothing beyond."""

from __future__ import annotations

import numpy as np
import pytest

from pipeline.config.compose import compose_config
from pipeline.errors import ConfigError
from pipeline.rotor.bearings import SpeedTableConfig
from pipeline.units import RAD_S_PER_RPM

FIRST, SECOND = (1000.0, *range(1, 9)), (3000.0, *range(11, 19))


def test_between_the_rows_are_straight_lines() -> None:
    table = SpeedTableConfig(kind="speed_table", rows=(FIRST, SECOND))
    found = table.tabulate(np.array([1000.0, 1500.0, 3000.0]) * RAD_S_PER_RPM)
    np.testing.assert_allclose(found, [FIRST[1:], np.array(FIRST[1:]) + 2.5, SECOND[1:]], rtol=1e-12)


def test_speeds_beyond_the_rows_are_refused() -> None:
    table = SpeedTableConfig(kind="speed_table", rows=(FIRST, SECOND))
    with pytest.raises(ConfigError, match="must span all speeds, but it has 1000 to 3000 rpm and 3100 rpm is needed"):
        table.tabulate(np.array([1500.0, 3100.0]) * RAD_S_PER_RPM)


@pytest.mark.parametrize(
    ("rows", "said"),
    [
        (f"[{list(SECOND)},{list(FIRST)}]", "ascending speeds"),
        (f"[{list(FIRST)}]", "at least 2"),
        (f"[{list(FIRST)[:5]},{list(SECOND)[:5]}]", "at least 9"),
    ],
)
def test_a_table_that_breaks_its_law_is_refused(rows: str, said: str) -> None:
    linear = "{kind: speed_table, rows: " + rows + "}"
    with pytest.raises(ConfigError, match=said):
        compose_config(["machine=two_discs", f"machine.bearings={linear}"])
