"""Data and models that are damaged, or of another machine, training or question: a sentence, and no file is touched."""

from __future__ import annotations

import json
from collections.abc import Callable
from contextlib import suppress
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from conftest import Run, refused, with_machine
from damaged import Refused, measured
from running import left_alone

from pipeline.config.schema import Config
from pipeline.data.tables import read_marks
from pipeline.data.vibration_files import read_dataset
from pipeline.errors import ConfigError, PipelineError
from pipeline.rotor.ross_adapter import assemble
from pipeline.stages.analysis import Analysis
from pipeline.stages.measurement import restore


def test_a_truncated_parquet_file(base: Config, refused_by_train: Refused, mine: Path) -> None:
    """A Parquet file cut off anywhere is refused by training and by what looks at its marks."""
    rotor, path = assemble(base.machine.rotor), mine / "vibration.parquet"
    whole = path.read_bytes()
    lengths = {*range(0, len(whole), len(whole) // 80), *range(16), *(len(whole) - n for n in range(1, 16))}
    for length in sorted(lengths):
        path.write_bytes(whole[:length])
        assert read_marks(path) is None
        with refused("must be a complete Parquet file", "stage=generate"):
            read_dataset(path, mine / "excitation.csv", rotor)
    refused_by_train({}, "must be a complete Parquet file")


def with_marks(path: Path, marks: dict[bytes, bytes] | None) -> None:
    """Write a Parquet file again with other marks beside its own, or with none."""
    import pyarrow.parquet as parquet

    table = parquet.read_table(path)
    parquet.write_table(table.replace_schema_metadata({} if marks is None else table.schema.metadata | marks), path)


def test_an_older_schema(refused_by_train: Refused, mine: Path) -> None:
    with_marks(mine / "vibration.parquet", {b"bearing_identification.schema": b"0"})
    refused_by_train({}, "must have the file schema 1", "schema 0", "stage=generate")


@pytest.mark.parametrize("mark", [b"schema", b"rotor", b"origin"])
def test_marks_that_are_no_text(mark: bytes, run: Run, base: Config, mine: Path) -> None:
    with_marks(mine / "vibration.parquet", {b"bearing_identification." + mark: b"\xff\xfe"})
    with refused("must"):
        run("train", base, mine)


def test_data_of_another_rotor(run: Run, base: Config, refused_by_train: Refused, mine: Path) -> None:
    """Vibration that was made for another shaft is refused, also where it is given as a data set."""
    shaft = base.machine.rotor.shaft[0].model_copy(update={"outer_diameter": 0.036})
    other = with_machine(base, rotor=base.machine.rotor.model_copy(update={"shaft": (shaft,)}))
    refused_by_train({}, "must have been made for this rotor", "made for another", of=other)
    with refused("must have been generated from the configured machine", "stage=generate"):
        run("train", other, mine)


@pytest.mark.parametrize("stage", ["train", "evaluate", "robustness", "predict"])
def test_a_bearing_changed_since_generate(stage: str, run: Run, base: Config, mine: Path) -> None:
    """Own data of another bearing are refused by every stage, and old results stay as they were."""
    other = with_machine(base, bearings=base.machine.bearings.model_copy(update={"n_balls": 9}))
    with left_alone(mine), refused("must have been generated from the configured machine", "changed since"):
        run(stage, other, mine)


def test_own_data_that_nobody_marked_are_never_overwritten(run: Run, base: Config, mine: Path) -> None:
    """A measured file in the experiment's folder is not replaced by a generated one."""
    path = mine / "vibration.parquet"
    with_marks(path, None)
    (mine / "known_coefficients.csv").unlink()
    before = path.read_bytes()
    with suppress(PipelineError):
        run("train", base, mine)
    assert path.read_bytes() == before


MODEL: dict[str, tuple[str, object, str]] = {
    "older schema": ("schema", 0, "must have schema 3"),
    "newer schema": ("schema", 99, "must have schema 3"),
    "no schema": ("schema", None, "must have schema 3"),
    "no model": ("model", None, "must"),
    "model is a list": ("model", [1, 2], "must"),
    "no fields": ("model", {}, "unknowns: Field required"),
    "another architecture": ("model.hidden", [3], "must"),
    "bearings of another rotor": ("bearing_nodes", [0], "must"),
    "nodes that are not the rotor's bearings": ("bearing_nodes", [0, 1], "must"),
    "unknown parametrisation": ("model.parametrisation", "cubic", "must"),
    "unknown coefficient": ("model.unknowns", ["kxx", "kzz"], "must"),
    "a coefficient short": ("model.unknowns", ["kxx"], "must"),
    "scale null": ("model.scale", [[None, 1.0], [1.0, 1.0]], "must"),
    "scale NaN": ("model.scale", [[float("nan"), 1.0], [1.0, 1.0]], "must"),
    "scale text": ("model.scale", ["ab", "cd"], "must"),
    "scale of one bearing": ("model.scale", [[1.0, 1.0]], "must"),
    "layers text": ("model.hidden", "ab", "must"),
    "layers too many": ("model.hidden", [10**9], "must"),
    "ranges null": ("model.ranges", None, "must"),
}


@pytest.mark.parametrize("case", MODEL)
def test_a_model_file_that_breaks_a_law(case: str, run: Run, base: Config, mine: Path) -> None:
    key, value, law = MODEL[case]
    path = mine / "model.json"
    description = json.loads(path.read_text())
    node = description["model"] if key.startswith("model.") else description
    node[key.removeprefix("model.")] = value
    path.write_text(json.dumps(description))
    with left_alone(mine), refused(law, "stage=train"):
        run("evaluate", base, mine)


def _weights(change: Callable[[Any], Any]) -> Callable[[Path], None]:
    def damage(path: Path) -> None:
        from safetensors.torch import load_file, save_file

        save_file(change(load_file(path)), path)

    return damage


WEIGHTS: dict[str, Callable[[Path], object]] = {
    "empty": lambda path: path.write_bytes(b""),
    "half": lambda path: path.write_bytes(path.read_bytes()[:-9]),
    "random": lambda path: path.write_bytes(np.random.default_rng(1).bytes(500)),
    "an archive": lambda path: path.write_bytes(b"PK\x03\x04 a pickle"),
    "a pickle": lambda path: path.write_bytes(b"\x80\x04\x95\x05\x00\x00\x00\x00\x00\x00\x00K\x01."),
    "another name": _weights(lambda w: {"weights": w["parameters"]}),
    "another shape": _weights(lambda w: {"parameters": w["parameters"][:, :1].contiguous()}),
    "NaN": _weights(lambda w: {"parameters": w["parameters"] * float("nan")}),
    "whole numbers": _weights(lambda w: {"parameters": w["parameters"].long()}),
}


TRAINED: list[tuple[str, Callable[[Path], object], str]] = [
    *(("model.safetensors", damage, "must hold a complete trained model") for damage in WEIGHTS.values()),
    *(
        ("training.json", lambda path, text=text: path.write_text(text, encoding="latin-1"), "")
        for text in ["", "[]", "null", "{", '{"data_fingerprint": 1}', "[" * 100_000, "\xff"]
    ),
    *(
        ("history.csv", lambda path, text=text: path.write_text(text), "")
        for text in ["", "x,y\n1,2\n", "step,phase,loss\n1,adam,many\n", "\0\0"]
    ),
]


@pytest.mark.parametrize(("name", "damage", "words"), TRAINED)
def test_a_file_of_training_that_is_damaged(
    name: str, damage: Callable[[Path], object], words: str, run: Run, base: Config, mine: Path
) -> None:
    """Weights, account or history of another model, or of none, are refused before metrics are written."""
    damage(mine / name)
    with left_alone(mine), refused("must", words, "stage=train" if words else name):
        run("evaluate", base, mine)


@pytest.mark.parametrize("stage", ["evaluate", "predict"])
def test_a_model_of_other_unknowns(stage: str, run: Run, base: Config, mine: Path) -> None:
    """A model that was trained for kxx and kyy is no answer to a question for damping too."""
    four = base.identify.model_copy(update={"unknowns": ("kxx", "kyy", "cxx", "cyy")})
    with refused("kxx", "cyy", "stage=train"):
        run(stage, base, mine, identify=four)


@pytest.mark.parametrize("stage", ["train", "evaluate", "robustness", "predict"])
def test_bad_data_leave_old_results_as_they_were(stage: str, run: Run, base: Config, mine: Path) -> None:
    text = "run,kind,node,magnitude,phase_deg,whirl\none,unbalance,7,1,0,forward\n"
    (mine / "excitation.csv").write_text(text)
    with left_alone(mine), refused("must come from one stage=generate"):
        run(stage, base, mine)


def test_a_generate_for_files_of_others(run: Run, base: Config, mine: Path) -> None:
    with left_alone(mine), refused("generate must write the experiment's own files"):
        run("generate", base, mine.parent / "x", data=measured(mine))


def test_a_model_trained_on_other_data_is_refused(run: Run, base: Config, mine: Path) -> None:
    other = with_machine(base, runs=(base.machine.runs[1], base.machine.runs[0].model_copy(update={"name": "three"})))
    run("generate", other, mine)
    for stage in ("evaluate", "predict"):
        with left_alone(mine), refused("must belong to the data at hand", ": run stage=train"):
            run(stage, other, mine)
    restore(Analysis(run("train", other, mine)))


@pytest.mark.parametrize(
    ("changes", "words"),
    [
        ({"unbalances": ({"node": 1, "magnitude": 1e-4},)}, "that training never saw, but run 'one' is the same"),
        ({"speed_rpm": 9510.0}, "must lie within the data's speeds"),
    ],
)
def test_a_prediction_that_the_data_do_not_allow(
    changes: dict[str, Any], words: str, run: Run, base: Config, mine: Path
) -> None:
    """The twin is judged on an unbalance that no run has, at a speed at which the coefficients are known."""
    prediction = type(base.machine.prediction).model_validate(base.machine.prediction.model_dump() | changes)
    with refused(words, kind=ConfigError):
        run("predict", with_machine(base, prediction=prediction), mine)
