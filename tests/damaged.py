"""What the tests of bad files share: a small experiment of which every stage has run, and ways to damage its files."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
from running import FEW_SPEEDS

from pipeline.config.schema import DataConfig

SMALL = [
    "experiment=ball_bearing",
    "tracking=none",
    *FEW_SPEEDS,
    "machine.runs=[{name: one, unbalances: [{node: 1, magnitude: 1e-4}]},"
    "{name: two, unbalances: [{node: 0, magnitude: 2e-4, phase: 1}]}]",
    "optimizer.adam.steps=3",
    "optimizer.levenberg_marquardt.steps=20",
    "robustness.count=3",
]
SPEEDS = np.arange(500.0, 5501.0, 500.0)
FILES = {"vibration": "vibration.parquet", "excitation": "excitation.csv", "known": "known_coefficients.csv"}
Change = Callable[[pd.DataFrame], pd.DataFrame]
Law = tuple[str, Change, str]
"""What a sentence says that a table must have, a change of the table, and what the sentence says that came."""
Refused = Callable[..., None]


def damage(content: bytes, seed: int, head: int = 800) -> bytes:
    """A fifth is cut, a fifth has a piece twice or lacks one; half of the bytes that change stand in the head, where
    sizes are."""
    rng, changed = np.random.default_rng(seed), bytearray(content)
    if seed % 5 == 0:
        return content[: rng.integers(len(content))]
    if seed % 5 == 1:
        end, start = rng.integers(len(content), size=2)
        return content[:end] + content[start:]
    for _ in range(rng.integers(1, 5)):
        at = rng.integers(min(len(content), head) if rng.random() < 0.5 else len(content))
        changed[at] = changed[at] ^ 1 << rng.integers(8) if rng.random() < 0.5 else rng.integers(256)
    return bytes(changed)


def loaded(path: Path) -> pd.DataFrame:
    """A table as it is."""
    return pd.read_parquet(path) if path.suffix == ".parquet" else pd.read_csv(path)


def measured(folder: Path, **files: Path) -> DataConfig:
    """The data set of ``folder`` given as somebody's own files, some of them by other names."""
    return DataConfig(**{key: str(files.get(key, folder / name)) for key, name in FILES.items()})


def stored(table: pd.DataFrame, path: Path) -> Path:
    """``table`` as somebody else's program would write it, in the format of the ending."""
    if path.suffix == ".parquet":
        mixed = {name: str for name in table.columns[table.dtypes.map(str) == "object"]}
        table.astype(mixed).to_parquet(path, index=False)
    else:
        table.to_csv(path, index=False)
    return path


def put(column: str, value: object, rows: Sequence[int] = (4,)) -> Change:
    """A change of the table that sets some rows of a column."""

    def change(table: pd.DataFrame) -> pd.DataFrame:
        if not isinstance(value, (int, float)):
            table = table.astype({column: object})
        elif table[column].dtype != float:
            table = table.astype({column: float})
        table.loc[list(rows), column] = value
        return table

    return change


def keep(law: Callable[[pd.DataFrame], Any]) -> Change:
    """A change of the table that keeps the rows where ``law`` holds."""
    return lambda table: table[law(table)]


def answers(folder: Path) -> dict[str, bytes]:
    """What training writes, but for its history."""
    files = ("model.safetensors", "model.json", "identified_coefficients.csv", "training.json")
    return {name: (folder / name).read_bytes() for name in files}
