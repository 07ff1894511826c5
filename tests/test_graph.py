"""`dvc repro` runs what a change touches: the deps of every stage are what it imports, and what check needs is made."""

from __future__ import annotations

import re
from pathlib import Path
from typing import Any

import pytest
import yaml

from docs import graph

ROOT = Path(__file__).resolve().parents[1]
GRAPH = yaml.safe_load((ROOT / "dvc.yaml").read_text(encoding="utf-8"))
STAGES: dict[str, Any] = GRAPH["stages"]
EXPERIMENTS = sorted(path.stem for path in (ROOT / "conf" / "experiment").glob("*.yaml"))


def stages_of(command: str | list[str]) -> list[str]:
    """The stages of the pipeline that a command of dvc.yaml runs, or its study with those that this one runs."""
    if script := re.match(r"python (studies/\S+/(\w+)\.py)", command if isinstance(command, str) else command[0]):
        by_name = re.findall(r'"stage=\[([\w,]+)\]"', (ROOT / script[1]).read_text(encoding="utf-8"))
        return [f"study_{script[2]}", *(stage for names in by_name for stage in names.split(","))]
    if command == "python docs/graph.py configurations artifacts/configurations":
        return ["configure"]
    found = re.search(r"stage=(?:\[([\w,]+)\]|(\w+))", command if isinstance(command, str) else command[0])
    assert found, command
    return (found[1] or found[2]).split(",")


def experiments_of(name: str) -> list[str]:
    """The experiments of a stage, its list of them looked up."""
    given = STAGES[name]["matrix"]["experiment"]
    return list(given) if isinstance(given, list) else list(GRAPH["vars"][0][given.strip("${}")])


def params_of(name: str) -> dict[str, list[str]]:
    """File -> keys that a stage depends on."""
    return {file: keys for entry in STAGES[name].get("params", []) for file, keys in entry.items()}


@pytest.mark.parametrize("name", [name for name in STAGES if name != "code"])
def test_a_stage_depends_on_the_code_that_it_imports(name: str) -> None:
    """A changed module re-runs every stage that uses it: by its hash, and by no list kept by hand."""
    assert params_of(name)["artifacts/code.json"] == stages_of(STAGES[name]["cmd"])
    assert [dep for dep in STAGES[name].get("deps", []) if dep.startswith(("pipeline", "studies/"))] == []


def test_the_code_of_a_stage_is_what_it_imports() -> None:
    code = graph.hash_code()
    assert set(code) >= {stage for name in STAGES if name != "code" for stage in stages_of(STAGES[name]["cmd"])}
    assert {"pipeline", "config", "data", "rotor", "laws", "stages"} <= set(code["generate"])
    assert {"identification", "evaluation", "methods", "tracking", "tuning"}.isdisjoint(code["generate"])
    assert {"identification", "problem"} <= set(code["train"])
    assert "tracking" not in {room for rooms in code.values() for room in rooms}


def test_a_change_touches_the_stages_that_import_it(tmp_path: Path) -> None:
    """Tables beside the code count with it, wherever a module imports what it needs; types and records do not."""
    files = {
        "pipeline/stages/__init__.py": "",
        "pipeline/stages/fit.py": "import pipeline.errors\nfrom pipeline.room import film\n",
        "pipeline/stages/draw.py": "if TYPE_CHECKING:\n    import pipeline.room.film\n",
        "pipeline/room/__init__.py": "",
        "pipeline/room/film.py": "def load():\n    import pipeline.units\n",
        "pipeline/room/idle.py": "",
        "pipeline/room/tables/film.csv": "1",
        "pipeline/units.py": "",
        "pipeline/errors.py": "",
        "studies/folds/folds.py": "import peers\nfrom pipeline.units import RPM\n",
        "studies/folds/peers.py": "",
    }
    expected = {
        "pipeline/room/film.py": {"fit"},
        "pipeline/room/tables/film.csv": {"fit"},
        "pipeline/units.py": {"fit", "study_folds"},
        "studies/folds/peers.py": {"study_folds"},
        "pipeline/stages/draw.py": {"draw"},
        "pipeline/room/idle.py": set(),
        "pipeline/errors.py": set(),
    }

    def lay(changed: str) -> dict[str, dict[str, str]]:
        root = tmp_path / str(len(list(tmp_path.iterdir())))
        for name, text in files.items():
            (root / name).parent.mkdir(parents=True, exist_ok=True)
            (root / name).write_text(text + "\n" * (name == changed), encoding="utf-8")
        return graph.hash_code(root)

    before = lay("")
    assert {room for room in before["fit"]} == {"pipeline", "room", "stages"}
    for name, stages in expected.items():
        after = lay(name)
        assert {stage for stage in before if before[stage] != after[stage]} == stages, name


@pytest.mark.parametrize("name", [name for name, stage in STAGES.items() if "matrix" in stage])
def test_the_params_of_a_stage_are_keys_of_the_configuration(name: str, tmp_path: Path) -> None:
    """As `configure` writes it: a key that is not there would be a change that nobody sees."""
    from pipeline.config.compose import compose_config

    mapping = compose_config(["experiment=hydrostatic_stiffness"]).model_dump(mode="json") | {"rotor_file": ""}
    path = tmp_path / "config.yaml"
    path.write_text(yaml.safe_dump(mapping), encoding="utf-8")
    sections = graph.hash_sections(path)
    for key in params_of(name)["artifacts/configurations/${item.experiment}/sections.json"]:
        node: Any = sections
        for step in key.split("."):
            assert step in node, key
            node = node[step]
        assert isinstance(node, str), key


def test_a_changed_value_changes_the_hash_of_its_section_alone(tmp_path: Path) -> None:
    hashes = []
    for speed in (0.1, 0.2):
        path = tmp_path / f"{speed}.yaml"
        mapping = {"seed": 1, "machine": {"speeds": [speed], "rotor": {"shaft": 1}}}
        path.write_text(yaml.safe_dump(mapping), encoding="utf-8")
        hashes.append(graph.hash_sections(path))
    first, second = hashes
    assert first["machine"].pop("speeds") != second["machine"].pop("speeds")
    assert first == second


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
            read = {
                d.replace("${item.experiment}", experiment) for d in stage.get("deps", []) if d.startswith("artifacts/")
            }
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
    run = {stage for name in STAGES if name != "code" for stage in stages_of(STAGES[name]["cmd"])}
    assert "tune" not in run
    assert all(not out.startswith("studies") for stage in STAGES.values() for out in _outs(stage))
