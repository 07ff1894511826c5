"""The conditions of a machine: what several records in a row repeat, with their mean and their scatter.

Legend: C conditions, S speeds, P channels, N planes, R runs (one record each).
"""

from __future__ import annotations

from collections.abc import Collection, Sequence
from dataclasses import dataclass, replace

import numpy as np

from pipeline.data.dataset import VibrationDataset
from pipeline.errors import DataError


@dataclass(frozen=True, eq=False, kw_only=True)
class Conditions:
    """One row a condition of the machine, in the order of the data's runs."""

    names: tuple[str, ...]  # C
    speeds: np.ndarray  # (S,) rad/s, nominal
    own_speeds: np.ndarray  # (C, S) rad/s, mean over the records; NaN where nothing was read
    displacement: np.ndarray  # (C, S, P) complex, m, mean over the records; NaN where nothing was read
    counts: np.ndarray  # (C,) records
    channels: tuple[tuple[int, float], ...]  # P of (node, angle in degrees)
    planes: tuple[int, ...]  # N nodes
    unbalance: np.ndarray  # (C, N) complex, kg m: magnitude e^{j phase}; NaN where it is not given
    record_covariance: np.ndarray  # (S, P, P) complex, m^2, of one record about its condition's mean; zero if unknown

    @property
    def vectors(self) -> np.ndarray:
        """(C, S P) complex, m: what all channels show at all speeds, the channel fastest."""
        return self.displacement.reshape(len(self.names), -1)

    @property
    def complete(self) -> bool:
        """Whether every condition was read at every speed."""
        return not bool(np.isnan(self.displacement).any())

    def of(self, rows: Sequence[int] | np.ndarray) -> Conditions:
        """The conditions of these indices alone; the scatter of the records stays that of all."""
        kept = np.asarray(rows, dtype=int)
        return replace(
            self,
            names=tuple(self.names[c] for c in kept),
            own_speeds=self.own_speeds[kept],
            displacement=self.displacement[kept],
            counts=self.counts[kept],
            unbalance=self.unbalance[kept],
        )

    def without(self, names: Collection[str]) -> Conditions:
        """The conditions that are not among these names."""
        return self.of([c for c, name in enumerate(self.names) if name not in names])

    def at(self, speeds: Sequence[int] | np.ndarray) -> Conditions:
        """The same at the speeds of these indices alone."""
        kept = np.asarray(speeds, dtype=int)
        return replace(
            self,
            speeds=self.speeds[kept],
            own_speeds=self.own_speeds[:, kept],
            displacement=self.displacement[:, kept],
            record_covariance=self.record_covariance[kept],
        )


def gather_conditions(dataset: VibrationDataset, planes: tuple[int, ...] | None = None) -> Conditions:
    """The means of the runs that repeat a condition, and their pooled scatter.

    A data set that names no conditions has one a run. ``planes`` are the nodes that carry weights, by default all that
    an unbalance of the data names. Raises DataError for a run that does not turn with the rotor or has a force, for a
    weight outside the planes, and for runs of one condition whose weights differ.
    """
    if dataset.operating:
        raise DataError(
            "records of conditions, and what is balanced by them, must be of one operating state, but the data have "
            f"{', '.join(dataset.operating)}: give the rows of one state, without these columns"
        )
    labels = dataset.conditions or dataset.runs
    names = tuple(dict.fromkeys(labels))
    planes = tuple(sorted({e.node for e in dataset.excitations})) if planes is None else planes
    loads = _read_unbalance(dataset, planes)
    rows = [np.array([r for r, name in enumerate(labels) if name == condition]) for condition in names]
    for condition, runs in zip(names, rows, strict=True):
        differing = [r for r in runs if not np.array_equal(loads[r], loads[runs[0]])]
        if differing:
            raise DataError(
                f"runs of one condition must have the same weights, but '{dataset.runs[differing[0]]}' and "
                f"'{dataset.runs[runs[0]]}' of condition '{condition}' differ: give one of them a condition of its own"
            )
    present = [dataset.present[:, runs] for runs in rows]
    mean = np.stack(
        [_average(dataset.displacement[..., runs], p[:, None]) for runs, p in zip(rows, present, strict=True)]
    )
    mean_speeds = np.stack([_average(dataset.frequencies[:, runs], p) for runs, p in zip(rows, present, strict=True)])
    deviation = np.stack(
        [dataset.displacement[..., r] - mean[names.index(labels[r])] for r in range(len(labels))]
    )  # (R, S, P)
    deviation[~dataset.present.T] = 0.0
    freedom = dataset.present.sum(axis=1) - np.isfinite(mean_speeds).sum(axis=0)  # (S,)
    scatter = np.einsum("rsp,rsq->spq", deviation, deviation.conj())
    return Conditions(
        names=names,
        speeds=dataset.speeds,
        own_speeds=mean_speeds,
        displacement=mean,
        counts=np.array([len(runs) for runs in rows]),
        channels=dataset.channels,
        planes=planes,
        unbalance=np.stack([loads[runs[0]] for runs in rows]),
        record_covariance=scatter / np.maximum(freedom, 1)[:, None, None],
    )


def _average(values: np.ndarray, present: np.ndarray) -> np.ndarray:
    """The mean over the last axis of what is ``present``; NaN where nothing is."""
    count = present.sum(axis=-1)
    return np.where(count > 0, (values * present).sum(axis=-1) / np.maximum(count, 1), np.nan)


def _read_unbalance(dataset: VibrationDataset, planes: tuple[int, ...], turning: float = 0.05) -> np.ndarray:
    """(R, N) complex, kg m.

    A record's own speed may differ by the share ``turning`` of the nominal one and still be a record at that speed.
    """
    apart = np.argwhere(abs(dataset.frequencies / dataset.speeds[:, None] - 1) > turning)
    if len(apart):
        raise DataError(
            f"influence of weights must come from runs that turn with the rotor, but run '{dataset.runs[apart[0][1]]}' "
            "has a frequency of its own: leave it out"
        )
    loads = np.zeros((len(dataset.runs), len(planes)), dtype=complex)
    for excitation in dataset.excitations:
        if excitation.kind != "unbalance" or excitation.whirl != "forward":
            raise DataError(
                f"influence of weights must come from unbalances that turn forward, but run '{excitation.run}' has a "
                f"{excitation.kind} ({excitation.whirl}): leave it out"
            )
        if excitation.node not in planes:
            raise DataError(
                f"weights must lie in the balancing planes (nodes {', '.join(map(str, planes))}), "
                f"but run '{excitation.run}' has one at node {excitation.node}: name that plane too"
            )
        loads[dataset.runs.index(excitation.run), planes.index(excitation.node)] += excitation.magnitude * np.exp(
            1j * excitation.phase
        )
    return loads
