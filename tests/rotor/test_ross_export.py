"""A rotor with every kind of part goes to ROSS and back, and keeps its matrices."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from conftest import bearings_of

from pipeline.config.rotor import RotorConfig
from pipeline.parameters.model import ModelParameter, set_values, update_rotor
from pipeline.rotor.ross_adapter import assemble, ross
from pipeline.rotor.ross_export import export_rotor


@pytest.mark.slow
def test_a_rotor_with_every_kind_of_part_keeps_its_matrices(tmp_path: Path) -> None:
    """Shaft with damping and axial load, a coupling, discs and a seal, at other model parameters: the matrices that
    the identification updates are those of the exported file."""
    rs = ross()
    steel = rs.Material("steel", rho=7810, E=211e9, G_s=81.2e9)
    shaft = [rs.ShaftElement(0.2, 0, 0.05, material=steel, axial_force=500.0, alpha=0.5, beta=1e-5) for _ in range(4)]
    coupling = rs.CouplingElement(1, 2, 0.01, 0.02, 0.005, 0.01, 1e7, 2e7, 1e6, 1e4, 2e4, 1e4, L=0.1)
    discs = [rs.DiskElement(2, 20.0, 0.1, 0.2, tag="disc")]
    bearings = [rs.BearingElement(node, kxx=1e7, cxx=1e3, tag=f"old {node}") for node in (1, 4)]
    bearings.append(rs.SealElement(n=3, kxx=1e6, kxy=2e5, kyx=-2e5, cxx=100, tag="seal"))
    rs.Rotor([*shaft, coupling], discs, bearings).save(tmp_path / "stated.toml")
    config = RotorConfig(file=str(tmp_path / "stated.toml"))
    parameters = [ModelParameter(kind, 0.02, "", 2) for kind in ("disc_mass", "disc_inertia")]
    parameters += [ModelParameter(kind, 0.02, "") for kind in ("youngs_modulus", "density")]
    parameters = [*set_values(parameters, [1.5, -0.7, 0.9, -1.2])]
    stated = assemble(config)
    table = bearings_of(stated.bearing_nodes, np.array([100.0, 200.0]), kxx=2e7, kyy=1e7, cxx=1e4, cyy=2e4)
    export_rotor(config, parameters, table).save(tmp_path / "updated.toml")
    found = assemble(RotorConfig(file=str(tmp_path / "updated.toml")))
    wanted = update_rotor(stated, parameters)
    for name in ("mass", "gyroscopic", "stiffness", "damping"):
        matrix = getattr(wanted, name)
        np.testing.assert_allclose(getattr(found, name), matrix, atol=1e-9 * np.abs(matrix).max())
        if name != "damping":
            assert np.abs(matrix - getattr(stated, name)).max() > 1e-3 * np.abs(matrix).max()
    assert found.bearing_nodes == stated.bearing_nodes == (1, 4)
    np.testing.assert_array_equal(found.seals.rows, stated.seals.rows)
