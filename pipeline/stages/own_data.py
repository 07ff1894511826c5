"""An experiment's own data: what it generated, or took from recordings."""

from __future__ import annotations

from pathlib import Path

from pipeline.config.schema import Config
from pipeline.data.coefficient_files import write_coefficients
from pipeline.data.dataset import VibrationDataset
from pipeline.data.excitation_files import write_excitation
from pipeline.data.vibration_files import write_vibration
from pipeline.problem.configured import list_known
from pipeline.rotor.bearing_table import BearingTable
from pipeline.stages.analysis import hash_origin, locate_files


def write_data(
    config: Config,
    data: VibrationDataset,
    known: BearingTable | None,
    modelled: BearingTable | None,
    generated_for: str | None = None,
) -> list[Path]:
    """Write the experiment's own data; the vibration comes last, and is the last of the files.

    Coefficients of data that were there before go. ``generated_for`` is the fingerprint of the rotor that generated
    data are of.
    """
    files = locate_files(config)
    written = [write_excitation(files.excitation, data)]
    given = list_known(config, known.nodes) if known else None
    for path, table, names in ((files.known, known, given), (files.modelled, modelled, None)):
        if table is None:
            path.unlink(missing_ok=True)
        else:
            written.append(write_coefficients(path, table, names))
    marks = {"rotor": generated_for, "origin": hash_origin(config, files)} if generated_for else None
    return [*written, write_vibration(files.vibration, data, marks)]
