"""The measured machine on a soft base: its table as the program reads it, and scores by their definitions."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pandas as pd
import pytest
from running import ROOT
from soft_base import MACHINE, Predicted, keep, read

from pipeline.config.compose import compose_config
from pipeline.data.sensors import NO_FLOOR
from pipeline.errors import ConfigError
from pipeline.problem.configured import configure_sensors
from pipeline.rotor.stored import load_rotor

RECORDS = MACHINE / "records.csv"


@pytest.mark.slow
def test_every_record_is_read_at_its_own_speed() -> None:
    """Displacements are the table's accelerations over -w^2, at the housings; the credits stand beside the table."""
    measurement, table = read(compose_config(["experiment=mafaulda", "tracking=none"], MACHINE)), pd.read_csv(RECORDS)
    data = measurement.dataset
    assert data.present.sum() == len(table) == 287
    speed, run = np.nonzero(data.present)
    w = data.frequencies[speed, run]
    at = {
        (c, round(hz, 3)): row for c, hz, row in zip(table.condition, table.tacho_hz, table.itertuples(), strict=True)
    }
    for s, r, w_r in zip(speed, run, w, strict=True):
        row = at[data.runs[r], round(w_r / (2 * np.pi), 3)]
        expected = [complex(getattr(row, f"{n}_re"), getattr(row, f"{n}_im")) for n in ("tg1", "rad1", "tg2", "ax1")]
        assert -(w_r**2) * data.displacement[s, :, r] == pytest.approx(expected, rel=1e-9)
    grams = {weight.run: weight.magnitude / 50e-6 for weight in data.excitations}
    assert grams == pytest.approx({f"{g}g": g for g in (0, 6, 10, 20, 25, 35)})
    half = keep(data, data.present & (np.arange(6) < 3))
    assert half.runs == data.runs[:3]
    assert half.present.any(axis=1).all()
    credits = (MACHINE / "README.md").read_text(encoding="utf-8") + Path(ROOT / "examples/mafaulda/LICENSE").read_text()
    assert all(name in credits for name in ("Renner Tetzner", "Ribeiro", "MIT License"))
    assert sum(path.stat().st_size for path in MACHINE.rglob("*")) < 1_000_000


def test_a_label_is_read_from_the_other_records_alone() -> None:
    """Weights that act 1.3 times as much and 20 degrees later: predicted exactly, but for the record that is off."""
    rng = np.random.default_rng(4)
    change, still = rng.standard_normal((2, 12, 2)) + 1j * rng.standard_normal((2, 12, 2))
    true = still + 1.3 * np.exp(1j * np.pi / 9) * change
    made = Predicted(np.arange(12) % 2, true, still + change, still, np.ones((12, 2, 2)))
    assert made.label_read().expected == pytest.approx(true)
    assert made.scores("ab")["r2"]["a"] == pytest.approx(1 - abs(1 - 1 / (1.3 * np.exp(1j * np.pi / 9))) ** 2)
    off = true.copy()
    off[0] = 50.0
    other = Predicted(made.weight, off, made.expected, still, made.deviation).label_read()
    assert other.expected[0] == pytest.approx(true[0])
    assert np.abs(other.expected[2] - true[2]).max() > 1e-3


@pytest.mark.slow
def test_the_floor_of_a_probe_is_constant_in_what_it_measures() -> None:
    """a / w^k of the displacement, since U = (j w)^k V, beside a floor that all probes share."""
    stated = {"tg1": "0.1 m/s^2", "rad1": "3 mm/s", "tg2": "2 um", "ax1": "0 um"}
    overrides = [f"++machine.recordings.probes.{name}.floor='{size}'" for name, size in stated.items()]
    noise = "stated_noise={additive: 1 um, multiplicative: 0}"
    measurement = read(compose_config(["experiment=mafaulda", noise, *overrides], MACHINE))
    w, nothing = measurement.dataset.frequencies, np.zeros_like(measurement.dataset.displacement)
    wanted = np.hypot(1e-6, np.stack([0.1 / w**2, 3e-3 / w, 2e-6 + 0 * w, 0 * w], axis=1))
    assert measurement.deviation_of(nothing) == pytest.approx(wanted)
    assert measurement.deviation_of(nothing[..., :2], runs=np.arange(2)) == pytest.approx(wanted[..., :2])
    fewer = measurement.of_channels([1, 3])
    assert fewer.deviation_of(nothing[:, [1, 3]]) == pytest.approx(wanted[:, [1, 3]])
    assert fewer.dataset.channels == tuple(measurement.dataset.channels[p] for p in (1, 3))


@pytest.mark.parametrize("floor", ["0.1", "-1 um", "3 kg", "1"])
def test_a_floor_has_the_unit_of_a_motion(floor: str) -> None:
    """A number alone says nothing."""
    with pytest.raises(ConfigError, match=r"must be a size in the probe's own quantity \(such as 0.1 m/s\^2"):
        compose_config(["experiment=mafaulda", f"++machine.recordings.probes.ax1.floor='{floor}'"], MACHINE)


def test_what_is_known_of_a_residual_unbalance_needs_its_planes() -> None:
    """It would be of no unknown."""
    with pytest.raises(ConfigError, match=r"known_unbalance must have unbalance_planes, the nodes where it acts"):
        compose_config(["experiment=mafaulda", "identify={unbalance_planes: [], known_unbalance: 300 g mm}"], MACHINE)


def test_a_floor_of_probes_is_noise_enough() -> None:
    """It is in the sentences; without it and without ``stated_noise`` there would be none."""
    alone = ["experiment=mafaulda", "stated_noise={additive: 0 um, multiplicative: 0}"]
    assert compose_config(alone, MACHINE).describe_noise().endswith("tell it, 0.1 m/s^2 noise)")
    probes = [f"++machine.recordings.probes.{name}.floor='0 um'" for name in ("tg1", "rad1", "tg2", "ax1")]
    with pytest.raises(ConfigError, match=r"part above zero, or a probe a floor, but there is none"):
        compose_config([*alone, *probes], MACHINE)
    at = "machine.probes.at=[{node: 1, angle: 0 deg, floor: 3 mm/s}, {node: 1, angle: 90 deg}, {node: 5, angle: 0 deg}]"
    config = compose_config(["experiment=noisy_all", "stated_noise.multiplicative=0.01", at])
    floors = configure_sensors(config, load_rotor(config.machine.rotor)).noise.floors
    assert (config.describe_noise(), floors) == ("1 % and 3 mm/s noise", ((0.0, 3e-3, 0.0), NO_FLOOR, NO_FLOOR))
