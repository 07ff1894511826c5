"""A data set: the forces of its runs, and a baseline that is subtracted."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from conftest import Machine
from small_rotor import DIRECT, small_machine

from pipeline.data.dataset import Excitation, assemble_forces, subtract_baseline
from pipeline.problem.measurement import Measurement


def without(measurement: Measurement, points: np.ndarray, run: int) -> Measurement:
    """The readings of a ``run`` gone at the ``points``."""
    present = np.ones(measurement.dataset.displacement.shape[::2], dtype=bool)
    present[points, run] = False
    displacement = measurement.dataset.displacement * present[:, None]
    return replace(measurement, dataset=replace(measurement.dataset, displacement=displacement, present=present))


def test_nothing_is_subtracted_from_what_was_not_measured() -> None:
    whole = small_machine(DIRECT)[0]
    three = replace(whole.dataset, runs=("a", "b", "c"), displacement=whole.dataset.displacement[..., [0, 1, 1]])
    less = subtract_baseline(without(replace(whole, dataset=three), np.array([1, 4]), 1).dataset, "a")
    assert not less.complete
    assert less.present.tolist() == [[s not in (1, 4), True] for s in range(6)]
    assert not less.displacement[[1, 4], :, 0].any()
    assert not less.subtracted[[1, 4], :, 0].any()
    assert less.displacement[..., 1].all()


def test_unbalance_force(hydrostatic: Machine) -> None:
    """method.md, section 1: F = w^2 m e e^{jp} [1, -j] forward, [1, +j] backward; a force has no w^2."""
    w = np.array([10.0, 300.0])
    made = (
        Excitation("a", "unbalance", 2, 1e-4, 0.3),
        Excitation("b", "unbalance", 2, 1e-4, 0.3, "backward"),
        Excitation("c", "force", 3, 5.0, -1.0),
    )
    force = assemble_forces(hydrostatic.rotor, made, ("a", "b", "c"), w)
    size = 1e-4 * w**2 * np.exp(0.3j)
    np.testing.assert_allclose(force[:, 8:10, 0], np.stack([size, -1j * size], axis=1), rtol=1e-14)
    np.testing.assert_allclose(force[:, 8:10, 1], np.stack([size, 1j * size], axis=1), rtol=1e-14)
    rotating = np.tile(5 * np.exp(-1j) * np.array([1, -1j]), (2, 1))
    np.testing.assert_allclose(force[:, 12:14, 2], rotating, rtol=1e-14)
    assert np.count_nonzero(force) == 12
