"""Methods on splits: every method learns each training part and is scored on what it has not seen.

Legend: C conditions, S speeds, P channels, R records.
"""

from __future__ import annotations

from collections.abc import Collection, Iterator, Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from peers import Peer
from scores import Forward, Inverse, predict_records, read_weights, score_forward, score_inverse
from splits import Split

from pipeline.data.conditions import gather_conditions
from pipeline.data.dataset import VibrationDataset
from pipeline.errors import DataError, IdentifiabilityError


@dataclass(frozen=True, eq=False)
class Judged:
    """What a method made of the splits of one task."""

    task: str
    method: str
    forward: list[Forward]
    inverse: list[Inverse]
    refusal: str  # why it has none; empty where it has


def judge(
    dataset: VibrationDataset,
    planes: tuple[int, ...],
    splits: Sequence[Split],
    peers: Mapping[str, Peer],
    baseline: np.ndarray,
) -> Iterator[Judged]:
    """Every method on every task, one after the other.

    ``baseline`` (S, P) m is the mean of the condition that responses count from. A refusal (IdentifiabilityError,
    DataError) of one split is that of the task. The scatter of the records in a training part is that of its own.
    """
    names = gather_conditions(dataset, planes).names
    for task in dict.fromkeys(split.task for split in splits):
        for method, peer in peers.items():
            parts: tuple[list[Forward], list[Inverse]] = ([], [])
            refusal = ""
            for split in (candidate for candidate in splits if candidate.task == task):
                train = gather_conditions(select(dataset, [names[c] for c in split.train]), planes)
                tested = select(dataset, [names[c] for c in split.test])
                about = gather_conditions(tested, planes).at(split.test_speeds)
                try:
                    model = peer(train.at(split.train_speeds), about.speeds)
                    records = list_records(tested, about.names, split.test_speeds)
                    parts[0].append(predict_records(model, about, records, baseline[split.test_speeds]))
                    parts[1].append(read_weights(model, about))
                except (IdentifiabilityError, DataError) as error:
                    refusal = str(error)
                    break
            yield Judged(task, method, *(([], []) if refusal else parts), refusal)


def select(dataset: VibrationDataset, names: Collection[str]) -> VibrationDataset:
    """The runs of these conditions."""
    labels = dataset.conditions or dataset.runs
    return dataset.of_runs(np.array([r for r, name in enumerate(labels) if name in names]))


def list_records(dataset: VibrationDataset, names: Sequence[str], speeds: np.ndarray) -> list[np.ndarray]:
    """(records, S, P) m of each condition, at the speeds of these indices."""
    labels = np.array(dataset.conditions or dataset.runs, dtype=object)
    return [dataset.displacement[speeds][..., labels == name].transpose(2, 0, 1) for name in names]


def score(judged: Judged, without: Sequence[str] = ()) -> dict[str, dict[str, float]]:
    """Forward and inverse scores of a task, ``without`` these conditions."""
    return {"forward": score_forward(judged.forward, without), "inverse": score_inverse(judged.inverse, without)}
