"""The measurement of an experiment, and what was identified from it, from their files."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np

from pipeline.config.schema import Config
from pipeline.data.coefficient_files import read_coefficients
from pipeline.data.conditions import gather_conditions
from pipeline.data.dataset import VibrationDataset, require_synchronous
from pipeline.data.noise import NoiseModel
from pipeline.data.tables import read_marks
from pipeline.data.vibration_files import read_measured, require_made_for, require_nodes_of
from pipeline.errors import DataError
from pipeline.files import hash_file, read_json
from pipeline.identification.identified import IdentifiedModel
from pipeline.identification.storage import ARCHITECTURE, WEIGHTS, load_model
from pipeline.identification.uncertainty import UNCERTAINTY, Uncertainty
from pipeline.laws.build import make_laws
from pipeline.laws.law_set import NO_LAWS, LawSet
from pipeline.problem.condition_noise import NO_LEVELS, condition_noise, suffices, to_dataset
from pipeline.problem.measurement import Guess, Measurement
from pipeline.problem.model_parameters import model_parameters, usual_tolerances
from pipeline.rotor.bearing_table import BearingTable
from pipeline.rotor.model import RotorModel
from pipeline.rotor.stored import load_rotor
from pipeline.stages.execution import make_missing
from pipeline.stages.known import load_known, require_known
from pipeline.stages.workspace import (
    Workspace,
    hash_machine,
    hash_origin,
    list_known,
    locate_files,
    require_nodes,
)


def load_measurement(config: Config) -> Measurement:
    """Read the measurement of an experiment, generating it first where it is missing.

    Mistakes in the files are told before ROSS is needed, wherever the configuration itself says the rotor's nodes.

    Raises DataError for files that break their laws, or that were generated from another configuration.
    """
    files = locate_files(config)
    if files.own:
        source = "generate" if config.machine.recordings.format == "none" else "ingest"
        known_files = [files.known] if config.data.known is None else []
        make_missing(config, source, files.vibration, files.excitation, *known_files)
        _require_generated_from(config, files)
    # A rotor file says itself how many nodes there are, and where the bearings stand.
    n_nodes = config.machine.rotor.n_nodes if config.machine.rotor.file is None else None
    dataset = _read_measured(config, files, n_nodes)
    if n_nodes is not None:
        known = _read_known(config, files, config.machine.rotor.bearing_nodes, dataset)
        rotor = load_rotor(config.machine.rotor)
    else:
        rotor = load_rotor(config.machine.rotor)
        require_nodes_of(dataset, rotor.n_nodes, files.vibration, files.excitation)
        known = _read_known(config, files, rotor.bearing_nodes, dataset)
    require_made_for(files.vibration, rotor)
    require_nodes(rotor, "identify.unbalance_planes", config.identify.unbalance_planes)
    return build_measurement(config, rotor, dataset, known)


def load_dataset(config: Config) -> VibrationDataset:
    """Read the readings alone, as they are in the file: every record of a condition is a run of its own.

    Raises DataError for files that break their laws.
    """
    files = locate_files(config)
    if files.own:
        source = "generate" if config.machine.recordings.format == "none" else "ingest"
        make_missing(config, source, files.vibration, files.excitation)
    n_nodes = config.machine.rotor.n_nodes if config.machine.rotor.file is None else None
    return _read_measured(config, files, n_nodes)


def _read_measured(config: Config, files: Workspace, n_nodes: int | None) -> VibrationDataset:
    # Conditions of the experiment's own files were joined when they were written.
    same = None if files.own else config.data.same_conditions
    return read_measured(files.vibration, files.excitation, config.data.baseline, n_nodes, same)


def build_measurement(config: Config, rotor: RotorModel, dataset: VibrationDataset, known: BearingTable) -> Measurement:
    """The measurement that a configuration asks about, from data that are at hand."""
    require_synchronous(rotor, dataset)
    noise, model, identify = config.stated_noise, config.model, config.identify
    stated, drift = NoiseModel(noise.additive, noise.multiplicative, noise.drift), NO_LEVELS
    if dataset.conditions is not None:
        conditions = gather_conditions(dataset)
        if suffices(conditions):
            drift = condition_noise(conditions, stated)
        else:
            stated = stated.with_drift()
        dataset = to_dataset(conditions)
    unknowns, stated_numbers = identify.unknowns_of(rotor.bearing_nodes), identify.model_parameters.deviations
    return Measurement(
        rotor,
        dataset,
        known,
        stated,
        unknowns,
        Guess(model.initial_stiffness, model.initial_damping, identify.known_within),
        drift=drift,
        laws=_laws_of(config, rotor),
        parameters=model_parameters(stated_numbers, rotor, dataset, known, unknowns, identify.coupling_node),
        tolerances=usual_tolerances(stated_numbers, rotor, dataset, known, unknowns)
        if identify.usual_tolerances
        else (),
    )


def _laws_of(config: Config, rotor: RotorModel) -> LawSet:
    """The bearing laws of the machine, which some models are made of."""
    return NO_LAWS if config.machine.laws is None else make_laws(config.machine.laws, rotor.bearing_nodes)


def _read_known(config: Config, files: Workspace, nodes: tuple[int, ...], dataset: VibrationDataset) -> BearingTable:
    """From ``data.known``, or as the experiment's own data were made. Raises ConfigError where nothing gives them."""
    given = config.data.known
    if given is None and files.own and files.known.exists():
        return read_coefficients(files.known, nodes, dataset.speeds, list_known(config, nodes), dataset.operating)
    known = load_known(config, given, "data.known", nodes, dataset.speeds, dataset.operating)
    return require_known(known, config, nodes)


def _require_generated_from(config: Config, files: Workspace) -> None:
    made_from = (read_marks(files.vibration) or {}).get("origin")
    if made_from is not None and made_from.split(" ")[0] != hash_machine(config):
        raise DataError(
            f"'{files.vibration}' must have been generated from the configured machine, but it has "
            "changed since: run stage=generate with the same overrides first, or choose another folder "
            "with output=FOLDER"
        )
    if made_from not in (None, hash_origin(config, files)):
        raise DataError(
            f"'{files.vibration}', '{files.excitation}' and '{files.known}' must come from one stage=generate, but "
            "they do not belong together: run it again, or give files of your own as data.vibration=... and "
            "data.excitation=..."
        )


# --- what was identified, and the truth ------------------------------------------------------------


def load_identified(config: Config, measurement: Measurement) -> IdentifiedModel:
    """The trained model, training first where it is missing. Raises DataError where other data trained it."""
    work = locate_files(config)
    model_files = [work.folder / name for name in (WEIGHTS, ARCHITECTURE, UNCERTAINTY)]
    make_missing(config, "train", *model_files, work.training, work.history)
    about = read_json(work.training)
    identified = load_model(work.folder)
    laws = {
        "the data at hand": about.get("data_fingerprint") == measurement.dataset.fingerprint,
        "the model beside it": about.get("model") == " ".join(hash_file(path) for path in model_files),
        f"the bearings at nodes {list(measurement.rotor.bearing_nodes)}": identified.bearing_nodes
        == measurement.rotor.bearing_nodes,
        f"the unknowns {', '.join(config.identify.named())}": _match_unknowns(config, identified),
        "identify.model_parameters": _list_priors(about) == [[p.name, p.deviation] for p in measurement.parameters],
    }
    for law, holds in laws.items():
        if not holds:
            raise DataError(
                f"'{work.training}' must belong to {law}, but it does not: run stage=train with the same overrides"
            )
    return identified


def update_measurement(measurement: Measurement, uncertainty: Uncertainty | None) -> Measurement:
    """The measurement at the model parameters that a fit found; as it is where there is none."""
    return measurement if uncertainty is None else measurement.update(uncertainty.parameters)


def _list_priors(about: Mapping[str, Any]) -> list[list[Any]]:
    return [[name, entry["prior_deviation"]] for name, entry in about.get("model_parameters", {}).items()]


def _match_unknowns(config: Config, identified: IdentifiedModel) -> bool:
    wanted, trained = config.identify.unknowns_of(identified.bearing_nodes), identified.unknowns
    order = [trained.names.index(name) for name in wanted.names] if set(wanted.names) == set(trained.names) else []
    return bool(order) and np.array_equal(wanted.expansion, trained.expansion[..., order])


QUALITY = ("fit", "residual", "condition_number", "determined", "physical_numbers", "law", "correction")
"""``training.json`` holds these: parts of :class:`pipeline.identification.quality.Quality`, and the verdicts."""


def load_quality(config: Config) -> dict[str, Any]:
    """Read how well the fit explains its readings. Raises DataError where ``training.json`` does not say it."""
    path = locate_files(config).training
    written = read_json(path, "train again with stage=train")
    quality = {name: written[name] for name in QUALITY if name in written}
    if not quality:
        raise DataError(f"'{path}' must say how well the fit explains its readings, but it does not: train again")
    return quality


def load_modelled(config: Config, measurement: Measurement) -> BearingTable | None:
    """The truth of modelled data; None where there is none, as with measured data."""
    work = locate_files(config)
    if not work.own or not work.modelled.exists():
        return None
    nodes, dataset = measurement.rotor.bearing_nodes, measurement.dataset
    return read_coefficients(work.modelled, nodes, dataset.speeds, operating=dataset.operating)
