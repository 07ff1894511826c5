"""The baseline that was taken off the readings, where bearings drift between the runs.

A run less the baseline is ``H_r (w + u) - H_b u``: the weights w, and what the bearings' change makes of the machine's
own unbalance u, which cancels only where ``H_r = H_b``. The baseline shows u.

Legend: S speeds, P channels, R runs, N nodes. SI units.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from pipeline.data.dataset import Excitation
from pipeline.parameters.bearings import BASELINE, drift_scales
from pipeline.parameters.kind import turns_with_rotor
from pipeline.problem.condition_noise import NO_LEVELS
from pipeline.problem.measurement import Measurement
from pipeline.rotor.bearing_table import BearingTable


def _scale_bearings(measurement: Measurement) -> np.ndarray:
    """(B, T) what one deviation of each parameter adds to one, by which a bearing is scaled in the baseline."""
    return np.asarray(drift_scales(measurement.parameters, (BASELINE,), len(measurement.rotor.bearing_nodes))[0])


def find_baseline(measurement: Measurement, bearings: BearingTable, least: float = 1e-2) -> tuple[complex, ...]:
    """(N,) kg m, the unbalance that ``bearings`` at the same speeds make of the baseline; none where no bearing drifts.

    By least squares over all speeds, each reading over its noise, beside what a probe shows at every speed (runout).
    Distributions that show less than the share ``least`` of what the clearest shows are left out.
    """
    drift = _scale_bearings(measurement)
    if not drift.any():
        return ()
    data, scale = measurement.dataset, (1 + drift @ measurement.parameter_values)[:, None, None]
    turning = np.flatnonzero(turns_with_rotor(data))
    run = turning[data.present[:, turning].sum(axis=0).argmax()]
    nodes, count, seen = tuple(range(measurement.rotor.n_nodes)), len(data.channels), data.present[:, run]
    alone = replace(measurement, unknowns=replace(measurement.unknowns, planes=nodes), as_found=())
    by_unbalance = alone.response.derive_by_unbalance(replace(bearings, values=bearings.values * scale))[:, :, run]
    by_runout = np.broadcast_to(np.eye(count), (len(data.speeds), count, count))
    weight = 1 / measurement.deviation_of(measurement.baseline)[seen, :, run, None]
    parts = [(by[seen] * weight).reshape(-1, by.shape[-1]) for by in (by_unbalance, by_runout)]
    sizes = [np.linalg.norm(part) / np.sqrt(part.shape[1]) for part in parts]
    columns = np.concatenate([part / size for part, size in zip(parts, sizes, strict=True)], axis=1)
    solved = np.linalg.lstsq(columns, (measurement.baseline[seen, :, run, None] * weight).ravel(), rcond=least)[0]
    return tuple((solved[: len(nodes)] / sizes[0]).tolist())


def add_baseline(measurement: Measurement) -> Measurement:
    """The same with the unbalance as found in the runs that turn, and the baseline as a last run, whose response is to
    be taken off theirs; as it is where no bearing drifts. The baseline's readings are zero.
    """
    data = measurement.dataset
    if not measurement.as_found or not _scale_bearings(measurement).any():
        return measurement
    turning = zip(data.runs, turns_with_rotor(data), strict=True)
    found = tuple(
        Excitation(run, "unbalance", node, abs(unbalance), float(np.angle(unbalance)))
        for run in (*(run for run, turns in turning if turns), BASELINE)
        for node, unbalance in enumerate(measurement.as_found)
    )
    whole = replace(
        data,
        runs=(*data.runs, BASELINE),
        displacement=np.concatenate([data.displacement, np.zeros_like(data.displacement[..., :1])], axis=-1),
        excitations=(*data.excitations, *found),
        own_frequencies=np.concatenate([data.frequencies, data.speeds[:, None]], axis=1),
        subtracted=None,
        conditions=None,
        present=np.concatenate([data.present, data.present.any(axis=1, keepdims=True)], axis=1),
    )
    return replace(measurement, dataset=whole, drift=NO_LEVELS, as_found=())
