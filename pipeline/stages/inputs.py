"""What several stages load: the rotor, the measurement, the known coefficients, the equations."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property

from pipeline.coefficients import COEFFICIENTS
from pipeline.config.schema import Config
from pipeline.data.coefficient_files import read_coefficients
from pipeline.data.dataset import VibrationDataset
from pipeline.data.tables import origin_of
from pipeline.data.vibration_files import read_measured, require_made_for, require_nodes_of
from pipeline.equations.bearing_equations import BearingEquations, bearing_equations
from pipeline.errors import ConfigError, DataError
from pipeline.rotor.bearing_table import BearingTable
from pipeline.rotor.model import RotorModel
from pipeline.rotor.stored import assembled
from pipeline.stages.run import InputFiles, input_files, make_missing, origin, origin_of_files


@dataclass(frozen=True, eq=False)
class Inputs:
    """Everything that training may see. There is no truth in it."""

    rotor: RotorModel
    dataset: VibrationDataset
    known: BearingTable

    @cached_property
    def equations(self) -> BearingEquations:
        """The equations at the bearings."""
        return bearing_equations(self.rotor, self.dataset)


def require_nodes(rotor: RotorModel, key: str, nodes: Sequence[int]) -> None:
    """Raise ConfigError for a node that a rotor from a file lacks; other rotors are checked with the configuration."""
    for node in nodes:
        if node >= rotor.n_nodes:
            raise ConfigError(f"{key} must use nodes 0 to {rotor.n_nodes - 1} of the rotor, but got node {node}")


def known_coefficients(config: Config, nodes: Sequence[int]) -> dict[int, tuple[str, ...]]:
    """The coefficients of each bearing that are not identified. Raises ConfigError for an exception without bearing."""
    for node in config.identify.bearings:
        if node not in nodes:
            raise ConfigError(
                f"identify.bearings must name bearing nodes of the rotor ({', '.join(map(str, nodes))}), but got {node}"
            )
    unknown = {node: config.identify.at(node).coefficients for node in nodes}
    return {node: tuple(name for name in COEFFICIENTS if name not in unknown[node]) for node in nodes}


def load_inputs(config: Config) -> Inputs:
    """Read the data set of an experiment, generating it first where it is missing.

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
        rotor = assembled(config.machine.rotor)
    else:
        rotor = assembled(config.machine.rotor)
        require_nodes_of(dataset, rotor.n_nodes, files.vibration, files.excitation)
        known = _known(config, files, rotor.bearing_nodes, dataset)
    require_made_for(files.vibration, rotor)
    return Inputs(rotor, dataset, known)


def _known(config: Config, files: InputFiles, nodes: tuple[int, ...], dataset: VibrationDataset) -> BearingTable:
    return read_coefficients(files.known, nodes, dataset.speeds, known_coefficients(config, nodes))


def _require_generated_from(config: Config, files: InputFiles) -> None:
    made_from = origin_of(files.vibration)
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
