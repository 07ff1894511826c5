"""The digital twin (paper, Figure 5): vibration never seen, critical speeds, stability."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np

from pipeline.config.schema import Config
from pipeline.data.as_built import build_rotor, refine_nodes, stand_on_pedestals
from pipeline.data.dataset import Excitation, VibrationDataset
from pipeline.data.operating import name_state
from pipeline.data.tables import write_table
from pipeline.data.vibration_files import to_rpm
from pipeline.errors import ConfigError
from pipeline.files import write_json
from pipeline.identification.identified import IdentifiedModel
from pipeline.identification.uncertainty import Uncertainty, load_uncertainty
from pipeline.problem.measurement import Measurement
from pipeline.reporting.console import say, warn
from pipeline.reporting.twin_figures import draw_campbell, draw_orbit, draw_response, draw_time
from pipeline.reporting.twin_tables import print_twin, summarize_modes, tabulate_modes, tabulate_vibration
from pipeline.rotor.bearing_table import BearingTable
from pipeline.rotor.model import translation_dof
from pipeline.rotor.stored import load_modelled_bearings
from pipeline.stages.execution import StageOutput
from pipeline.stages.measurement import load_identified, load_measurement, load_modelled, update_measurement
from pipeline.stages.verdict import say_reservation
from pipeline.stages.workspace import locate_files, require_nodes
from pipeline.twin.at_conditions import (
    evaluate_at,
    mask_state,
    pick_middle,
    require_conditions,
    say_beyond,
    table_at,
)
from pipeline.twin.mode_deviations import Behaviour, describe_modes, deviate_modes
from pipeline.twin.modes import find_modes
from pipeline.twin.prediction import PredictedVibration, add_deviation, predict
from pipeline.twin.superposition import error_percent, superpose


@dataclass(frozen=True, eq=False)
class Twin:
    """The behaviour of the identified system, and of the modelled one where there is a truth, by the system's name."""

    identified: IdentifiedModel
    uncertainty: Uncertainty | None
    systems: Mapping[str, BearingTable]
    vibration: Mapping[str, PredictedVibration]  # under the unbalance that no run has
    behaviour: Mapping[str, Behaviour]
    at: int  # index of the prediction's speed
    operating: Mapping[str, float]  # the conditions of the prediction, SI; at each speed once


def build_twin(config: Config, measurement: Measurement) -> Twin:
    """The twin, training first where its model is missing. Raises ConfigError for an unbalance that a run has."""
    model = load_identified(config, measurement)
    uncertainty = load_uncertainty(locate_files(config).folder, model)
    operating = choose_operating(config, measurement.dataset)
    updated = update_measurement(measurement, uncertainty)
    points, identified = evaluate_at(model, updated, operating, OPERATING)
    modelled = load_truth(config, measurement, operating)
    nodes = [config.machine.prediction.node, *(unbalance.node for unbalance in config.machine.prediction.unbalances)]
    require_nodes(measurement.rotor, "machine.prediction", nodes)
    at = _find_speed(config, identified.speeds)
    unseen = list_unseen(config)
    if (run := find_same_run(unseen, measurement.dataset.excitations)) is not None:
        raise ConfigError(
            f"machine.prediction.unbalances must be an unbalance that training never saw, but run '{run}' is the same"
        )
    node, built = config.machine.prediction.node, config.machine.as_built
    systems = {"identified": identified} if modelled is None else {"modelled": modelled, "identified": identified}
    rotors = {"modelled": measurement.rotor, "identified": points.updated_rotor}
    vibration = {name: predict(rotors[name], system, unseen, node) for name, system in systems.items()}
    if modelled is not None and built is not None:  # the truth has nodes of its own
        rotors["modelled"] = build_rotor(config.machine.rotor, built)
        systems["modelled"], acting = stand_on_pedestals(modelled, built), refine_nodes(unseen, built)
        vibration["modelled"] = predict(rotors["modelled"], systems["modelled"], acting, built.refinement * node)
    if uncertainty is not None:
        vibration["identified"] = add_deviation(vibration["identified"], points, identified, unseen, model, uncertainty)
    behaviour = {name: describe_modes(find_modes(rotors[name], system)) for name, system in systems.items()}
    if uncertainty is not None:
        modes = behaviour["identified"].modes
        known_to = deviate_modes(modes, points, identified, model, uncertainty)
        behaviour["identified"] = describe_modes(modes, known_to)
    return Twin(model, uncertainty, systems, vibration, behaviour, at, operating)


OPERATING = "machine.prediction.operating"


def choose_operating(config: Config, dataset: VibrationDataset) -> dict[str, float]:
    """The conditions of the prediction, SI: the configured ones, or those in the middle of the measured ones.

    Empty for data without conditions. Raises ConfigError for a condition that is missing, or that the data lack.
    """
    given = config.machine.prediction.operating
    if not given:
        return pick_middle(dataset.operating)
    require_conditions(OPERATING, given, dataset.operating)
    return {name: given[name] for name in dataset.operating}


def load_truth(config: Config, measurement: Measurement, operating: Mapping[str, float]) -> BearingTable | None:
    """The modelled coefficients at the conditions of the prediction; None where nothing says them there."""
    modelled, dataset = load_modelled(config, measurement), measurement.dataset
    if modelled is None or not dataset.operating:
        return modelled
    mask = mask_state(dataset.operating, operating)
    speeds = np.unique(dataset.speeds)
    if np.array_equal(np.unique(dataset.speeds[mask]), speeds):
        return table_at(modelled, operating, OPERATING)
    if config.machine.recordings.format != "none":
        return None
    beside = {name: np.full(len(speeds), value) for name, value in operating.items()}
    return load_modelled_bearings(config.machine.rotor, config.machine.bearings, speeds, beside)


def run(config: Config) -> StageOutput:
    """``prediction.json``, ``prediction.csv``, ``modes.csv``, Figure 6 and the Campbell diagram."""
    measurement = load_measurement(config)
    twin = build_twin(config, measurement)
    vibration, at = dict(twin.vibration), twin.at
    running = config.machine.prediction.speed_rpm
    summary: dict[str, Any] = {name: summarize_modes(behaviour, running) for name, behaviour in twin.behaviour.items()}
    summary["reservation"] = say_reservation(config, measurement)
    beyond = say_beyond(measurement.dataset.operating, twin.operating)
    if twin.operating:
        summary |= {"operating": dict(twin.operating), "outside_measured": beyond}
    for text in beyond:
        warn(f"{config.name}: {text}: the bands grow there, and rest on the model of the coefficients alone")
    if "modelled" in vibration:
        error = vibration["identified"].error_percent(vibration["modelled"])
        summary["displacement"] = {
            direction: {"mean_error_percent": float(e.mean()), "max_error_percent": float(e.max())}
            for direction, e in zip("xy", error.T, strict=True)
        }
    summed = superpose_unseen(config, measurement, twin.operating)
    if summed is not None and "modelled" in vibration:
        truth = vibration["modelled"].displacement
        off = {direction: error_percent(summed[:, d], truth[:, d]) for d, direction in enumerate("xy")}
        summary["influence_coefficients"] = {"error_percent": off}
    print_twin(config, summary, vibration, at, twin.operating)
    _say_superposed(config, summed, summary, at)
    work = locate_files(config)
    written = [
        write_json(work.folder / "prediction.json", summary),
        write_table(work.folder / "prediction.csv", tabulate_vibration(vibration, twin.operating)),
        write_table(work.folder / "modes.csv", tabulate_modes(twin.behaviour, twin.operating)),
        draw_time(work.figure("prediction_time"), vibration, at, name_state(twin.operating)),
        draw_orbit(work.figure("prediction_orbit"), vibration, at, name_state(twin.operating)),
        draw_response(work.figure("prediction_response"), vibration, name_state(twin.operating)),
        draw_campbell(work.figure("campbell"), twin.behaviour, name_state(twin.operating)),
    ]
    return StageOutput(summary, {"data_fingerprint": measurement.dataset.fingerprint}, written)


def superpose_unseen(config: Config, measurement: Measurement, operating: Mapping[str, float]) -> np.ndarray | None:
    """(S, 2) complex, m: x and y of the prediction's node from the runs alone, without a bearing model.

    None where no sum of the runs is the unbalance, no probes show the node, or not all runs were measured at the
    conditions of the prediction, at every speed.
    """
    dataset, node = measurement.dataset, config.machine.prediction.node
    if dataset.operating:
        mask = mask_state(dataset.operating, operating)
        mask &= dataset.present.all(axis=1)
        if not np.array_equal(dataset.speeds[mask], np.unique(dataset.speeds)):
            return None
        dataset = dataset.at(mask)
    dof, resolution = dataset.resolution()
    rows = [np.flatnonzero(dof == translation_dof(node, direction)) for direction in range(2)]
    runs = range(len(dataset.runs))
    summed = superpose(dataset, runs, list_unseen(config), dataset.speeds, bool(measurement.unknowns.planes))
    if summed is None or not all(len(row) for row in rows):
        return None
    return summed @ resolution[np.concatenate(rows)].T


def _say_superposed(config: Config, summed: np.ndarray | None, summary: Mapping[str, Any], at: int) -> None:
    beside = f"{config.name}: influence coefficients (sums of the runs, without a bearing model)"
    if summed is None:
        conditions = ", or not all runs were measured at these conditions" if "operating" in summary else ""
        say(f"{beside} have no answer: the unbalance is no sum of the runs', or no probes show the node{conditions}")
        return
    size, error = 1e6 * np.abs(summed[at]), summary.get("influence_coefficients", {}).get("error_percent", {})
    off = ", ".join(f"{direction} {percent:.2g} %" for direction, percent in error.items())
    shown = f"x {size[0]:.5f} um, y {size[1]:.5f} um at {config.machine.prediction.speed_rpm:g} rpm"
    say(f"{beside}: {shown}" + (f"; error over all speeds (root mean square) {off}" if off else ""))


def _find_speed(config: Config, speeds: np.ndarray) -> int:
    rpm, wanted = to_rpm(speeds), config.machine.prediction.speed_rpm
    nearest = int(np.abs(rpm - wanted).argmin())
    if abs(rpm[nearest] - wanted) > _SAME_SPEED * wanted:
        raise ConfigError(
            "machine.prediction.speed_rpm must be one of the data's speeds (known coefficients are given there), but "
            f"got {wanted:g}: the nearest is {rpm[nearest]:g}"
        )
    return nearest


_SAME_SPEED = 1e-3
"""A share: nominal speeds of records are means with many digits."""


def list_unseen(config: Config) -> tuple[Excitation, ...]:
    """The unbalances that the twin is judged by, as one run."""
    return tuple(
        Excitation("prediction", "unbalance", u.node, u.magnitude, u.phase)
        for u in config.machine.prediction.unbalances
    )


def find_same_run(unseen: tuple[Excitation, ...], seen: tuple[Excitation, ...]) -> str | None:
    """The run of ``seen`` whose excitation is ``unseen``; None where training never saw it."""

    def shape(forces: list[Excitation]) -> set[tuple[object, ...]]:
        return {(e.kind, e.node, e.magnitude, e.phase, e.whirl) for e in forces}

    runs = dict.fromkeys(e.run for e in seen)
    return next((run for run in runs if shape([e for e in seen if e.run == run]) == shape(list(unseen))), None)
