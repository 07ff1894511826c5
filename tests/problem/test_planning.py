"""The runs that an experimenter could make: probes on casings are a cure."""

from __future__ import annotations

import itertools

import pytest

from pipeline.problem.planning import reach
from problem.test_design import FEW, planner


@pytest.mark.slow
def test_probes_on_casings_are_a_cure() -> None:
    """What they are said to bring is what a machine that has them reaches."""
    support = "{kxx: 1e8 N/m, kyy: 2e8 N/m, cxx: 5e3 N s/m, cyy: 8e3 N s/m, mxx: 20 kg, myy: 20 kg"
    soft = [
        *(*FEW, "machine.as_built=null", "identify.known_within=30"),
        "identify.model_parameters={support_stiffness: 1}",
        f"+machine.rotor.supports=[{support}, node: 1}}, {support}, node: 6}}]",
    ]
    probes = [
        f"{{node: {node}, measures: {what}, angle: {angle} deg}}"
        for what, node, angle in itertools.product(("shaft", "casing"), (1, 6), (0, 90))
    ]
    few, more = (reach(planner(*soft, f"machine.probes.at=[{', '.join(probes[:count])}]"), 0.001) for count in (4, 8))
    assert few[0].worst > few[2]["probes on the casings of nodes 1, 6"] == pytest.approx(more[0].worst, rel=1e-9)
