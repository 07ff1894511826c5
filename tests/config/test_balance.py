"""The section of what may remain: the eccentricity of ISO 21940-11's chart."""

from __future__ import annotations

import pytest

from pipeline.config.balance import ToleranceConfig


def test_the_permissible_eccentricity_is_that_of_the_standards_chart() -> None:
    """G6.3 at 3000 rpm allows 20 um, G2.5 at 3600 rpm 6.6 um."""
    for grade, rpm, micrometres in (("G6.3", 3000, 20.05), ("G 2.5", 3600, 6.631)):
        tolerance = ToleranceConfig.model_validate({"grade": grade, "service_speed_rpm": rpm})
        assert tolerance.permissible(7.0) / 7.0 == pytest.approx(1e-6 * micrometres, rel=1e-3)
