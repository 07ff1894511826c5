"""The measurement of an experiment, and what was identified from it, from their files."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from pipeline.config.schema import Config
from pipeline.data.coefficient_files import read_coefficients
from pipeline.data.dataset import VibrationDataset
from pipeline.data.tables import read_marks
from pipeline.data.vibration_files import read_measured, require_made_for, require_nodes_of
from pipeline.errors import DataError
from pipeline.files import read_json
from pipeline.identification.fit import loss_of
from pipeline.identification.identified import Answer
from pipeline.identification.storage import load_answer
from pipeline.identification.training import setup_of
from pipeline.problem.configured import build_measurement, list_known, load_known, require_known
from pipeline.problem.diagnosis import Diagnosis
from pipeline.problem.measurement import Measurement
from pipeline.rotor.bearing_table import BearingTable
from pipeline.rotor.stored import load_rotor, require_nodes
from pipeline.stages.analysis import Analysis, hash_machine, hash_origin, made_once


def load_measurement(config: Config) -> Measurement:
    """Read the measurement of an experiment, generating it first where it is missing.

    Mistakes in the files are told before ROSS is needed, wherever the configuration itself says the rotor's nodes.

    Raises DataError for files that break their laws, or that were generated from another configuration.
    """
    analysis, section = Analysis(config), config.machine.rotor
    _require_data(analysis, *([analysis.known] if config.data.known is None else []))
    if analysis.own:
        _require_generated_from(analysis)
    dataset = load_dataset(config)
    if section.file is None:
        known = _read_known(analysis, section.bearing_nodes, dataset)
        rotor = load_rotor(section)
    else:  # which says itself how many nodes there are, and where the bearings stand
        rotor = load_rotor(section)
        require_nodes_of(dataset, rotor, analysis.vibration, analysis.excitation)
        known = _read_known(analysis, rotor.bearing_nodes, dataset)
    require_made_for(analysis.vibration, rotor)
    require_nodes(rotor, "identify.unbalance_planes", config.identify.unbalance_planes)
    return build_measurement(config, rotor, dataset, known)


def load_dataset(config: Config) -> VibrationDataset:
    """Read the readings alone, as they are in the file: every record of a condition is a run of its own.

    Raises DataError for files that break their laws.
    """
    analysis, section = Analysis(config), config.machine.rotor
    _require_data(analysis)
    # Conditions of the experiment's own files were joined when they were written.
    same = None if analysis.own else config.data.same_conditions
    n_nodes = section.n_nodes if section.file is None else None
    return read_measured(
        analysis.vibration, analysis.excitation, config.data.baseline, n_nodes, same, section.n_casings
    )


def _require_data(analysis: Analysis, *beside: Path) -> None:
    """Make the experiment's own data where they, or files ``beside`` them, are missing."""
    if analysis.own:
        analysis.require(analysis.config.machine.recordings.made_by, analysis.vibration, analysis.excitation, *beside)


def _read_known(analysis: Analysis, nodes: tuple[int, ...], dataset: VibrationDataset) -> BearingTable:
    """From ``data.known``, or as the experiment's own data were made. Raises ConfigError where nothing gives them."""
    config, given = analysis.config, analysis.config.data.known
    if given is None and analysis.own and analysis.known.exists():
        return read_coefficients(analysis.known, nodes, dataset.speeds, list_known(config, nodes), dataset.operating)
    known = load_known(config, given, "data.known", nodes, dataset.speeds, dataset.operating)
    return require_known(known, config, nodes)


def _require_generated_from(analysis: Analysis) -> None:
    made_from = (read_marks(analysis.vibration) or {}).get("origin")
    if made_from is not None and made_from.split(" ")[0] != hash_machine(analysis.config):
        raise DataError(
            f"'{analysis.vibration}' must have been generated from the configured machine, but it has "
            "changed since: run stage=generate with the same overrides first, or choose another folder "
            "with output=FOLDER"
        )
    if made_from not in (None, hash_origin(analysis)):
        raise DataError(
            f"'{analysis.vibration}', '{analysis.excitation}' and '{analysis.known}' must come from one "
            "stage=generate, but they do not belong together: run it again, or give files of your own as "
            "data.vibration=... and data.excitation=..."
        )


# --- what an analysis makes of it, each once -----------------------------------------------------------

AGAIN = "train again with stage=train"
_DATA = ("vibration", "excitation", "known")
ANSWER = (*_DATA, "training")
"""Files that whatever follows from a fit is made from."""


@made_once(*_DATA)
def prepare(analysis: Analysis) -> Measurement:
    """:func:`load_measurement`."""
    return load_measurement(analysis.config)


@made_once(*_DATA)
def diagnose(analysis: Analysis) -> Diagnosis:
    """What the data determine, by the configured loss. Raises DataError for sensors that do not suffice."""
    setup = setup_of(analysis.config)
    return loss_of(setup.loss).diagnose(prepare(analysis), setup)


@made_once(*_DATA)
def expect(analysis: Analysis) -> BearingTable:
    """The deviations that the stated noise will leave to the configured fit."""
    setup = setup_of(analysis.config)
    return loss_of(setup.loss).expect(prepare(analysis), setup, diagnose(analysis))


@made_once(*ANSWER)
def restore(analysis: Analysis) -> Answer:
    """What was identified, training first where it is missing. Raises DataError where other data trained it."""
    measurement = prepare(analysis)
    analysis.require("train", *analysis.model, analysis.training, analysis.history)
    return load_answer(analysis.folder, analysis.config.identify, measurement)


# --- what was identified, and the truth ------------------------------------------------------------


QUALITY = ("fit", "residual", "condition_number", "determined", "physical_numbers", "law", "correction")
"""``training.json`` holds these: parts of :class:`pipeline.identification.quality.Quality`, and the verdicts."""


def load_quality(config: Config) -> dict[str, Any]:
    """Read how well the fit explains its readings. Raises DataError where ``training.json`` does not say it."""
    path = Analysis(config).training
    written = read_json(path, AGAIN)
    quality = {name: written[name] for name in QUALITY if name in written}
    if not quality:
        raise DataError(f"'{path}' must say how well the fit explains its readings, but it does not: train again")
    return quality


def load_modelled(config: Config, measurement: Measurement) -> BearingTable | None:
    """The truth of modelled data; None where there is none, as with measured data."""
    analysis = Analysis(config)
    if not analysis.own or not analysis.modelled.exists():
        return None
    nodes, dataset = measurement.rotor.bearing_nodes, measurement.dataset
    return read_coefficients(analysis.modelled, nodes, dataset.speeds, operating=dataset.operating)
