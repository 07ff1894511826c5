"""The measurement of an experiment, from its files."""

from __future__ import annotations

from pipeline.config.schema import Config
from pipeline.data.coefficient_files import read_coefficients
from pipeline.data.dataset import VibrationDataset
from pipeline.data.noise import NoiseModel
from pipeline.data.tables import read_marks
from pipeline.data.vibration_files import read_measured, require_made_for, require_nodes_of
from pipeline.errors import DataError
from pipeline.problem.measurement import Guess, Measurement
from pipeline.rotor.bearing_table import BearingTable
from pipeline.rotor.model import RotorModel
from pipeline.rotor.stored import load_rotor
from pipeline.stages.execution import make_missing
from pipeline.stages.nodes import known_coefficients, require_nodes
from pipeline.stages.workspace import InputFiles, input_files, origin, origin_of_files


def load_measurement(config: Config) -> Measurement:
    """Read the measurement of an experiment, generating it first where it is missing.

    Mistakes in the files are told before ROSS is needed, wherever the configuration itself says the rotor's nodes.

    Raises DataError for files that break their laws, or that were generated from another configuration.
    """
    files = input_files(config)
    if files.own:
        source = "generate" if config.machine.recordings.format == "none" else "ingest"
        make_missing(config, source, files.vibration, files.excitation, files.known)
        _require_generated_from(config, files)
    # A rotor file says itself how many nodes there are, and where the bearings stand.
    n_nodes = config.machine.rotor.n_nodes if config.machine.rotor.file is None else None
    dataset = read_measured(files.vibration, files.excitation, config.data.baseline, n_nodes)
    if n_nodes is not None:
        known = _known(config, files, config.machine.rotor.bearing_nodes, dataset)
        rotor = load_rotor(config.machine.rotor)
    else:
        rotor = load_rotor(config.machine.rotor)
        require_nodes_of(dataset, rotor.n_nodes, files.vibration, files.excitation)
        known = _known(config, files, rotor.bearing_nodes, dataset)
    require_made_for(files.vibration, rotor)
    require_nodes(rotor, "identify.unbalance_planes", config.identify.unbalance_planes)
    return measurement_of(config, rotor, dataset, known)


def measurement_of(config: Config, rotor: RotorModel, dataset: VibrationDataset, known: BearingTable) -> Measurement:
    """The measurement that a configuration asks about, from data that are at hand."""
    noise, model = config.stated_noise, config.model
    return Measurement(
        rotor,
        dataset,
        known,
        NoiseModel(noise.additive, noise.multiplicative),
        config.identify.unknowns_of(rotor.bearing_nodes),
        Guess(model.initial_stiffness, model.initial_damping),
    )


def _known(config: Config, files: InputFiles, nodes: tuple[int, ...], dataset: VibrationDataset) -> BearingTable:
    return read_coefficients(files.known, nodes, dataset.speeds, known_coefficients(config, nodes))


def _require_generated_from(config: Config, files: InputFiles) -> None:
    made_from = (read_marks(files.vibration) or {}).get("origin")
    if made_from is not None and made_from.split(" ")[0] != origin(config):
        raise DataError(
            f"'{files.vibration}' must have been generated from the configured machine, but it has "
            "changed since: run stage=generate with the same overrides first, or choose another folder "
            "with output=FOLDER"
        )
    if made_from not in (None, origin_of_files(config, files)):
        raise DataError(
            f"'{files.vibration}', '{files.excitation}' and '{files.known}' must come from one stage=generate, but "
            "they do not belong together: run it again, or give files of your own as data.vibration=..., "
            "data.excitation=... and data.known=..."
        )
