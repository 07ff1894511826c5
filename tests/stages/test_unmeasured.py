"""Modelled coefficients at operating conditions that no run has."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from pipeline.config.compose import compose_config
from pipeline.errors import ConfigError
from pipeline.stages.unmeasured import measure_unmeasured, model_unmeasured
from pipeline.units import RAD_S_PER_RPM

OIL = ("machine=compressor_oil_temperatures", "model=law", "loss=response", "robustness=refits")
ASKED = "machine.unmeasured.oil_temperature=[70 degC,40 degC]"
SPEEDS = np.tile([1000.0, 2000.0], 3) * RAD_S_PER_RPM
EIGHT = ("kxx", "kxy", "kyx", "kyy", "cxx", "cxy", "cyx", "cyy")


def test_each_speed_once_at_each_condition() -> None:
    table = model_unmeasured(compose_config([*OIL, ASKED]), SPEEDS)
    assert table is not None
    np.testing.assert_allclose(table.operating["oil_temperature"] - 273.15, [40, 40, 70, 70])
    np.testing.assert_allclose(table.speeds, np.tile(SPEEDS[:2], 2))
    wrong = replace(table, values=table.values * np.array([1.01, 1.01, 1.03, 1.03])[:, None])
    found = measure_unmeasured(wrong, table, [EIGHT, EIGHT])
    assert list(found) == ["40 degC", "70 degC"]
    assert found["40 degC"][8]["kxx"].median_error_percent == pytest.approx(1.0)
    assert found["70 degC"][21]["cyy"].median_error_percent == pytest.approx(3.0)


def test_nothing_is_asked_for() -> None:
    assert model_unmeasured(compose_config([*OIL, "machine.unmeasured=null"]), SPEEDS) is None


def test_a_condition_without_its_unit() -> None:
    with pytest.raises(ConfigError, match=r"machine\.unmeasured.*must carry its unit"):
        compose_config([*OIL, "machine.unmeasured.oil_temperature=[40,70]"])
