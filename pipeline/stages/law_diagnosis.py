"""Which physical numbers of bearing laws the data determine, before any fit (part of ``stage=diagnose``)."""

from __future__ import annotations

from typing import Any

from pipeline.config.schema import Config
from pipeline.data.operating import write_condition
from pipeline.errors import IdentifiabilityError
from pipeline.laws.numbers import OIL_TEMPERATURE
from pipeline.problem.law_information import (
    describe_open,
    inform,
    require_temperatures,
    summarize_numbers,
    try_warmer,
)
from pipeline.problem.measurement import Measurement
from pipeline.reporting.console import say, table, warn
from pipeline.reporting.fit_tables import list_numbers


def diagnose_laws(config: Config, measurement: Measurement, noise: str) -> dict[str, Any]:
    """Print what the data tell of each number, and return it for ``diagnosis.json``; nothing of a model without laws.

    Raises DataError for an operating condition that the laws need and the data lack.
    """
    if not measurement.laws or not config.model.has_laws:
        return {}
    information, warmer = inform(measurement), try_warmer(measurement)
    header, further = ["number", "guess", "known to, %", "with these data, %"], None
    if warmer is not None:
        further = 100 * warmer[1].deviation
        header.append(f"with {write_condition(OIL_TEMPERATURE, warmer[0])} as well, %")
    columns = [100 * information.prior, 100 * information.deviation, *([] if further is None else [further])]
    summary, rows = summarize_numbers(information, further), []
    for i, number in enumerate(list_numbers(summary, config)):
        shown = [number.name, f"{number.guess:.4g} {number.unit}".strip(), *(f"{column[i]:.2g}" for column in columns)]
        rows.append([*shown, "" if number.determined else "not told by these data"])
    title = f"{config.name}: numbers of the bearing laws at their guesses, at {noise} (one standard deviation)"
    table(title, [*header, ""], rows)
    for sentence in describe_open(information):
        say(f"{config.name}: {sentence}")
    try:
        require_temperatures(measurement.laws, measurement.dataset.operating)
    except IdentifiabilityError as error:
        warn(f"{config.name}: {error}")
    return {"physical_numbers": summary, "free_combinations": list(information.free)}
