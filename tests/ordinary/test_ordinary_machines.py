"""The study of ordinary machines: what is drawn is what is said, and its reference method solves what it states."""

from __future__ import annotations

import importlib
import sys
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

ROOT = Path(__file__).resolve().parents[2]
pytestmark = pytest.mark.slow


@pytest.fixture(scope="module")
def study() -> Any:
    """Modules of studies/coverage, which is no package."""
    sys.path.insert(0, str(ROOT / "studies" / "coverage"))
    try:
        yield {name: importlib.import_module(name) for name in ("draw", "ordinary", "population")}
    finally:
        sys.path.pop(0)


@pytest.fixture(scope="module")
def measurement(study: Any, tmp_path_factory: pytest.TempPathFactory) -> tuple[Any, Any]:
    """The measurement of a drawn machine without noise, by its user's files, and the real coefficients."""
    from pipeline.config.compose import compose_config
    from pipeline.stages.measurement import load_measurement

    folder = tmp_path_factory.mktemp("drawn")
    drawn = replace(study["draw"].draw_machine(3), floor=0.0)
    felt = study["ordinary"].write_user_files(folder, drawn, 0.0, 3)
    config = compose_config([f"machine.file={folder / 'machine.yaml'}", "tracking=none", f"output={folder / 'answer'}"])
    return load_measurement(config), felt


def test_a_seed_is_a_machine(study: Any) -> None:
    """Trouble and noise change nothing of what its user states."""
    first, again = (study["draw"].draw_machine(5, trouble=trouble) for trouble in ("none", "discs"))
    assert first.stated == again.stated
    assert first.bearings == again.bearings
    assert study["draw"].draw_machine(6).stated != first.stated


def test_trouble_is_in_the_readings(study: Any) -> None:
    """Each kind changes them, and by no more than its size can: the noise is the same."""
    draw = study["draw"]
    drawn = draw.draw_machine(3)
    exact, _ = draw.measure_machine(drawn, 0.0, 3)
    size = np.abs(exact.displacement).max(axis=0)
    for trouble in set(draw.TROUBLE) - {"none", "correlated"}:
        wrong, _ = draw.measure_machine(replace(drawn, trouble=draw.TROUBLE[trouble]), 0.0, 3)
        off = np.abs(wrong.displacement - exact.displacement).max(axis=0) / size
        assert off.max() > 1e-3, trouble
        assert np.median(off) < 2.0, trouble


def test_coordinates_are_those_of_the_coefficients(study: Any) -> None:
    population = study["population"]
    generator = np.random.default_rng(0)
    w = np.geomspace(20.0, 600.0, 14)
    drawn = population.draw_bearings("lobed", w, 400.0, 0.06, generator, count=50)
    coordinates = population.to_coordinates(drawn, w)
    np.testing.assert_allclose(population.to_coefficients(coordinates, w), drawn, rtol=1e-9, atol=1e-6)
    z, slope = population.to_impedance(coordinates)
    step = 1e-6
    for c in range(8):
        moved = coordinates + step * np.eye(8)[c]
        numeric = (population.to_impedance(moved)[0] - z) / step
        np.testing.assert_allclose(slope[..., c], numeric, rtol=1e-4, atol=1e-4 * np.abs(z).max())


def test_a_short_bearing_of_ross_is_a_member_of_the_plain_family(study: Any) -> None:
    """And no rolling one: by the distance to each mean, in deviations (Friswell et al. 2010, page 177)."""
    draw, population = study["draw"], study["population"]
    drawn = draw.draw_machine(2)
    assert {bearing["kind"] for bearing in drawn.bearings.values()} == {"cylindrical"}
    config = draw.compose_real(drawn)
    rotor = draw.load_rotor(config.machine.rotor)
    speeds = np.array(config.machine.speeds.rpm()) * draw.RAD_S_PER_RPM
    w = np.geomspace(speeds[0], speeds[-1], population.N_NODES)
    real = draw.load_modelled_bearings(config.machine.rotor, config.machine.bearings, w, {})
    loads = population.find_loads(rotor)
    stated = np.array([float(bearing["static_load"].split()[0]) for bearing in drawn.bearings.values()])
    heavy = stated > 0.12 * stated.sum()  # less than a tenth of the weight is taken for a tenth
    assert heavy.any()
    np.testing.assert_allclose(loads[heavy], stated[heavy], rtol=0.02)
    generator = np.random.default_rng(0)
    for b, load in [(b, load) for b, load in enumerate(loads) if heavy[b]]:
        place = population.to_coordinates(real.values[b], w).T.ravel()
        far = {}
        for prior in population.make_priors(w, load, 0.055, generator):
            far[prior.family] = np.mean(np.linalg.solve(prior.root, place - prior.mean) ** 2)
        assert far["plain"] < 1.5
        assert min(far, key=far.__getitem__) in ("plain", "unknown")
        assert far["rolling"] > 3 * far["plain"]


def test_the_problem_predicts_what_was_simulated(study: Any, measurement: tuple[Any, Any]) -> None:
    """At the real coefficients nothing is left of readings without noise, and derivatives are those of differences."""
    population = study["population"]
    measured, felt = measurement
    problem, w = population.Problem(measured), measured.dataset.speeds
    coordinates = np.moveaxis(population.to_coordinates(felt.values, w), 0, 1)
    n_runs, n_numbers = len(measured.dataset.runs), len(problem.changes)
    factors, numbers = np.zeros((2, n_runs)), np.zeros(n_numbers)
    square, gradient, matrix = problem.evaluate(coordinates, factors, numbers)
    assert square < 1e-6 * problem.n_readings
    np.testing.assert_allclose(matrix, matrix.swapaxes(1, 2), rtol=1e-9, atol=1e-6)
    off = coordinates + 0.05
    for place, direction in ((3, (0, 3)), (9, (1, 1))):
        moved = off.copy()
        moved[:, direction[0], direction[1]] += 1e-6
        before, slope, _ = problem.evaluate(off, factors + 0.3, numbers + 0.2)
        after, _, _ = problem.evaluate(moved, factors + 0.3, numbers + 0.2)
        assert (after - before) / 2e-6 == pytest.approx(slope[:, place].sum(), rel=1e-3)
    for t in range(n_numbers):
        before, slope, _ = problem.evaluate(off, factors + 0.3, numbers)
        after, _, _ = problem.evaluate(off, factors + 0.3, numbers + 1e-6 * np.eye(n_numbers)[t])
        assert (after - before) / 2e-6 == pytest.approx(slope[:, 16 + 2 * n_runs + t].sum(), rel=1e-3)
    assert gradient.shape == (len(w), 16 + 2 * n_runs + n_numbers)
