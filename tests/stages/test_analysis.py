"""What an analysis is of: the hash of its machine."""

from __future__ import annotations

import pytest
from running import composed

from pipeline.stages.analysis import hash_machine
from stages.test_measurement import BASE, STATES


@pytest.mark.slow
def test_a_machine_without_conditions_is_the_machine_that_it_was() -> None:
    assert hash_machine(composed(*BASE)) == hash_machine(composed(*BASE, "machine.operating=null"))
    assert hash_machine(composed(*BASE)) != hash_machine(composed(*BASE, STATES))
