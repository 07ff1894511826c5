"""`dvc repro` runs what a change touches: the deps of every stage are what it imports, and what check needs is made."""

from __future__ import annotations

import ast
import re
from functools import cache
from pathlib import Path
from typing import Any

import pytest
import yaml

ROOT = Path(__file__).resolve().parents[1]
GRAPH = yaml.safe_load((ROOT / "dvc.yaml").read_text(encoding="utf-8"))
STAGES: dict[str, Any] = GRAPH["stages"]
EXPERIMENTS = sorted(path.stem for path in (ROOT / "conf" / "experiment").glob("*.yaml"))

HARMLESS = (
    "pipeline/tracking/",
    "pipeline/reporting/console.py",
    "pipeline/errors.py",
    "pipeline/cache.py",
    "pipeline/exits.py",
)
"""What a stage imports for its words and records alone: no file of an experiment follows from it."""


@cache
def imported(path: Path) -> frozenset[Path]:
    """The files of the package, and beside a study's script, that a file imports; not what only type checkers see."""
    found: set[str] = set()
    todo: list[ast.AST] = [ast.parse(path.read_text(encoding="utf-8"))]
    while todo:
        node = todo.pop()
        if isinstance(node, ast.If) and isinstance(node.test, ast.Name) and node.test.id == "TYPE_CHECKING":
            todo += node.orelse
            continue
        if isinstance(node, ast.Import):
            found |= {alias.name for alias in node.names}
        elif isinstance(node, ast.ImportFrom) and node.module:
            found |= {node.module, *(f"{node.module}.{alias.name}" for alias in node.names)}
        todo += ast.iter_child_nodes(node)
    files = {ROOT.joinpath(*name.split(".")).with_suffix(".py") for name in found if name.startswith("pipeline.")}
    if path.is_relative_to(ROOT / "studies"):
        files |= {path.with_name(f"{name}.py") for name in found if "." not in name}
    return frozenset(file for file in files if file.is_file())


def closure(program: str) -> set[str]:
    """All that the module of a stage, or a script, imports, directly or not. Other stages are run by name."""
    seen: set[Path] = set()
    todo = [ROOT / (program if program.endswith(".py") else f"pipeline/stages/{program}.py")]
    while todo:
        file = todo.pop()
        if file not in seen:
            seen.add(file)
            todo += imported(file)
    names = {file.relative_to(ROOT).as_posix() for file in seen}
    return {name for name in names if not name.startswith(HARMLESS)}


def stages_of(command: str) -> list[str]:
    """The stages of the pipeline that a command of dvc.yaml runs, or the script of a study."""
    if script := re.match(r"python (studies/\S+\.py)", command):
        return [script[1]]
    found = re.search(r"stage=(?:\[([\w,]+)\]|(\w+))", command)
    assert found, command
    return (found[1] or found[2]).split(",")


def experiments_of(name: str) -> list[str]:
    """The experiments of a stage, its list of them looked up."""
    given = STAGES[name]["matrix"]["experiment"]
    return list(given) if isinstance(given, list) else list(GRAPH["vars"][0][given.strip("${}")])


@pytest.mark.parametrize("name", STAGES)
def test_the_deps_of_a_stage_are_what_it_imports(name: str) -> None:
    """A changed module re-runs every stage that uses it, and no dependency is there for nothing."""
    deps = [dep for dep in STAGES[name]["deps"] if dep.startswith(("pipeline/", "studies/"))]
    needed = set().union(*(closure(stage) for stage in stages_of(STAGES[name]["cmd"])))
    covered = {file for file in needed for dep in deps if file == dep or file.startswith(f"{dep}/")}
    assert sorted(needed - covered) == []
    idle = [dep for dep in deps if not any(file == dep or file.startswith(f"{dep}/") for file in needed)]
    assert idle == []


@pytest.mark.parametrize("name", [name for name in STAGES if "params" in STAGES[name]])
def test_the_params_of_a_stage_are_keys_of_the_configuration(name: str) -> None:
    """As `configure` writes it: a key that is not there would be a change that nobody sees."""
    from pipeline.config.compose import compose_config

    mapping = compose_config(["experiment=hydrostatic_stiffness"]).model_dump(mode="json") | {"rotor_file": ""}
    for of in STAGES[name]["params"]:
        for key in next(iter(of.values())):
            node = mapping
            for part in key.split("."):
                assert part in node, key
                node = node[part]


def test_a_stage_reads_what_an_earlier_one_makes() -> None:
    """Files of artifacts/ that a stage depends on are outputs of another, for each of its experiments."""
    made = {
        out.replace("${item.experiment}", experiment)
        for name, stage in STAGES.items()
        if "matrix" in stage
        for experiment in experiments_of(name)
        for out in _outs(stage)
    }
    for name, stage in STAGES.items():
        for experiment in experiments_of(name) if "matrix" in stage else []:
            read = {d.replace("${item.experiment}", experiment) for d in stage["deps"] if d.startswith("artifacts/")}
            assert sorted(read - made) == [], name


def _outs(stage: dict[str, Any]) -> list[str]:
    listed = [*stage.get("outs", []), *stage.get("metrics", []), *stage.get("plots", [])]
    return [next(iter(out)) if isinstance(out, dict) else out for out in listed]


def test_every_experiment_is_in_the_graph() -> None:
    lists = GRAPH["vars"][0]
    assert sorted({*lists["modelled"], *lists["identified"]}) == EXPERIMENTS
    assert sorted([*lists["modelled"], *experiments_of("ingest"), *experiments_of("ingest_records")]) == EXPERIMENTS
    assert set(EXPERIMENTS) - set(lists["identified"]) == {"compressor_journal_and_isotropic"}


@pytest.mark.parametrize("experiment", EXPERIMENTS)
def test_what_check_reads_is_made(experiment: str) -> None:
    rules = yaml.safe_load((ROOT / "conf" / "thresholds" / f"{experiment}.yaml").read_text(encoding="utf-8"))
    made = {
        Path(out).name
        for name, stage in STAGES.items()
        if "matrix" in stage and experiment in experiments_of(name)
        for out in _outs(stage)
    }
    assert {rule.get("file", "metrics.json") for rule in rules} <= made


def test_no_study_is_in_the_graph() -> None:
    """Studies end differently on another processor: `make studies` repeats them, and a person promotes."""
    assert all({"tune", "samplers"}.isdisjoint(stages_of(stage["cmd"])) for stage in STAGES.values())
    assert all(not out.startswith("studies") for stage in STAGES.values() for out in _outs(stage))


def test_no_threshold_is_a_clock() -> None:
    """What another program or processor would flip is no outcome: `make bench` measures speed."""
    for path in (ROOT / "conf" / "thresholds").glob("*.yaml"):
        for rule in yaml.safe_load(path.read_text(encoding="utf-8")):
            assert not re.search(r"seconds|minutes|time", rule["metric"]), (path.name, rule["metric"])
