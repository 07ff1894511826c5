"""The machine at operating conditions of one's choice, measured or not: a speed comes once there.

Legend: S operating points of the data.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace

import numpy as np

from pipeline.coefficients import COEFFICIENTS, is_direct, unit
from pipeline.data.coefficient_files import interpolate
from pipeline.data.operating import name_state, write_condition
from pipeline.data.vibration_files import write_range
from pipeline.errors import ConfigError
from pipeline.identification.identified import IdentifiedModel
from pipeline.problem.measurement import Measurement
from pipeline.rotor.bearing_table import BearingTable
from pipeline.write_numbers import write_rough


def require_conditions(key: str, given: Mapping[str, float], measured: Mapping[str, np.ndarray]) -> None:
    """Raise ConfigError unless ``given`` (what ``key`` has) says every condition of the data and no other."""
    unknown = [name for name in given if name not in measured]
    if unknown:
        has = ", ".join(measured) or "none"
        raise ConfigError(f"{key} must name conditions of the data, but got {unknown[0]}: they have {has}")
    missing = [name for name in measured if name not in given]
    if missing:
        middle = write_condition(missing[0], float(np.median(measured[missing[0]])))
        raise ConfigError(
            f"{key} must say every condition of the data, but {missing[0]} is missing: give it too, such as "
            f"{missing[0]}: {middle}"
        )


def pick_middle(measured: Mapping[str, np.ndarray]) -> dict[str, float]:
    """The conditions of the measured point that lies nearest to the median of each condition's values; SI."""
    if not measured:
        return {}
    away = np.zeros(len(next(iter(measured.values()))))
    for values in measured.values():
        different = np.unique(values)
        away += np.abs(values - different[(len(different) - 1) // 2]) / (np.ptp(values) or 1.0)
    nearest = int(np.argmin(away))
    return {name: float(values[nearest]) for name, values in measured.items()}


def mask_state(measured: Mapping[str, np.ndarray], wanted: Mapping[str, float], same: float = 1e-6) -> np.ndarray:
    """(S,) mask of the points at the conditions that are ``wanted``; of data without conditions a single True.

    Conditions are the same within a share ``same``.
    """
    masks = [np.abs(values - wanted[name]) <= same * abs(wanted[name]) for name, values in measured.items()]
    return np.all(masks, axis=0) if masks else np.array(True)


def say_beyond(measured: Mapping[str, np.ndarray], wanted: Mapping[str, float], same: float = 1e-6) -> list[str]:
    """A sentence a condition that lies outside the data, by more than a share ``same``."""
    sentences = []
    for name, values in measured.items():
        low, high, at = float(values.min()), float(values.max()), wanted[name]
        slack = same * abs(at)
        if not low - slack <= at <= high + slack:
            span = write_condition(name, values)
            where = f"is not the measured {span}" if low == high else f"lies outside the measured {span}"
            sentences.append(f"{name.replace('_', ' ')}: {write_condition(name, at)} {where}")
    return sentences


def table_at(table: BearingTable, wanted: Mapping[str, float], key: str) -> BearingTable:
    """A table over the points of the data at ``wanted`` conditions, at each speed of the data once, ascending.

    Raises ConfigError where a coefficient depends on the conditions and the data have none of these: nothing says what
    it is there.
    """
    if not table.operating:
        return table
    mask, speeds, picked = mask_state(table.operating, wanted), np.unique(table.speeds), []
    for speed in speeds:
        rows = np.flatnonzero(table.speeds == speed)
        exact = rows[mask[rows]]
        if not len(exact) and np.ptp(table.values[:, rows], axis=1).any():
            raise ConfigError(
                f"{key} must be conditions of the data where a known coefficient depends on them, but got "
                f"{name_state(wanted)}: take measured ones, or identify all eight coefficients"
            )
        picked.append(int(exact[0] if len(exact) else rows[0]))
    operating = {name: np.full(len(speeds), wanted[name]) for name in table.operating}
    return BearingTable(table.nodes, speeds, table.values[:, picked], operating)


def evaluate_at(
    identified: IdentifiedModel,
    updated: Measurement,
    wanted: Mapping[str, float],
    key: str,
    speeds: np.ndarray | None = None,
    far: float = 1e3,
) -> tuple[Measurement, BearingTable]:
    """The measurement ``updated`` to the fit with the known coefficients at ``wanted`` conditions, at each speed once,
    or at ``speeds`` (S,) rad/s within these (the readings stay), and all coefficients there.

    Raises ConfigError as :func:`table_at`, and where a coefficient leaves all bounds: functions that were fitted at
    a few states may do anything between and beyond these. Nothing is a continuation of a coefficient of the data that
    is ``far`` times as large, or as small.
    """
    known = table_at(updated.known, wanted, key)
    if speeds is not None and not np.array_equal(known.speeds, speeds):  # between the data's, by splines
        values = np.apply_along_axis(lambda column: interpolate(known.speeds, column, speeds), 1, known.values)
        beside = {name: np.full(len(speeds), column[0]) for name, column in known.operating.items()}
        known = BearingTable(known.nodes, speeds, values, beside)
    machine = replace(updated, known=known)
    table = identified.table(machine.updated_known)
    if not table.bounded.all():
        raise ConfigError(
            "the twin must have coefficients at all speeds, but from "
            f"{write_range(table.speeds[~table.bounded])} they leave all bounds: speeds were held out there, and "
            "nothing holds the fitted functions; train without training.holdout_range to predict"
        )
    data = identified.table(updated.updated_known) if wanted else table
    for b, c in np.ndindex(len(data.nodes), len(COEFFICIENTS)) if wanted else ():
        name, sizes, size = COEFFICIENTS[c], np.abs(table.values[b, :, c]), np.abs(data.values[b, :, c])
        lost = is_direct(name) and bool((sizes < size.min() / far).any())
        if lost or not (np.isfinite(sizes).all() and sizes.max() <= far * size.max()):
            raise ConfigError(
                f"{key} must be conditions that the fitted functions can be continued to, but at {name_state(wanted)} "
                f"{name} of node {data.nodes[b]} leaves all bounds ({write_rough(sizes.min())} to "
                f"{write_rough(sizes.max())} {unit(name)}; at the data {write_rough(size.min())} to "
                f"{write_rough(size.max())}): take a measured state, measure "
                "there, or fit model=law or model=hybrid, which physics continues"
            )
    return machine, table
