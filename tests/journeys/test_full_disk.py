"""Full disks and read-only folders: a file is written whole or not at all, and a sentence says why not."""

from __future__ import annotations

import errno
import os
import resource
import shutil
import sys
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import pytest
from conftest import Run, refused, with_machine
from damaged import answers
from measured_files import table_config
from reading import wide_runs, with_ingest
from running import contents, left_alone

from pipeline.config.schema import Config
from pipeline.data.tables import write_table
from pipeline.errors import DataError, StorageError
from pipeline.files import write_json
from pipeline.identification.storage import load_model, save_model
from pipeline.reporting.blocks import Axes, Curve, Figure, Panel
from pipeline.reporting.matplotlib_figures import write_figure
from pipeline.stages.analysis import Analysis
from pipeline.stages.measurement import restore


@contextmanager
def largest_file(size: int) -> Iterator[None]:
    """The system refuses to let any file grow beyond ``size`` bytes: a full disk, for every library alike.

    Python keeps no bytecode meanwhile: it would believe the half of a file that a short write leaves.
    """
    soft, hard = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (size, hard))
    try:
        with pytest.MonkeyPatch.context() as patch:
            patch.setattr(sys, "dont_write_bytecode", True)
            yield
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, (soft, hard))


NUMBERS = pd.DataFrame(np.random.default_rng(2).random((2000, 4)), columns=list("abcd"))


def _picture(path: Path) -> None:
    curve = Curve(*np.random.default_rng(3).random((2, 500)))
    write_figure(path, Figure("", "", [Panel("", "", [Axes([curve], "")])]))


@pytest.fixture
def writers(finished: Path) -> dict[str, Callable[[Path], object]]:
    """One writer of some kilobytes for every kind of file."""
    from dataclasses import replace

    import torch

    model = replace(load_model(finished), parameters=torch.zeros(2, 2000, dtype=torch.float64))
    return {
        "x.csv": partial(write_table, table=NUMBERS),
        "x.parquet": partial(write_table, table=NUMBERS),
        "x.json": partial(write_json, value={"x": "x" * 9000}),
        "x.png": _picture,
        "model.safetensors": lambda path: save_model(path.parent, model),
    }


KINDS = ["x.csv", "x.parquet", "x.json", "x.png", "model.safetensors"]


@pytest.mark.parametrize("old", [True, False], ids=["over an old file", "anew"])
@pytest.mark.parametrize("kind", KINDS)
def test_a_disk_that_is_full_in_the_middle_of_a_file(
    kind: str, old: bool, writers: dict[str, Callable[[Path], object]], tmp_path: Path
) -> None:
    """A file is written whole or not at all: the old one stays, no temporary one is left."""
    path = tmp_path / "results" / kind
    path.parent.mkdir()
    if old:
        path.write_bytes(b"old")
    with (
        left_alone(tmp_path),
        refused(f"'{path}' must be writable", "output=FOLDER", kind=StorageError),
        largest_file(1000),
    ):
        writers[kind](path)
    writers[kind](path)
    assert path.stat().st_size > 1000


def _raising(code: int, at: int = 1) -> Callable[..., None]:
    """A stand-in for os.replace that fails at its ``at``-th call."""
    real, calls = os.replace, []

    def replace(*arguments: Any, **options: Any) -> None:
        calls.append(1)
        if len(calls) >= at:
            raise OSError(code, os.strerror(code), str(arguments[1]))
        real(*arguments, **options)

    return replace


@pytest.mark.parametrize("code", [errno.EROFS, errno.ENOSPC, errno.EACCES, errno.EIO, errno.EDQUOT])
@pytest.mark.parametrize("kind", KINDS)
def test_a_file_that_cannot_be_put_in_its_place(
    kind: str,
    code: int,
    writers: dict[str, Callable[[Path], object]],
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """Where the rename fails, the system's reason is in the sentence and nothing is left behind."""
    path = tmp_path / kind
    path.write_bytes(b"old")
    monkeypatch.setattr(os, "replace", _raising(code))
    with refused("must be writable", os.strerror(code), kind=StorageError):
        writers[kind](path)
    assert contents(tmp_path) == {kind: b"old"}


STAGES = ["generate", "ingest", "train", "evaluate", "robustness", "predict", "export", "identify"]
NEW = {"ingest": "measured"}
"""Its folder, where a stage replaces no data that others made."""


@pytest.fixture
def of(stage: str, base: Config, tmp_path: Path) -> Config:
    """What a ``stage`` works on: ingest on recordings."""
    return with_ingest(table_config(wide_runs(tmp_path))) if stage == "ingest" else base


@pytest.mark.parametrize("stage", ["configure", *STAGES])
def test_a_folder_that_cannot_be_made(stage: str, run: Run, of: Config, tmp_path: Path) -> None:
    (tmp_path / "file").write_text("a file")
    with left_alone(tmp_path), refused("must be writable", "Not a directory", kind=StorageError):
        run(stage, of, tmp_path / "file" / "x")


@pytest.mark.parametrize("stage", STAGES)
def test_a_full_disk_in_a_stage(
    stage: str, run: Run, of: Config, mine: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """A stage that can't save ends in a sentence; every file is the old one or a complete new one."""
    names = contents(mine).keys()
    with refused("must be writable", kind=StorageError), largest_file(100):
        run(stage, of, mine / NEW.get(stage, ""))
    assert contents(mine).keys() == names
    assert sum(len(raw) == 100 for raw in contents(mine).values()) == 0


@pytest.mark.parametrize("stage", STAGES)
def test_a_read_only_folder(stage: str, run: Run, of: Config, mine: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """In a folder that can be read but not written, every stage ends in a sentence and changes nothing."""
    monkeypatch.setattr(os, "replace", _raising(errno.EROFS))
    with left_alone(mine), refused("must be writable", "Read-only file system", kind=StorageError):
        run(stage, of, mine / NEW.get(stage, ""))


def identified(base: Config, folder: Path, **sections: object) -> bytes:
    """The coefficients that evaluate and predict work with."""
    config = base.model_copy(update={"stage": "evaluate", "output": str(folder)} | sections)
    return restore(Analysis(config)).table.values.tobytes()


@pytest.fixture
def fails_after(monkeypatch: pytest.MonkeyPatch) -> Callable[[int, Callable[[], None]], None]:
    """``fails_after(n, action)``: the disk is full after ``n`` files; True where the action noticed."""

    def act(files: int, action: Callable[[], None]) -> None:
        with monkeypatch.context() as patch:
            patch.setattr(os, "replace", _raising(errno.ENOSPC, at=files + 1))
            with suppress(StorageError):
                action()

    return act


@pytest.mark.parametrize("files", range(1, 5))
def test_a_training_saved_in_part_is_never_taken_for_a_whole_one(
    files: int, run: Run, base: Config, mine: Path, fails_after: Callable[[int, Callable[[], None]], None]
) -> None:
    """Where saving stopped between two files, evaluate answers for one of the models, or refuses."""
    # Another parametrisation: other weights, and another meaning of weights.
    scaled = {"model": base.model.model_copy(update={"parametrisation": "scaled"})}
    whole = Path(shutil.copytree(mine, mine.parent / "whole"))
    run("train", base, whole, **scaled)
    expected = (identified(base, mine), identified(base, whole))
    fails_after(files, partial(run, "train", base, mine, **scaled))
    with suppress(DataError):
        assert identified(base, mine) in expected


@pytest.mark.parametrize("files", range(1, 4))
def test_data_generated_in_part_are_never_taken_for_whole_ones(
    files: int, run: Run, base: Config, mine: Path, fails_after: Callable[[int, Callable[[], None]], None]
) -> None:
    """Where generate stopped between two files, training answers for the configured data, or refuses."""
    other = with_machine(base, bearings=base.machine.bearings.model_copy(update={"n_balls": 12}))
    changed = {"machine": other.machine}
    whole = Path(shutil.copytree(mine, mine.parent / "whole"))
    run("generate", base, whole, **changed)
    run("train", base, whole, **changed)
    expected = {"old": answers(mine), "new": answers(whole)}
    fails_after(files, partial(run, "generate", base, mine, **changed))
    for which, sections in {"old": {}, "new": changed}.items():
        with suppress(DataError):
            run("train", base, mine, **sections)
            assert answers(mine) == expected[which]
