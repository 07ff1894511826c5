"""The response by blocks: a singular machine on the way of a search."""

from __future__ import annotations

from dataclasses import replace

import torch
from small_rotor import SPEEDS

from pipeline.problem.response import respond
from problem.test_law_information import WARM, measured


def test_a_search_that_passes_a_singular_machine_turns_back() -> None:
    """Receptance 1 and stiffness -1: no number, in place of an error that would end the fit."""
    block = measured([WARM]).response.blocks[0].converted(torch.as_tensor)
    unit = torch.eye(4, dtype=torch.complex128).expand(len(SPEEDS), 4, 4)
    change = -unit.clone()
    change[0] = unit[0]
    found = respond(replace(block, receptance_bearings=unit), change).sensors
    assert bool(found[0].isfinite().all())
    assert bool(found[1:].isnan().all())
