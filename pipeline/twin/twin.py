"""The digital twin of a machine: what it does where nobody measured, beside the truth where the machine is modelled.

Legend: S speeds, B bearings.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np

from pipeline.config.machine import MachineConfig
from pipeline.config.runs import find_frequencies
from pipeline.data.dataset import Excitation, VibrationDataset
from pipeline.data.excitation_files import run_excitations
from pipeline.data.vibration_files import place_speed
from pipeline.errors import ConfigError, PipelineError
from pipeline.identification.identified import Answer
from pipeline.parameters.as_built import build_rotor, refine_nodes, stand_on_pedestals
from pipeline.problem.measurement import Measurement
from pipeline.rotor.bearing_table import BearingTable
from pipeline.rotor.model import translation_dof
from pipeline.rotor.stored import load_modelled_bearings, require_nodes
from pipeline.twin.at_conditions import evaluate_at, mask_state, pick_middle, require_conditions, table_at
from pipeline.twin.mode_deviations import Behaviour, deviate_modes
from pipeline.twin.modes import find_modes, read_modes
from pipeline.twin.prediction import PredictedVibration, add_deviation, find_shares, predict

OPERATING = "machine.prediction.operating"


@dataclass(frozen=True, eq=False)
class Twin:
    """The behaviour of the identified system, and of the modelled one where there is a truth, by the system's name."""

    systems: Mapping[str, BearingTable]
    vibration: Mapping[str, PredictedVibration]  # under the unbalance that no run has
    behaviour: Mapping[str, Behaviour]
    at: int  # index of the prediction's speed
    operating: Mapping[str, float]  # the conditions of the prediction, SI; at each speed once


def plan_twin(machine: MachineConfig, measurement: Measurement) -> tuple[dict[str, float], np.ndarray, int]:
    """What the prediction asks of a measurement, before any fit: its conditions, the speeds (S,) in rad/s, which are
    those of the data with its own among them, and the index of that.

    Raises ConfigError for conditions, nodes or a speed that the machine lacks, and for an unbalance that a run has.
    """
    dataset, unseen, asked = measurement.dataset, run_excitations(machine.prediction), machine.prediction
    operating = asked.operating or pick_middle(dataset.operating)
    require_conditions(OPERATING, operating, dataset.operating)
    operating = {name: operating[name] for name in dataset.operating}
    require_nodes(measurement.rotor, "machine.prediction", [asked.node, *(unbalance.node for unbalance in unseen)])
    speeds, at = place_speed(asked.speed_rpm, np.unique(dataset.speeds))
    alike = np.isclose(dataset.frequencies, find_frequencies(asked, dataset.speeds)[:, None]).any(axis=0)
    if (run := find_same_run(unseen, dataset.of_runs(np.flatnonzero(alike)))) is not None:
        raise ConfigError(
            f"machine.prediction.{'unbalances' if asked.unbalances else 'forces'} must be {asked.what} that training "
            f"never saw, but run '{run}' is the same"
        )
    return operating, speeds, at


def build_twin(machine: MachineConfig, answer: Answer, modelled: BearingTable | None) -> Twin:
    """The twin at the conditions of the prediction; ``modelled`` are the true coefficients at the points of the data.

    Raises ConfigError as :func:`plan_twin`, and for conditions that nothing says the coefficients at.
    """
    stated, unseen, node = answer.measurement, run_excitations(machine.prediction), machine.prediction.node
    operating, speeds, at = plan_twin(machine, stated)
    points, identified = evaluate_at(answer.model, stated, operating, OPERATING, speeds)
    truth, w = _truth_at(machine, stated, modelled, operating, speeds), find_frequencies(machine.prediction, speeds)
    highest = float(stated.dataset.frequencies.max())
    made: dict[str, tuple[BearingTable, PredictedVibration, Behaviour]] = {}
    if truth is not None:
        rotor, acting, place = stated.rotor, unseen, node
        if built := machine.as_built:  # which has nodes of its own
            rotor, truth, acting = (
                build_rotor(machine.rotor, built),
                stand_on_pedestals(truth, built),
                refine_nodes(unseen, built),
            )
            place = built.refinement * node
        behaviour = Behaviour(find_modes(rotor, truth, highest=highest))
        made["modelled"] = truth, predict(rotor, truth, acting, place, w), behaviour
    vibration = predict(points.updated_rotor, identified, unseen, node, w)
    modes, deviations = find_modes(points.updated_rotor, identified, highest=highest), None
    if answer.uncertainty is not None:
        vibration = add_deviation(vibration, points, identified, unseen, answer.uncertainty)
        deviations = deviate_modes(modes, points, identified, answer.uncertainty)
    behaviour = Behaviour(modes, deviations, read_modes(stated.dataset, stated.deviation, modes))
    made["identified"] = identified, vibration, behaviour
    return Twin(
        systems={name: table for name, (table, _, _) in made.items()},
        vibration={name: predicted for name, (_, predicted, _) in made.items()},
        behaviour={name: behaviour for name, (_, _, behaviour) in made.items()},
        at=at,
        operating=operating,
    )


def _truth_at(
    machine: MachineConfig,
    measurement: Measurement,
    modelled: BearingTable | None,
    operating: Mapping[str, float],
    speeds: np.ndarray,
) -> BearingTable | None:
    """The modelled coefficients at the conditions and ``speeds`` (S,) of the prediction; None where nothing says them
    there."""
    dataset = measurement.dataset
    if modelled is None:
        return None
    if np.array_equal(np.unique(dataset.speeds[mask_state(dataset.operating, operating)]), speeds):
        return table_at(modelled, operating, OPERATING)
    if machine.recordings.recorded and operating:
        return None
    beside = {name: np.full(len(speeds), value) for name, value in operating.items()}
    return load_modelled_bearings(machine.rotor, machine.bearings, speeds, beside)


def superpose_unseen(machine: MachineConfig, measurement: Measurement, twin: Twin) -> np.ndarray | str:
    """(S, 2) complex, m: x and y of the prediction's node from the runs alone, without a bearing model.

    Why not, where no sum of the runs is the unbalance, no probes show the node, or not all runs were measured at the
    conditions of the prediction, at every speed of the ``twin``.
    """
    dataset, node = measurement.dataset, machine.prediction.node
    mask = mask_state(dataset.operating, twin.operating) & dataset.present.all(axis=1)
    if not np.array_equal(dataset.speeds[mask], twin.systems["identified"].speeds):
        return f"not all runs were measured at {'these conditions and speeds' if twin.operating else 'these speeds'}"
    dataset = dataset.at(mask)
    dof, resolution = dataset.resolution()
    rows = [np.flatnonzero(dof == translation_dof(node, direction)) for direction in range(2)]
    runs = range(len(dataset.runs))
    w = find_frequencies(machine.prediction, dataset.speeds)
    shares = find_shares(dataset, runs, run_excitations(machine.prediction), w, bool(measurement.unknowns.planes))
    if not all(len(row) for row in rows):
        return f"no probes show x and y of node {node}"
    if shares is None:
        return "the unbalance is no sum of the runs' unbalances"
    return (dataset.displacement @ shares) @ resolution[np.concatenate(rows)].T


def find_same_run(unseen: tuple[Excitation, ...], seen: VibrationDataset) -> str | None:
    """The run of ``seen`` whose excitation is ``unseen``; None where training never saw it."""
    wanted = {replace(excitation, run="") for excitation in unseen}
    return next((run for r, run in enumerate(seen.runs) if set(seen.excitation_of(r)) == wanted), None)


def measure_unseen(
    machine: MachineConfig, measurement: Measurement, answers: Sequence[BearingTable], modelled: BearingTable | None
) -> float | None:
    """Error of the vibration never seen, percent: the mean over speed, of the worst answer and direction.

    None without a truth, and where this rotor lacks the prediction's nodes, a run has the very unbalance, or an answer
    is not finite.
    """
    unseen, node, rotor = run_excitations(machine.prediction), machine.prediction.node, measurement.rotor
    lacks = max(node, *(force.node for force in unseen)) >= rotor.n_places
    if modelled is None or lacks or find_same_run(unseen, measurement.dataset) is not None:
        return None
    if not all(np.isfinite(answer.values).all() for answer in answers):
        return None
    try:
        asked = unseen, node, find_frequencies(machine.prediction, modelled.speeds)
        true = predict(rotor, modelled, *asked)
        errors = [predict(rotor, answer, *asked).error_percent(true).mean(axis=0).max() for answer in answers]
    except PipelineError:  # a diverged start may have a singular machine
        return None
    worst = float(max([0.0, *errors]))
    return worst if np.isfinite(worst) else None
