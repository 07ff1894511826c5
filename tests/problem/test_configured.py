"""Known coefficients and modelled machines as configured: files, rows, values, and conditions that change nothing."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import pytest
from conftest import Run, refused
from damaged import answers, measured
from running import composed
from stages.test_measurement import BASE, STATES

from pipeline.coefficients import COEFFICIENTS
from pipeline.config.compose import compose_config
from pipeline.config.measured import KnownConfig
from pipeline.config.schema import Config
from pipeline.data.dataset import Excitation, VibrationDataset
from pipeline.data.sensors import list_directions
from pipeline.errors import ConfigError
from pipeline.problem.configured import build_measurement, find_idle, load_known, model_machine
from pipeline.rotor.bearing_table import BearingTable
from pipeline.rotor.stored import load_modelled_bearings, load_rotor
from pipeline.stages.measurement import load_measurement

SPEEDS = np.array([100.0, 200.0])


def one_row(mine: Path, **speed: str) -> str:
    """Ball bearings have the same coefficients at every speed."""
    rows = pd.read_csv(mine / "known_coefficients.csv").drop_duplicates("bearing_node").drop(columns="speed_rpm")
    rows.assign(**speed).to_csv(mine / "constants.csv", index=False)
    return str(mine / "constants.csv")


def values(mine: Path) -> dict[str, str]:
    first = pd.read_csv(mine / "known_coefficients.csv").iloc[0]
    return {
        name: f"{float(first[name])!r} {'N/m' if name.startswith('k') else 'N s/m'}"
        for name in COEFFICIENTS
        if name not in ("kxx", "kyy")
    }


@pytest.mark.parametrize("way", ["one row", "a blank speed", "values", "bearings"])
def test_constants_need_no_row_a_speed(way: str, run: Run, base: Config, mine: Path) -> None:
    """The same answer, bit for bit, as with a file of every speed."""
    ways: dict[str, Callable[[], Any]] = {
        "one row": lambda: one_row(mine),
        "a blank speed": lambda: one_row(mine, speed_rpm=""),
        "values": lambda: KnownConfig.model_validate(values(mine)),
        "bearings": lambda: "bearings",
    }
    run("train", base, mine.parent / "output", data=measured(mine).model_copy(update={"known": ways[way]()}))
    assert answers(mine.parent / "output") == answers(mine)


def test_no_known_file_where_all_eight_are_identified(mine: Path) -> None:
    (mine / "known_coefficients.csv").unlink()
    config = composed("experiment=noisy_all", "tracking=none", "machine=one_disc", "data.baseline=null")
    config = config.model_copy(update={"data": measured(mine).model_copy(update={"known": None})})
    assert not load_measurement(config).known.values.any()


def test_what_is_needed_and_missing_is_named(base: Config, mine: Path, run: Run) -> None:
    with refused("but nothing gives kxy, kyx, cxx, cxy, cyx, cyy", "{kxy: 0 N/m, ", "data.known", kind=ConfigError):
        run("train", base, mine.parent / "output", data=measured(mine).model_copy(update={"known": None}))
    some = KnownConfig.model_validate({key: value for key, value in values(mine).items() if key != "cyx"})
    with refused("data.known must have a value of every", "cyx is missing", kind=ConfigError):
        load_known(base, some, "data.known", (0, 2), SPEEDS)


def test_the_bearings_give_nothing_of_what_is_identified(base: Config) -> None:
    found = load_known(base, "bearings", "data.known", (0, 2), SPEEDS)
    assert not found.coefficient("kxx").any()
    assert not found.coefficient("kyy").any()


@pytest.mark.parametrize(
    ("known", "words"),
    [
        ("{cxy: 0 N/m}", "data.known.cxy: must convert to N * s / m (such as 0 N s/m), but got '0 N/m'"),
        ("{cxz: 0}", "cxz"),
        ("3", "must be a file, 'bearings', or values such as {cxy: 0 N s/m}, but got 3"),
    ],
)
def test_values_that_are_none_are_refused_with_their_key(known: str, words: str) -> None:
    with refused(words, kind=ConfigError):
        composed("experiment=ball_bearing", "tracking=none", f"data.known={known}")


@pytest.mark.slow
def test_every_speed_and_run_is_made_at_every_combination_of_the_conditions() -> None:
    _, _, plain = model_machine(composed(*BASE))
    _, bearings, found = model_machine(composed(*BASE, STATES))
    count = len(plain.speeds)
    assert len(found.speeds) == 4 * count
    assert found.operating["oil_temperature"].tolist() == [318.15] * 2 * count + [338.15] * 2 * count
    assert found.operating["load"].tolist() == 2 * ([500.0] * count + [700.0] * count)
    assert bearings.operating == found.operating
    np.testing.assert_array_equal(found.displacement, np.tile(plain.displacement, (4, 1, 1)))


@pytest.mark.slow
def test_a_condition_that_changes_no_bearing_is_named() -> None:
    """Balls follow neither; a film follows what it is told to."""
    at = dict(zip(("load", "oil_temperature"), np.meshgrid([5.0, 7.0], [310.0, 320.0]), strict=True))
    operating = {name: values.ravel() for name, values in at.items()}
    same = BearingTable((0,), np.full(4, 100.0), np.ones((1, 4, 8)), operating)
    assert find_idle(same) == ["load", "oil_temperature"]
    assert find_idle(replace(same, values=same.values * operating["oil_temperature"][:, None])) == ["load"]


def test_x_and_y_of_turned_probes_have_the_floors_that_these_give_them() -> None:
    """Half the squares of 3 and 4 um each, at 45 degrees."""
    names = list(compose_config(["experiment=measured_demo"]).machine.recordings.probes)
    floors = [f"++machine.recordings.probes.{name}.floor='{3 + i % 2} um'" for i, name in enumerate(names)]
    config = compose_config(["experiment=measured_demo", *floors])
    rotor, speeds = load_rotor(config.machine.rotor), np.array([100.0])
    channels = list_directions(rotor.bearing_nodes)
    data = VibrationDataset(
        speeds, ("a",), channels, np.zeros((1, 4, 1)), (Excitation("a", "unbalance", 1, 1e-4, 0.0),)
    )
    known = load_modelled_bearings(config.machine.rotor, config.machine.bearings, speeds)
    noise = build_measurement(config, rotor, data, known).noise
    assert np.array(noise.floors) == pytest.approx(np.tile([2.5e-6 * np.sqrt(2), 0.0, 0.0], (4, 1)))
