"""The model as MLflow gets it: its table."""

from __future__ import annotations

from dataclasses import replace
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from pipeline.rotor.bearing_table import BearingTable
from pipeline.tracking.model import tabulate_identified


@pytest.mark.slow
def test_table_of_bearings_with_different_coefficients() -> None:
    def identify(known: BearingTable) -> BearingTable:
        return replace(known, values=known.speeds[:, None] * np.array([[[2, 0, 0, 0, 1, 0, 0, 0]], [[5, *[0] * 7]]]))

    unknowns = SimpleNamespace(by_bearing=(("cxx", "kxx"), ("kxx",)))
    stub: Any = SimpleNamespace(bearing_nodes=(3, 7), unknowns=unknowns, table=identify)
    table = tabulate_identified(stub, np.array([30.0, 60.0]))
    assert list(table.columns) == ["bearing_node", "speed_rpm", "kxx", "cxx"]
    assert list(table["bearing_node"]) == [3, 3, 7, 7]
    assert list(table["speed_rpm"]) == [30.0, 60.0, 30.0, 60.0]
    np.testing.assert_allclose(table["kxx"] / np.pi, [2, 4, 5, 10])
    np.testing.assert_allclose(table["cxx"] / np.pi, [1, 2, np.nan, np.nan])
