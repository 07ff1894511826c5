"""Critical speeds of the identified machine, held against a run-up that the fit did not see."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np

from pipeline.stages.analysis import Analysis
from pipeline.stages.measurement import restore
from pipeline.sweep.readings import compare_natural_frequency
from pipeline.twin.mode_deviations import expect_criticals
from pipeline.units import RAD_S_PER_RPM

_AROUND = np.linspace(0.5, 2.0, 61)
"""Where critical speeds are looked for, as shares of the run-up's first natural frequency."""


def compare_identified(analysis: Analysis, run_up: Mapping[str, Any]) -> dict[str, Any]:
    """The first identified critical speed against the first natural frequency of ``run_up.json``.

    Empty where a fit states no deviations, or finds no critical speed there. Raises ConfigError as
    :func:`pipeline.twin.mode_deviations.expect_criticals`.
    """
    answer = restore(analysis)
    if answer.uncertainty is None:
        return {}
    speeds = run_up["natural_frequency"]["rpm"] * _AROUND * RAD_S_PER_RPM
    expected = expect_criticals(answer.measurement, answer.model, answer.uncertainty, speeds)
    if not expected:
        return {}
    first, (deviation, _) = expected[0]
    compared = compare_natural_frequency(run_up, first.speed / RAD_S_PER_RPM, deviation / RAD_S_PER_RPM)
    every = [
        {
            "rpm": critical.speed / RAD_S_PER_RPM,
            "deviation_rpm": speed_deviation / RAD_S_PER_RPM,
            "logarithmic_decrement": critical.logarithmic_decrement,
            "deviation_logarithmic_decrement": decrement_deviation,
        }
        for critical, (speed_deviation, decrement_deviation) in expected
    ]
    return {"first": compared | {"critical_speeds": every}}
