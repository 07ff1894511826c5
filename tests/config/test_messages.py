"""Mistakes in overrides and values are sentences that name the key, the law and the nearest name."""

from __future__ import annotations

from copy import deepcopy
from functools import cache
from pathlib import Path
from typing import Any

import pytest
from conftest import refused

from pipeline.config.compose import compose_config, compose_mapping, validate
from pipeline.errors import ConfigError

FOREIGN = ("Traceback", "struct", "hydra.cc", "HYDRA_FULL_ERROR", "pydantic", "Input should")


@cache
def _default() -> dict[str, Any]:
    return compose_mapping()


OVERRIDES = [
    (
        ["experiment=ball_baering"],
        ["a file in conf/experiment", "'ball_baering'", "did you mean 'ball_bearing'?"],
    ),
    (["experiment="], ["a file in conf/experiment", "known: all_coefficients"]),
    (["experiment=null"], ["a file in conf/experiment", "but got null"]),
    (["+experiment=ball_bearing"], ["write 'experiment=ball_bearing'"]),
    (["model=konstant"], ["a file in conf/model", "did you mean 'constant'?"]),
    (["machine=5"], ["a file in conf/machine", "but got 5"]),
    (["hydra/launcher=nothing"], ["an installed Hydra plugin", "'nothing'"]),
    (["optimizer.adam.stepz=3"], ["optimizer.adam has no 'stepz'", "did you mean 'steps'?"]),
    (["optimzer=adam"], ["has no 'optimzer'", "did you mean 'optimizer'?"]),
    (["adam.steps=3"], ["there is no 'adam.steps'", "did you mean 'optimizer.adam.steps'?"]),
    (["seed.x=1"], ["seed is a single value", "give seed=VALUE"]),
    (["machine.rotor.shaft.99.length=1"], ["machine.rotor.shaft has the items 0 to", "not '99'"]),
    (["aa=1", "~optimizer.sgd"], ["has no 'aa'", "optimizer has no 'sgd'"]),
    (["foo"], ["KEY=VALUE", "'foo'", "stage=train"]),
    (["train"], ["KEY=VALUE", "did you mean 'stage=train'?"]),
    (["=3"], ["KEY=VALUE", "'=3'"]),
    (["seed=[1,2"], ["close its brackets", "'seed=[1,2'"]),
    (["output=/tmp/a(b)"], ["""write 'output="/tmp/a(b)"'"""]),
    (["seed=1,2"], ["one value for seed", "'1,2'", "add -m"]),
    (["output=${nothing}"], ["output must refer to what exists", "'nothing'"]),
    (["seed=???"], ["add seed=VALUE"]),
    (["experiment=hydrostatic_stiffness", "+loss.hidden=trained"], ["must come with kind: response"]),
    (["experiment=realistic", "training.device=cuda"], ["training.device=cuda must go with loss=residual"]),
    (
        ["stage=robustness", "robustness=seeds", "experiment=noisy_stiffness"],
        ["must have loss=residual or loss=preconditioned, but got loss=response"],
    ),
]


@pytest.mark.parametrize(("overrides", "fragments"), OVERRIDES)
def test_sentences_for_overrides(overrides: list[str], fragments: list[str]) -> None:
    with refused(*fragments, kind=ConfigError) as caught:
        compose_config(overrides)
    assert [word for word in FOREIGN if word in str(caught.value)] == []


VALUES = [
    ({"stage": ""}, "stage must be one of the stages, but got ''"),
    ({"stage": ["a"]}, "stage must be one of the stages, but got ['a']"),
    ({"unknown": 1}, "unknown: must be a key that the schema knows"),
    (
        {"optimizer.adam.stepz": 1},
        "optimizer.adam.stepz: must be a key that the schema knows, but 'stepz' is not; did",
    ),
    (
        {"model.widht": 1},
        "model.widht: must be a key that the schema knows, but 'widht' is not; did you mean 'width'?",
    ),
    ({"machine.rotor.shaft.0.lenght": 1}, "machine.rotor.shaft.0.lenght: must be a key"),
    (
        {"machine.rotor.shaft.0.length": "-3 mm"},
        "machine.rotor.shaft.0.length: must be greater than 0, but got '-3 mm'",
    ),
    (
        {"machine.rotor.shaft.0.length": "3 kg"},
        "machine.rotor.shaft.0.length: must convert to m (such as 150 mm), but got '3 kg'",
    ),
    ({"seed": "x"}, "seed: must be a valid integer, but got 'x'"),
    ({"seed": 1.5}, "seed: must be a valid integer, but got 1.5"),
    ({"seed": None}, "seed: must be a valid integer, but got null"),
    ({"identify.unknowns": []}, "identify.unknowns: must have at least 1 item"),
    (
        {"identify.known_stiffness": "1e6 N/m"},
        "identify: known_stiffness and known_damping must have known_within, a factor such as 30",
    ),
    (
        {"identify.unknowns": ["kxz"]},
        "identify.unknowns.0: must be one of these, but got 'kxz'; did you mean",
    ),
    (
        {"model.activation": "tnh"},
        "model.activation: must be one of these, but got 'tnh'; did you mean 'tanh'?",
    ),
    (
        {"machine.bearings.kind": "bal"},
        "machine.bearings.kind: must be one of these, but got 'bal'; did you mean 'ball'?",
    ),
    ({"machine.bearings": {}}, "machine.bearings.kind: must be given, but is missing"),
    ({"optimizer": {}}, "optimizer.adam: must be given, but is missing"),
    ({"optimizer": "x" * 500}, "optimizer: must be a group of keys, but got 'xxxxx"),
    ({"machine.bearings": 5}, "machine.bearings: must be a group of keys, but got 5"),
    ({"identify.unknowns": "kxx"}, "identify.unknowns: must be a list, but got 'kxx'"),
]


def _changed(changes: dict[str, Any]) -> dict[str, Any]:
    mapping = deepcopy(_default())
    for path, value in changes.items():
        *parents, last = path.split(".")
        node: Any = mapping
        for part in parents:
            node = node[int(part)] if part.isdigit() else node[part]
        node[last] = value
    return mapping


@pytest.mark.parametrize(("changes", "sentence"), VALUES)
def test_sentences_for_values(changes: dict[str, Any], sentence: str) -> None:
    with refused(sentence, kind=ConfigError) as caught:
        validate(_changed(changes))
    assert [word for word in FOREIGN if word in str(caught.value)] == []
    assert all(len(line) < 340 for line in str(caught.value).splitlines())


def test_every_error_of_the_schema_has_a_line_of_its_own() -> None:
    with pytest.raises(ConfigError) as caught:
        validate(_changed({"seed": "x", "threads": 0, "loss.scaling": 5}))
    *lines, last = str(caught.value).splitlines()
    assert sorted(line.split(":")[0] for line in lines) == ["loss.scaling", "seed", "threads"]
    assert "these 3 values" in last


@pytest.mark.parametrize(
    "changes", [{"identify.unknowns": ["kxz"]}, {"comparison.methods": ["kalmann"]}, {"comparison.noise": [2]}]
)
def test_a_wrong_item_does_not_make_its_list_too_short(changes: dict[str, Any]) -> None:
    with pytest.raises(ConfigError) as caught:
        validate(_changed(changes))
    assert "at least 1 item" not in str(caught.value)
    assert str(caught.value).endswith(
        "Correct this value; `python -m pipeline --cfg job` prints the whole configuration."
    )


@pytest.mark.parametrize(
    ("line", "words"),
    [
        ("seed: [1", r"config\.yaml"),
        ("seed: 1\nseed: 2", r'duplicate key seed\s+in ".*config\.yaml", line 3, column 1'),
        ("seed: ${", "Hydra says"),
    ],
)
def test_a_broken_file_in_conf_is_named(line: str, words: str, monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    (tmp_path / "config.yaml").write_text(f"defaults: [_self_]\n{line}\n")
    for folder, says in ((tmp_path, words), (tmp_path / "nothing", "conf/ must lie beside the package")):
        monkeypatch.setattr("pipeline.config.loader.CONF", folder)
        with pytest.raises(ConfigError, match=says):
            compose_config([])
