"""The section of a machine: what its parts say must go together."""

from __future__ import annotations

import pytest

from pipeline.config.compose import compose_config
from pipeline.errors import ConfigError


def test_a_machine_has_laws_of_its_bearing_nodes() -> None:
    laws = "{bearings: {%d: {kind: ball, n_balls: 8, ball_diameter: 9 mm, contact_angle: 0.3, load: {guess: 50 N}}}}"
    assert list(compose_config(["machine=two_discs", f"machine.laws={laws % 5}"]).machine.laws.bearings) == [5]
    with pytest.raises(ConfigError, match=r"laws.bearings must have bearing nodes of the rotor .*, but has node 2"):
        compose_config(["machine=two_discs", f"machine.laws={laws % 2}"])
