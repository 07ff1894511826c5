"""ROSS's own rotor on bearings, for its analyses as an oracle."""

from __future__ import annotations

from typing import Any

import numpy as np

from pipeline.config.rotor import RotorConfig
from pipeline.rotor.bearing_table import BearingTable
from pipeline.rotor.bearings import BearingConfig, _Bearing
from pipeline.rotor.ross_adapter import assemble, bearing_table, make_rotor, ross
from pipeline.rotor.ross_export import export_rotor, make_bearings
from pipeline.rotor.weight import GRAVITY


def ross_rotor(config: RotorConfig, bearing: BearingConfig, speeds: np.ndarray) -> Any:
    """Of bearings that follow no operating conditions; ``speeds`` (S,) rad/s."""
    if config.supports:
        return export_rotor(config, (), bearing_table(config, bearing, speeds))
    rotor = make_rotor(config)
    if bearing.saved:
        return rotor
    nodes, elements = assemble(config).bearing_nodes, []
    share = float(rotor.m * GRAVITY / len(nodes))
    for node in nodes:
        single = bearing.at(node)
        if type(single).make_element is _Bearing.make_element:
            elements += make_bearings(
                BearingTable((node,), speeds, single.tabulate(speeds, {}, share, ross())[None]), {}
            )
        else:
            elements.append(single.make_element(ross(), node, speeds, share))
    seals = [element for element in rotor.bearing_elements if isinstance(element, ross().SealElement)]
    return ross().Rotor(rotor.shaft_elements, rotor.disk_elements, [*elements, *seals])
