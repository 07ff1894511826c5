"""Evidence: the growth of modes at the first speed at which it is told from zero."""

from __future__ import annotations

from types import SimpleNamespace
from typing import Any, cast

import numpy as np
import pytest

from pipeline.rotor.bearing_table import BearingTable
from pipeline.trust.evidence import Growth, find_growth


def test_the_growth_is_that_of_the_first_speed_at_which_it_is_told_from_zero(monkeypatch: pytest.MonkeyPatch) -> None:
    """A larger one further up, of which nothing is known, is not named beside that speed."""
    growth, deviation = np.array([-5.0, 9.0, 3e4]), np.array([1.0, 1.0, 1.4e5])
    monkeypatch.setattr("pipeline.twin.modes.find_modes", lambda *_, **__: SimpleNamespace(growth=growth))
    monkeypatch.setattr("pipeline.twin.mode_deviations.deviate_modes", lambda *_: SimpleNamespace(growth=deviation))
    table = BearingTable((0,), np.array([100.0, 200.0, 300.0]), np.ones((1, 3, 8)))
    machine = cast(Any, SimpleNamespace(updated_rotor=None, select=lambda _: None))
    assert find_growth(machine, table, cast(Any, None)) == Growth(9.0, 1.0, pytest.approx(200 * 30 / np.pi))
