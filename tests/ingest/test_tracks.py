"""Runs at speeds of their own, read from tables of ROSS's response: they tell what a full grid tells, in any order."""

from __future__ import annotations

from collections.abc import Mapping
from functools import cache
from pathlib import Path
from tempfile import TemporaryDirectory

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from measured_files import PAIR, Vectors, probes_config, table_config, vectors_of, wide
from reading import RPM, read

from benchmarks.machines import Machine, machine
from benchmarks.ross_oracle import ross_rotor
from pipeline.data.dataset import VibrationDataset
from pipeline.identification.output_error_fit import fit_output_error
from pipeline.identification.training import setup_of
from pipeline.problem.configured import build_measurement
from pipeline.rotor.ross_adapter import bearing_table

PROBES = {"A": (1, 45.0), "B": (1, 135.0), "C": (5, 0.0), "D": (5, 90.0)}
EVERY = np.arange(400.0, 5801.0, 300.0)


@cache
def two_discs() -> Machine:
    """On bearings that do not change with the speed."""
    bearings = "{kind: linear, kxx: 2.4e7, kyy: 1.7e7, cxx: 9e3, cyy: 7e3}"
    return machine("experiment=noisy_direct", "model=constant", f"machine.bearings={bearings}")


@cache
def respond(run: str) -> Vectors:
    """What ROSS's response shows the probes at every speed."""
    made = two_discs()
    rotor = ross_rotor(made.config.machine.rotor, made.config.machine.bearings, EVERY * RPM)
    acting = [(e.node, e.magnitude, e.phase) for e in made.excitations if e.run == run]
    nodes, sizes, phases = (list(part) for part in zip(*acting, strict=True))
    shown = rotor.run_unbalance_response(nodes, sizes, phases, frequency=EVERY * RPM).forced_resp
    return vectors_of(EVERY, lambda node: shown[6 * node], lambda node: shown[6 * node + 1], PROBES)


def read_rows(rows: Mapping[str, np.ndarray]) -> VibrationDataset:
    """Runs, in this order, each with the rows of ROSS's response that it has."""
    runs, acting = [], two_discs().excitations
    with TemporaryDirectory() as folder:
        for name, kept in rows.items():
            path, every = Path(folder) / f"{name}.csv", respond(name)
            wide(Vectors(EVERY[kept], {p: v[kept] for p, v in every.of.items()})).to_csv(path, index=False)
            weights = [{"node": e.node, "magnitude": e.magnitude, "phase": e.phase} for e in acting if e.run == name]
            runs.append({"name": name, "file": str(path), "unbalances": weights})
        return read(table_config(runs, probes=probes_config(PROBES, **PAIR)))


def identify(data: VibrationDataset) -> np.ndarray:
    """(B, 8) what a fit of the readings finds."""
    config = two_discs().config
    known = bearing_table(config.machine.rotor, config.machine.bearings, data.speeds)
    measurement = build_measurement(config, two_discs().rotor, data, known)
    return np.asarray(fit_output_error(measurement, setup_of(config)).identified.table(known).values[:, 0])


@pytest.mark.slow
def test_readings_at_unequal_speeds_tell_the_coefficients() -> None:
    """No speed is that of two runs; a third of the readings of a full grid is as exact as that."""
    every, names = np.arange(len(EVERY)), two_discs().runs
    for rows in (dict.fromkeys(names, every), {name: every[r::3] for r, name in enumerate(names)}):
        data = read_rows(rows)
        assert data.n_readings == len(data.channels) * sum(map(len, rows.values()))
        np.testing.assert_allclose(identify(data)[:, [0, 3, 4, 7]], [[2.4e7, 1.7e7, 9e3, 7e3]] * 2, rtol=1e-8)


@pytest.mark.slow
@settings(max_examples=25, deadline=None)
@given(
    masks=st.lists(st.sets(st.integers(0, len(EVERY) - 1), min_size=1), min_size=3, max_size=3),
    order=st.permutations(range(3)),
)
def test_the_order_of_runs_does_not_matter(masks: list[set[int]], order: list[int]) -> None:
    rows = {name: np.array(sorted(mask)) for name, mask in zip(two_discs().runs, masks, strict=True)}
    names = [[*rows][r] for r in order]
    straight, turned = read_rows(rows), read_rows({name: rows[name] for name in names})
    assert straight.present.sum(axis=0).tolist() == [len(mask) for mask in masks]
    np.testing.assert_array_equal(turned.speeds, straight.speeds)
    np.testing.assert_array_equal(turned.displacement, straight.displacement[..., order])
    np.testing.assert_array_equal(turned.present, straight.present[:, order])
