"""Run-ups whose oil warms, each by its own temperatures: from an instrument's tables to clearances and viscosity."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pandas as pd
import pytest
from measured_files import PAIR, Vectors, probes_config, table_config, wide
from running import composed

from pipeline.config.compose import compose_mapping, validate
from pipeline.config.schema import Config
from pipeline.data.sensors import list_directions, measure
from pipeline.data.simulate import simulate
from pipeline.files import read_json
from pipeline.problem.configured import configure_excitations, configure_sensors
from pipeline.rotor.stored import load_modelled_bearings, load_rotor
from pipeline.stages import ingest, train
from pipeline.stages.analysis import Analysis
from pipeline.units import RAD_S_PER_RPM

pytestmark = pytest.mark.slow
OVERRIDES = ["experiment=oil_temperatures", "tracking=none"]
RPM = np.arange(600.0, 4001.0, 100.0)


def record(folder: Path) -> Config:
    """Tables of three run-ups, the oil a few kelvin warmer in each, and the log of its temperature."""
    config = composed(*OVERRIDES)
    machine, speeds = config.machine, RPM * RAD_S_PER_RPM
    rotor, acting = load_rotor(machine.rotor), configure_excitations(config)
    probes = {
        f"{node}{axis}": (node, angle) for (node, angle), axis in zip(list_directions((8, 21)), "xyxy", strict=True)
    }
    log, runs = [], []
    for r, run in enumerate(machine.runs):
        celsius = 40 + 3 * r + 20 * ((RPM - 600) / 3400) ** 0.7
        bearings = load_modelled_bearings(
            machine.rotor, machine.bearings, speeds, {"oil_temperature": celsius + 273.15}
        )
        seen = simulate(rotor, replace(bearings, operating={}), tuple(one for one in acting if one.run == run.name))
        seen = measure(seen, configure_sensors(config, rotor), np.random.default_rng(r))
        of = {name: seen.displacement[:, seen.channels.index(place), 0] for name, place in probes.items()}
        wide(Vectors(RPM, of)).to_csv(folder / f"{run.name}.csv", index=False)
        log.append(pd.DataFrame({"run": run.name, "speed_rpm": RPM, "oil_temperature_degC": celsius}))
        weights = [{"node": u.node, "magnitude": u.magnitude, "phase": u.phase} for u in run.unbalances]
        runs.append({"name": run.name, "file": str(folder / f"{run.name}.csv"), "unbalances": weights})
    pd.concat(log).to_csv(folder / "oil.csv", index=False)
    mapping, places = compose_mapping([*OVERRIDES, f"output={folder / 'out'}"]), probes_config(probes, **PAIR)
    mapping["machine"]["recordings"] = table_config(runs, probes=places, conditions_file=str(folder / "oil.csv"))
    return validate(mapping)


def test_clearances_and_oil_from_run_ups_whose_oil_warms(tmp_path: Path) -> None:
    """No point is in two runs, and the truth of the machine is in four deviations of what is found."""
    config = record(tmp_path)
    ingest.run(Analysis(config))
    assert read_json(tmp_path / "out" / "ingest.json")["operating"] == {"oil_temperature_degC": [40.0, 66.0]}
    train.run(Analysis(config))
    told = read_json(tmp_path / "out" / "training.json")
    found = {name: (one["value"], one["deviation"]) for name, one in told["physical_numbers"].items()}
    truth = {
        "oil.viscosity": 27.7e-3 * np.exp(-0.034 * 15),
        "oil.slope": 0.034,
        "8.radial_clearance": 0.1e-3,
        "21.radial_clearance": 0.085e-3,
    }
    for name, true in truth.items():
        value, deviation = found[name]
        assert abs(value - true) < 4 * deviation, name
        assert deviation < 0.02 * true
