"""The folder ``export``: the answer at each state in every format that is asked for."""

from __future__ import annotations

import itertools
import json
from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np

from pipeline.coefficients import COEFFICIENTS
from pipeline.config.schema import Config
from pipeline.data.dataset import VibrationDataset
from pipeline.data.operating import split_states
from pipeline.data.tables import write_table
from pipeline.export.coefficients import Document, Exported, Number, document, list_conventions, tabulate
from pipeline.export.programs import write_ansys_file, write_apdl, write_dyrobes, write_workbook
from pipeline.files import write_json, write_text
from pipeline.identification.restored import Answer
from pipeline.problem.measurement import Measurement
from pipeline.rotor.bearing_table import BearingTable
from pipeline.twin.at_conditions import evaluate_at, require_conditions
from pipeline.twin.prediction import predict
from pipeline.twin.twin import list_unseen


def list_states(config: Config, dataset: VibrationDataset) -> list[dict[str, float]]:
    """The conditions (SI) of each state that is written: the configured ones, or the measured ones by their means.

    One without conditions for data that have none. Raises ConfigError for a condition that is missing, or that the
    data lack.
    """
    for given in config.export.operating:
        require_conditions(_KEY, given, dataset.operating)
    if config.export.operating:
        return [{name: given[name] for name in dataset.operating} for given in config.export.operating]
    measured = split_states(dataset.speeds, dataset.operating)
    return [
        {name: float(np.mean(values[points])) for name, values in dataset.operating.items()} for _, points in measured
    ]


_KEY = "export.operating"


def export_at(config: Config, answer: Answer, operating: Mapping[str, float]) -> Exported:
    """The answer at one state, at each speed of the data."""
    table = evaluate_at(answer.model, answer.measurement, operating, _KEY)[1]
    identified = answer.model.unknowns.identified
    return Exported(config.name, table, answer.deviation(table), identified, config.export.units, operating)


def write_exports(
    folder: Path,
    config: Config,
    updated: Measurement,
    states: Sequence[Exported],
    numbers: Sequence[Number],
    reservation: str,
) -> list[str]:
    """Every format that is asked for; what there is to say of them. ``updated`` is at the fitted model parameters.

    A ``reservation`` stands in the conventions, and in a file whose name nobody overlooks.
    """
    formats, notes = config.export.formats, []
    warning = [reservation] if reservation else []
    write_text(folder / "conventions.txt", "\n".join([*warning, *list_conventions(states)]) + "\n")
    if reservation:
        write_text(folder / "MODEL_REJECTED.txt", reservation + "\n")
    if "csv" in formats:
        write_table(folder / "coefficients.csv", tabulate(*states))
        if numbers:
            write_table(folder / "physical_numbers.csv", [number.model_dump() for number in numbers])
    if "excel" in formats:
        write_workbook(folder / "coefficients.xlsx", *states, numbers=numbers)
    if "json" in formats:
        write_json(folder / "coefficients.json", document(*states, numbers=numbers).model_dump(mode="json"))
        write_text(folder / "coefficients.schema.json", json.dumps(Document.model_json_schema(), indent=2) + "\n")
    for exported, (b, node) in itertools.product(states, enumerate(states[0].table.nodes)):
        name = f"node_{node}{exported.suffix}"
        if "dyrobes" in formats:
            write_text(folder / f"dyrobes_{name}.txt", write_dyrobes(exported, b))
        if "ansys" in formats:
            write_text(folder / f"ansys_{name}.txt", write_ansys_file(exported, b))
            write_text(folder / f"ansys_{name}.inp", write_apdl(exported, b))
    if "ross" in formats:
        notes.append(_write_ross(folder, config, updated, states))
    return notes


def _write_ross(folder: Path, config: Config, updated: Measurement, states: Sequence[Exported]) -> str:
    """The rotor and each bearing, a file a state, and their deviations; how far ROSS's smoothing moves the response."""
    from pipeline.rotor.ross_export import export_rotor, make_bearings, read_table

    rotor, off = config.machine.rotor, []
    for exported in states:
        made = export_rotor(rotor, updated.parameters, updated.parameter_values, exported.table)
        made.save(folder / f"rotor{exported.suffix}.toml")
        elements = make_bearings(exported.table)
        for element in elements:
            element.save(folder / f"bearing_node_{element.n}{exported.suffix}.toml")
        off.append(_compare(config, updated, exported.table, read_table(elements, exported.table.speeds)))
    if states[0].deviation is not None:
        columns = tabulate(*(replace(state, units="si") for state in states))
        write_table(folder / "deviations.csv", {k: v for k, v in columns.items() if k not in COEFFICIENTS})
    every = zip(updated.rotor.bearing_nodes, updated.updated_rotor.bearing_shifts, strict=False)
    beside = "".join(
        f"; the fit places the bearing of node {node} {1e3 * shift:+.3g} mm along the shaft, which 'rotor.toml' lacks"
        for node, shift in every
    )
    files = " and ".join(f"'rotor{state.suffix}.toml'" for state in states[:3]) + (", ..." if len(states) > 3 else "")
    return (
        f"{files} {'is' if len(states) == 1 else 'are'} for ross.Rotor.load; ROSS smooths tables over the speed, which "
        f"moves the response to the prediction's unbalance by at most {max(off):.1g} %{beside}"
    )


def _compare(config: Config, updated: Measurement, table: BearingTable, smoothed: BearingTable) -> float:
    """The largest difference of the two responses at the prediction's node, percent."""
    unseen, node = list_unseen(config.machine), config.machine.prediction.node
    predicted, other = (predict(updated.updated_rotor, bearings, unseen, node) for bearings in (table, smoothed))
    return float(np.max(other.error_percent(predicted)))
