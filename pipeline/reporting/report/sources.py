"""Tables that the report reads, and where all that it says comes from."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np

from pipeline.coefficients import COEFFICIENTS
from pipeline.config.schema import Config
from pipeline.data.tables import read_table
from pipeline.errors import DataError
from pipeline.files import hash_file
from pipeline.problem.measurement import Measurement

_TABLES: dict[str, tuple[dict[str, str], dict[str, str]]] = {
    "residual_unbalance": (dict.fromkeys(("node", "magnitude", "phase_deg", "magnitude_std"), "number"), {}),
    "model_parameters": (
        dict.fromkeys(("kind", "of", "unit"), "text") | dict.fromkeys(("prior_std", "value", "std"), "number"),
        {},
    ),
    "modes": (
        {"system": "text", "speed_rpm": "number", "mode": "number"}
        | dict.fromkeys(("frequency_std_hz", "logarithmic_decrement_std"), "number or blank"),
        {},
    ),
    "prediction": (
        dict.fromkeys(("speed_rpm", "x_identified_amplitude_m", "y_identified_amplitude_m"), "number"),
        dict.fromkeys(("x_identified_amplitude_std_m", "y_identified_amplitude_std_m"), "number"),
    ),
}
"""Tables that sections read: columns that they need, and columns that may be there."""


def read_tables(folder: Path) -> dict[str, Mapping[str, np.ndarray]]:
    """The tables of the experiment that are there and have a row."""
    tables: dict[str, Mapping[str, np.ndarray]] = {}
    for name, (columns, optional) in _TABLES.items():
        path = folder / f"{name}.csv"
        if path.exists() and path.read_text(encoding="utf-8").count("\n") > 1:
            tables[name] = read_table(path, columns, optional)
    return tables


def read_reference(path: Path) -> dict[str, np.ndarray]:
    """A table of coefficients at speeds of its own. Raises DataError where it has no coefficient."""
    columns = read_table(
        path, dict.fromkeys(("bearing_node", "speed_rpm"), "number"), dict.fromkeys(COEFFICIENTS, "number or blank")
    )
    if not any(name in columns for name in COEFFICIENTS):
        raise DataError(
            f"'{path}' must have a column of a coefficient ({', '.join(COEFFICIENTS)}; N/m and N s/m), but it has "
            "none: name the columns so, or leave report.reference out"
        )
    return columns


def describe_origin(
    config: Config, measurement: Measurement, files: Sequence[Path], versions: Mapping[str, str]
) -> dict[str, str]:
    """The command, fingerprints of data, rotor and ``files``, and the ``versions`` of the program and its packages."""
    recordings = config.machine.recordings
    origin = {
        "command": f"python -m pipeline stage=report {config.chosen}",
        "fingerprint of the data": measurement.dataset.fingerprint,
    }
    origin |= {"fingerprint of the rotor": measurement.rotor.fingerprint}
    for path in files:
        if path.exists():
            origin[path.name] = f"sha256 {hash_file(path)}"
    for source in dict.fromkeys(s for measured in recordings.runs for s in measured.sources(recordings.file)):
        origin[str(source)] = f"sha256 {hash_file(Path(source)) or 'not at hand'}"
    if config.report.reference is not None:
        origin["reference"] = f"{config.report.reference}, sha256 {hash_file(Path(config.report.reference))}"
    named = {name.removeprefix("version."): text for name, text in versions.items() if name.startswith("version.")}
    origin |= named
    if "git.revision" in versions:
        changed = " with changes" if versions.get("git.dirty") == "true" else ""
        origin["revision of the program"] = versions["git.revision"][:12] + changed
    return origin
