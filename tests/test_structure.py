"""The walls of the design, read from the source: who imports what, and what never appears."""

from __future__ import annotations

import ast
import importlib
import os
import pkgutil
import re
import subprocess
import sys
from collections.abc import Iterator
from dataclasses import dataclass
from functools import cache
from graphlib import TopologicalSorter
from pathlib import Path

import pytest

from docs.house import ROOMS, count_imports, room_of
from docs.size import (
    BUDGETS,
    EMPTY,
    ENTERED,
    ENTERED_FILES,
    STATEMENTS,
    count_statements,
    list_bindings,
    list_nodes,
    measure_house,
    measure_rooms,
    parse,
)

ROOT = Path(__file__).resolve().parents[1]
PACKAGE = ROOT / "pipeline"
CONF = ROOT / "conf"

STEPS = [set(names) for names, _ in ROOMS]
"""The straight line: a module may import its own step and earlier ones."""

HOMES = {
    "ross": ["rotor/ross_adapter.py"],
    "mlflow": ["tracking/"],
    "optuna": ["tuning/"],
    "optuna_dashboard": ["tuning/"],
    "hydra": ["__main__.py", "config/"],
    "omegaconf": ["__main__.py", "config/"],
    "h5py": ["ingest/recordings.py", "data/mat_files.py"],
    "nptdms": ["ingest/recordings.py"],
    "pyuff": ["ingest/uff.py"],
    "sklearn": ["methods/"],
}
"""Where alone a package may be imported."""

AT_ONCE = {"numpy", "pydantic"}
"""What a module may import when it is imported itself; everything else waits until it is used."""

ALL_HEAVY = {
    "tracking/predictor.py": "subclasses MLflow's PythonModel, and is itself imported by functions only",
}
"""Modules that import heavy packages at once, and why that costs nobody."""


@dataclass(frozen=True)
class Import:
    """One imported module."""

    file: str  # below pipeline/
    line: int
    name: str
    inside_function: bool
    for_types_only: bool

    def __str__(self) -> str:
        return f"pipeline/{self.file}:{self.line} imports {self.name}"

    @property
    def root(self) -> str:
        return self.name.partition(".")[0]


@cache
def sources() -> dict[str, ast.Module]:
    """Every module of the package, parsed."""
    return {path.relative_to(PACKAGE).as_posix(): parse(path) for path in sorted(PACKAGE.rglob("*.py"))}


@cache
def imports() -> tuple[Import, ...]:
    """Every import of every module."""
    return tuple(found for file, tree in sources().items() for found in _imports(file, tree, inside=False, types=False))


def _imports(file: str, node: ast.AST, inside: bool, types: bool) -> Iterator[Import]:
    for child in ast.iter_child_nodes(node):
        if isinstance(child, ast.If) and ast.unparse(child.test) in ("TYPE_CHECKING", "typing.TYPE_CHECKING"):
            for part in child.body:
                yield from _imports(file, ast.Module([part], []), inside, True)
            for part in child.orelse:
                yield from _imports(file, ast.Module([part], []), inside, types)
            continue
        function = isinstance(child, (ast.FunctionDef, ast.AsyncFunctionDef, ast.Lambda))
        if isinstance(child, ast.Import):
            names = [alias.name for alias in child.names]
        elif isinstance(child, ast.ImportFrom):
            names = _from(child)
        else:
            yield from _imports(file, child, inside or function, types)
            continue
        for name in names:
            yield Import(file, child.lineno, name, inside, types)


def _from(node: ast.ImportFrom) -> list[str]:
    assert not node.level, "modules are named from the package on"
    module = node.module or ""
    # `from package import module` imports the module; `from module import name` doesn't say which it is.
    inner = [f"{module}.{alias.name}" for alias in node.names]
    return inner if module == "pipeline" or module == "scipy" else [module]


def step_of(name: str) -> int:
    """The place on the straight line of a module, named as in an import."""
    return room_of(name.removeprefix("pipeline."))


def test_every_module_has_a_place_on_the_line() -> None:
    """A new package of the pipeline must be put on the straight line, or this test would not watch it."""
    parts = {Path(file).parts[0].removesuffix(".py") for file in sources()} - {"__init__"}
    assert parts == {name for name in set().union(*STEPS) if "." not in name}
    assert {name for name in set().union(*STEPS) if "." in name} <= {
        file.removesuffix(".py").replace("/", ".") for file in sources()
    }


def test_no_module_imports_a_later_step() -> None:
    """Each step of the line knows earlier ones only, inside functions too; types may come from anywhere."""
    inside = [i for i in imports() if i.name.startswith("pipeline.") and not i.for_types_only]
    assert len(inside) > 50
    later = [
        str(i)
        for i in inside
        if step_of(i.name) > step_of(i.file.removesuffix(".py").replace("/", ".")) and i.file != "__init__.py"
    ]
    assert later == []


def test_no_circle_of_imports() -> None:
    """Modules of one step may know each other, but not in a circle."""
    graph: dict[str, set[str]] = {}
    for i in imports():
        if i.root == "pipeline" and not i.for_types_only and not i.inside_function:
            own = ("pipeline." + i.file.removesuffix(".py").replace("/", ".")).removesuffix(".__init__")
            graph.setdefault(own, set()).update({i.name} - {own})  # __main__ imports itself by name
    TopologicalSorter(graph).prepare()  # raises for a circle, and names it


def test_the_picture_of_the_house_has_no_import_to_the_right() -> None:
    counts = count_imports()
    assert sum(map(sum, counts)) > 300
    assert not any(row[j] for i, row in enumerate(counts) for j in range(i + 1, len(row)))


@pytest.mark.parametrize("package", HOMES)
def test_a_package_is_imported_in_its_home_only(package: str) -> None:
    """ROSS behind one module, MLflow behind one package, Optuna in tuning, Hydra at the front door."""
    users = [i for i in imports() if i.root == package]
    assert [str(i) for i in users if not any(i.file.startswith(home) for home in HOMES[package])] == []
    homes = [home for home in HOMES[package] if (PACKAGE / home).exists()]
    assert [home for home in homes if not any(i.file.startswith(home) for i in users)] == []


def test_heavy_packages_wait_until_they_are_used() -> None:
    """At import time only numpy and pydantic come along: help and errors answer at once."""
    others = [
        str(i)
        for i in imports()
        if not (i.inside_function or i.for_types_only)
        and i.root not in sys.stdlib_module_names | {"pipeline"}
        and i.name not in AT_ONCE
        and i.file not in ALL_HEAVY
    ]
    assert others == []


@pytest.mark.parametrize("file", ALL_HEAVY)
def test_a_heavy_module_is_imported_inside_functions_only(file: str) -> None:
    module = "pipeline." + file.removesuffix(".py").replace("/", ".")
    users = [i for i in imports() if i.name == module or i.name.startswith(f"{module}.")]
    assert [str(i) for i in users if not (i.inside_function or i.for_types_only)] == []


HEAVY = [
    *("torch", "ross", "mlflow", "pandas", "matplotlib", "scipy.optimize", "pyarrow", "optuna", "plotly"),
    *("scipy.interpolate", "h5py", "nptdms", "pyuff", "openpyxl"),
]


@pytest.mark.slow
@pytest.mark.parametrize(
    ("modules", "absent"),
    [
        (["pipeline.config.schema"], [*HEAVY, "hydra", "pint"]),
        (["pipeline.stages"], [*HEAVY, "hydra", "pydantic", "numpy"]),
        (["pipeline.config.compose", "pipeline.stages.analysis", "pipeline.stages.measurement"], HEAVY),
        (["pipeline.stages.ingest"], HEAVY),
        (["pipeline.stages.train", "pipeline.stages.evaluate", "pipeline.stages.check"], HEAVY),
        (["pipeline.tracking", "pipeline.reporting.matplotlib_figures", "pipeline.twin.modes"], HEAVY),
    ],
    ids=lambda value: value[0].removeprefix("pipeline.") if value[0].startswith("pipeline") else None,
)
def test_importing_is_light(modules: list[str], absent: list[str]) -> None:
    """In a fresh interpreter, importing these modules loads none of the heavy packages."""
    code = (
        f"import importlib, sys\nfor name in {modules}: importlib.import_module(name)\n"
        f"print([name for name in {absent} if name in sys.modules])"
    )
    answer = subprocess.run(
        [sys.executable, "-W", "error", "-c", code],
        cwd=ROOT,
        env=os.environ | {"PYTHONPATH": str(ROOT)},
        capture_output=True,
        text=True,
        check=True,
    )
    assert answer.stdout.strip() == "[]"


def test_every_module_can_be_imported_by_itself() -> None:
    for module in pkgutil.walk_packages([str(PACKAGE)], "pipeline."):
        if module.name not in {"pipeline.__main__", "pipeline.tracking.predictor"}:
            importlib.import_module(module.name)


CODE_FROM_DATA = {
    *("pickle", "dill", "cloudpickle", "joblib", "shelve", "marshal"),
    *("torch.load", "torch.save", "np.load", "numpy.load", "pd.read_pickle", "pandas.read_pickle"),
    *("yaml.load", "yaml.unsafe_load", "yaml.full_load"),
}
BUILT_IN = {"eval", "exec", "compile", "__import__"}


@cache
def words() -> tuple[tuple[str, ast.expr, str], ...]:
    """File, node and text of every name, attribute and call of the package."""
    kinds = (ast.Attribute, ast.Name, ast.Call)
    return tuple(
        (file, node, ast.unparse(node.func if isinstance(node, ast.Call) else node))
        for file, tree in sources().items()
        for node in list_nodes(tree)
        if isinstance(node, kinds)
    )


def test_no_data_become_code() -> None:
    """No pickle, no torch.load, no eval, no shell; and no way round a wall by importlib with a constant."""
    for file, node, said in words():
        where = f"{file}, line {node.lineno}: {said}"
        if not isinstance(node, ast.Call):
            assert said not in CODE_FROM_DATA, where
            continue
        assert said not in BUILT_IN | {"os.system", "os.popen"}, where
        assert not said.endswith(".read_pickle"), where
        given = {k.arg: getattr(k.value, "value", True) for k in node.keywords}
        assert "allow_pickle" not in given, where
        assert not given.get("shell"), where
        if said.split(".")[-1] in ("import_module", "__import__"):
            named = {str(a.value).partition(".")[0] for a in node.args if isinstance(a, ast.Constant)}
            assert not named & HOMES.keys(), where
    assert not {i.root for i in imports()} & CODE_FROM_DATA


def test_every_module_says_what_it_is_for() -> None:
    """Each module starts with a sentence, and each public class and function of a module has one."""
    silent = []
    for file, tree in sources().items():
        public = [n for n in tree.body if isinstance(n, ast.FunctionDef | ast.ClassDef) and not n.name.startswith("_")]
        silent += [f"{file}: {getattr(n, 'name', '')}" for n in [tree, *public] if not ast.get_docstring(n)]
    assert silent == []


def test_rpm_and_degrees_are_converted_at_the_edge() -> None:
    """SI inside: the factors of rpm and degrees appear at the config, the files and what a person sees."""
    inner = {"problem", "identification", "rotor", "twin"}
    factors = {"RAD_S_PER_RPM", "to_rpm", *(f"np.{name}" for name in ("degrees", "radians", "deg2rad", "rad2deg"))}
    factors |= {"math.degrees", "math.radians"}
    assert [(file, said) for file, _, said in words() if Path(file).parts[0] in inner and said in factors] == []


EXPERIMENTS = sorted(path.stem for path in (CONF / "experiment").glob("*.yaml"))


@pytest.mark.parametrize("name", EXPERIMENTS)
def test_the_head_of_an_experiment_says_its_command_and_cost(name: str) -> None:
    lines = (CONF / "experiment" / f"{name}.yaml").read_text(encoding="utf-8").splitlines()
    head = [line for line in lines[:6] if line.startswith("#")]
    command = [line for line in head if "python -m pipeline" in line]
    assert command, head
    assert re.search(rf"experiment={name}(?![\w-])", command[0])
    assert re.search(r"\b\d+ (?:s|min)\b", command[0]), "the cost"


def test_every_threshold_file_is_of_an_experiment_or_of_the_drawn_machines() -> None:
    assert sorted(path.stem for path in (CONF / "thresholds").glob("*.yaml")) == sorted([*EXPERIMENTS, "ordinary"])


@pytest.mark.parametrize("path", sorted(CONF.rglob("*.yaml")), ids=lambda p: p.relative_to(CONF).as_posix())
def test_every_config_says_what_it_is(path: Path) -> None:
    """Each file of conf/ starts with a sentence."""
    assert re.match(r"# \S.{10,}", path.read_text(encoding="utf-8").splitlines()[0])


def test_every_room_keeps_its_budget() -> None:
    """`make size` prints them; raising one needs a reason in the commit."""
    rooms, house = measure_rooms(), measure_house()
    assert rooms.keys() == STATEMENTS.keys()
    assert house.keys() == BUDGETS.keys() - {ENTERED, ENTERED_FILES}
    assert [name for name, size in rooms.items() if size > STATEMENTS[name]] == []
    assert [name for name, size in house.items() if size > BUDGETS[name][0]] == []


def test_the_sizes_are_those_of_a_house_counted_by_hand() -> None:
    tree = ast.parse(
        '"""Text."""\nimport os\nLIMIT = 3\n"""Why."""\n\ndef ask(one, part_of=2):\n    found = one is not None\n'
        "    return [own for own in found if isinstance(own, MeanConfig)]\n"
    )
    assert count_statements(tree) == 4
    assert [name for name in list_bindings(tree) if EMPTY & set(name.split("_"))] == ["one", "part_of", "found", "own"]
