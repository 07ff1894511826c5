"""Figures of measured data: a lag is the opposite of the angle, and pictures show something."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from measured_files import table_config
from reading import read, wide_runs

from pipeline.data.dataset import VibrationDataset
from pipeline.reporting.measured_figures import find_lag


def test_a_lag_is_the_opposite_of_the_angle() -> None:
    lag = np.linspace(30, 500, 50)
    assert find_lag(2.0 * np.exp(-1j * np.radians(lag))) == pytest.approx(lag)
    assert find_lag(np.exp(1j * np.radians([90.0]))) == pytest.approx([270.0])


@pytest.mark.slow
def test_figures_show_something(tmp_path: Path) -> None:
    """Pictures of some size with curves in several colours; one speed, and a baseline that stands still, among them."""
    from matplotlib import image

    from pipeline.reporting.measured_figures import draw_bode, draw_measured_orbits

    dataset = read(table_config(wide_runs(tmp_path)))
    displacement = dataset.displacement * np.array([0.0, 1.0])
    still = VibrationDataset(dataset.speeds, dataset.runs, dataset.channels, displacement, dataset.excitations)
    one = VibrationDataset(dataset.speeds[:1], dataset.runs, dataset.channels, displacement[:1], dataset.excitations)
    node = dataset.channels[0][0]
    probes = {"left": (node, 45.0), "right": (node, 135.0), "odd": (node, 0.0)}
    for path in (
        draw_bode(tmp_path / "a.png", still, "one", probes),
        draw_measured_orbits(tmp_path / "b.png", dataset, None),
        draw_measured_orbits(tmp_path / "c.png", one, "one"),
    ):
        pixels = image.imread(path)
        assert min(pixels.shape[:2]) > 500
        assert (np.ptp(pixels[..., :3], axis=-1) > 0.2).sum() > 500
