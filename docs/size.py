"""How large the house is, and what it may be: `make size` prints it, tests/test_structure.py holds the budgets.

A room that needs more than its budget says why in the commit that raises it; what is deleted lowers it.
"""

from __future__ import annotations

import ast
import subprocess
import sys
import tempfile
from collections import Counter
from collections.abc import Iterator
from functools import cache
from pathlib import Path

ROOT = Path(__file__).resolve().parents[1]
PACKAGE = ROOT / "pipeline"

EMPTY = frozenset({"one", "found", "own", "of", "words", "part", "moved", "there", "along"})
"""Words that say nothing of what they name."""

STATEMENTS = {
    "config": 1715,
    "laws": 493,
    "rotor": 737,
    "data": 1065,
    "parameters": 451,
    "sweep": 247,
    "ingest": 1620,
    "problem": 1528,
    "identification": 2912,
    "evaluation": 208,
    "twin": 490,
    "balance": 670,
    "trust": 680,
    "export": 159,
    "methods": 545,
    "comparison": 112,
    "tuning": 480,
    "reporting": 2440,
    "tracking": 336,
    "stages": 1071,
    "beside the rooms": 570,
}
"""Room -> the most statements that it may have, without imports and docstrings."""

BUDGETS = {
    "statements of pipeline/": (18529, 14500),
    "files": (249, 250),
    "classes": (321, 260),
    "is None, is not None": (318, 420),
    "isinstance on configurations": (7, 10),
    "numeric constants of modules": (43, 150),
    "bindings named by empty words": (115, 200),
    "statements of tests/": (13000, 13000),
    "words of docs/ beside the reference": (30000, 30000),
    "pages of docs/ beside the reference": (20, 20),
    "modules without a test of their name": (61, 0),
    "functions entered by ingest and train of measured_demo": (773, 380),
    "their files": (111, 75),
}
"""Measure -> the most that it may be, and what it is to become."""

BEYOND = {
    ("reporting",): (
        1900,
        "each stage's sentences, tables and figures; a page, a PDF and PNGs of the same values, laid out twice "
        "(Plotly, Matplotlib); a study's report; tables of a comparison",
    ),
    ("identification",): (
        1800,
        "two kinds of rows (the paper's residual, output error); the search over kinds of bearings; bands of several "
        "answers; networks trained near the nodes; senses of phases",
    ),
    ("stages",): (1400, ""),
    ("config", "beside the rooms"): (
        1800,
        "sections of recordings (8 formats), units, messages with the nearest key; machines of one's own; the jobs "
        "of a multirun, exit codes, pools",
    ),
    ("problem", "parameters", "trust"): (
        1700,
        "what is expected before a fit, and the design of runs; levels of noise of records; Kalman and expansion; "
        "mistakes by name",
    ),
    ("balance",): (650, "records of another day"),
    ("tuning", "tracking"): (
        600,
        "trials that keep their places through Ctrl-C and dead workers, on several machines; finalists over seeds, "
        "trials as text; MLflow in a process of its own, a database made once, models that load without the house",
    ),
    ("methods", "comparison"): (650, "eight conventional methods and their cases"),
    ("laws", "rotor", "data", "sweep", "ingest", "evaluation", "twin", "export"): (
        4000,
        "formats read as files of strangers; supports; films as laws and as a population; run-ups; exports",
    ),
}
"""Rooms -> the statements that they are to become, and what stands there beyond them."""

ENTERED = "functions entered by ingest and train of measured_demo"
ENTERED_FILES = "their files"


@cache
def list_nodes(tree: ast.AST) -> list[ast.AST]:
    """Every node below ``tree``, and itself."""
    return list(ast.walk(tree))


def count_statements(tree: ast.AST) -> int:
    """Without imports and docstrings."""
    return sum(
        isinstance(node, ast.stmt) and not isinstance(node, ast.Import | ast.ImportFrom) and not _is_text(node)
        for node in list_nodes(tree)
    )


def _is_text(node: ast.AST) -> bool:
    """A docstring: of a module, a class, a function or the constant above it."""
    return isinstance(node, ast.Expr) and isinstance(node.value, ast.Constant) and isinstance(node.value.value, str)


def list_bindings(tree: ast.AST) -> Iterator[str]:
    """What is assigned, a parameter, a field, a function or a class, each time."""
    for node in list_nodes(tree):
        if isinstance(node, ast.Name) and isinstance(node.ctx, ast.Store):
            yield node.id
        elif isinstance(node, ast.arg):
            yield node.arg
        elif isinstance(node, ast.FunctionDef | ast.ClassDef):
            yield node.name


def _is_number(node: ast.AST) -> bool:
    """A constant of a module that is a number."""
    if not isinstance(node, ast.Assign | ast.AnnAssign) or node.value is None:
        return False
    try:
        value = ast.literal_eval(node.value)
    except ValueError:
        return False
    return isinstance(value, int | float) and not isinstance(value, bool)


def _asks_for_a_kind(node: ast.AST) -> bool:
    """``isinstance(..., SomeConfig)``."""
    if not (isinstance(node, ast.Call) and isinstance(node.func, ast.Name) and node.func.id == "isinstance"):
        return False
    return "Config" in ast.unparse(node.args[1])


def _asks_for_none(node: ast.AST) -> bool:
    """``is None`` and ``is not None``."""
    if not isinstance(node, ast.Compare) or not isinstance(node.ops[0], ast.Is | ast.IsNot):
        return False
    return isinstance(node.comparators[0], ast.Constant) and node.comparators[0].value is None


def measure_rooms() -> dict[str, int]:
    """Room -> statements; modules beside the rooms are one."""
    sizes: Counter[str] = Counter()
    for path in PACKAGE.rglob("*.py"):
        room = path.relative_to(PACKAGE).parts[0]
        sizes["beside the rooms" if room.endswith(".py") else room] += count_statements(parse(path))
    return dict(sizes)


def measure_house() -> dict[str, int]:
    """The measures of BUDGETS."""
    trees = [parse(path) for path in PACKAGE.rglob("*.py")]
    nodes = [node for tree in trees for node in list_nodes(tree)]
    names = [name for tree in trees for name in list_bindings(tree)]
    pages = [path for path in (ROOT / "docs").glob("*.md") if path.name != "configuration.md"]
    return {
        "statements of pipeline/": sum(map(count_statements, trees)),
        "files": len(trees),
        "classes": sum(isinstance(node, ast.ClassDef) for node in nodes),
        "is None, is not None": sum(map(_asks_for_none, nodes)),
        "isinstance on configurations": sum(map(_asks_for_a_kind, nodes)),
        "numeric constants of modules": sum(_is_number(node) for tree in trees for node in tree.body),
        "bindings named by empty words": sum(bool(EMPTY & set(name.split("_"))) for name in names),
        "statements of tests/": sum(count_statements(parse(path)) for path in (ROOT / "tests").rglob("*.py")),
        "words of docs/ beside the reference": sum(len(path.read_text(encoding="utf-8").split()) for path in pages),
        "pages of docs/ beside the reference": len(pages),
        "modules without a test of their name": sum(map(_lacks_test, PACKAGE.rglob("[!_]*.py"))),
    }


def _lacks_test(path: Path) -> bool:
    """Whether ``tests/ROOM/test_x.py`` is not there for ``pipeline/ROOM/x.py``."""
    return not (ROOT / "tests" / path.relative_to(PACKAGE).parent / f"test_{path.name}").exists()


@cache
def parse(path: Path) -> ast.Module:
    """A module of the house."""
    return ast.parse(path.read_text(encoding="utf-8"), str(path))


_PROFILED = """
import json, sys
from pathlib import Path
import pipeline
root, entered = str(Path(pipeline.__file__).parent), set()
def note(frame, event, value):
    code = frame.f_code  # 1: of a function, not the body of a class; <lambda> and <genexpr> are no functions of ours
    if event == "call" and code.co_filename.startswith(root) and code.co_flags & 1 and code.co_name[0] != "<":
        entered.add((code.co_filename, code.co_firstlineno))
from pipeline.__main__ import main
sys.setprofile(note)
code = main(sys.argv[2:])
sys.setprofile(None)
Path(sys.argv[1]).write_text(json.dumps([len(entered), len({name for name, _ in entered})]))
sys.exit(code)
"""


def count_entered() -> dict[str, int]:
    """Functions of the pipeline that the demo enters by ingest and train, and their files."""
    import json

    with tempfile.TemporaryDirectory() as folder:
        counts = Path(folder) / "counts.json"
        given = ["stage=[ingest,train]", "experiment=measured_demo", "tracking=none", f"output={folder}/demo"]
        subprocess.run(
            [sys.executable, "-c", _PROFILED, str(counts), *given], cwd=ROOT, check=True, capture_output=True
        )
        functions, files = json.loads(counts.read_text())
    return {ENTERED: functions, ENTERED_FILES: files}


def show() -> None:
    """Print every measure beside its budget."""
    from rich.console import Console
    from rich.table import Table

    house, rooms = measure_house() | count_entered(), measure_rooms()
    whole = Table("the house", "today", "budget", "aim")
    for name, (budget, aim) in BUDGETS.items():
        whole.add_row(name, f"{house[name]:,}", f"{budget:,}", f"{aim:,}")
    parts = Table("room", "statements", "budget")
    for name, budget in STATEMENTS.items():
        parts.add_row(name, f"{rooms[name]:,}", f"{budget:,}")
    groups = Table("rooms", "statements", "aim", "what stands there beyond the aim")
    for names, (aim, reason) in BEYOND.items():
        groups.add_row(", ".join(names), f"{sum(rooms[name] for name in names):,}", f"{aim:,}", reason)
    Console().print(whole, parts, groups)


if __name__ == "__main__":
    show()
