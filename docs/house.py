"""The rooms of the package, what each is for, and the picture of who imports whom: `make house` draws it."""

from __future__ import annotations

import ast
import sys
from pathlib import Path

ROOT = Path(__file__).resolve().parents[1]
PACKAGE = ROOT / "pipeline"

ROOMS: tuple[tuple[frozenset[str], str], ...] = (
    (
        frozenset({"errors", "units", "files", "coefficients", "impedance", "unknowns", "processes", "write_numbers"}),
        "words, files, and what is unknown",
    ),
    (frozenset({"config"}), "sections of a configuration, units, sentences"),
    (frozenset({"laws"}), "bearings from few physical numbers"),
    (frozenset({"rotor"}), "shaft and discs as matrices; bearings over speed"),
    (frozenset({"data"}), "vibration, its files, sensors and noise"),
    (frozenset({"parameters"}), "uncertain numbers of the machine's model"),
    (frozenset({"sweep"}), "passing a critical speed; the fit of a run-up"),
    (frozenset({"ingest"}), "recordings and tables of instruments"),
    (
        frozenset(f"config.{name}" for name in ("machine", "schema", "compose", "promotion")),
        "a configuration composed of the sections of all rooms",
    ),
    (frozenset({"problem"}), "the measurement, its equations, what it determines"),
    (frozenset({"identification"}), "models, losses, optimisers: fit(measurement, setup)"),
    (frozenset({"evaluation"}), "errors, thresholds"),
    (frozenset({"twin"}), "predicted vibration, critical speeds, stability"),
    (frozenset({"balance"}), "weights and vibration: influence, unbalance, records that contradict it"),
    (frozenset({"trust"}), "verdicts: what speaks for an answer"),
    (frozenset({"export"}), "the answer in the formats of other programs"),
    (frozenset({"methods"}), "the conventional methods"),
    (frozenset({"comparison"}), "methods on cases"),
    (frozenset({"tuning"}), "hyperparameter studies (Optuna)"),
    (frozenset({"reporting"}), "tables, figures, words"),
    (frozenset({"tracking"}), "records (MLflow)"),
    (frozenset({"stages"}), "load, call, write, say"),
    (frozenset({"__main__"}), "the command line"),
)
"""In the order of the straight line of data: a room may import itself and earlier ones."""


def room_of(module: str) -> int:
    """The place on the line of a module below ``pipeline``, such as ``data.files``; -1 where it has none."""
    first, *rest = module.split(".")
    places = {name: i for i, (names, _) in enumerate(ROOMS) for name in names}
    return places.get(f"{first}.{rest[0]}" if rest else first, places.get(first, -1))


def count_imports() -> list[list[int]]:
    """(rooms, rooms) how many import lines of a room (row) name a module of another (column); types left out."""
    counts = [[0] * len(ROOMS) for _ in ROOMS]
    for path in PACKAGE.rglob("*.py"):
        own = room_of(path.relative_to(PACKAGE).with_suffix("").as_posix().replace("/", "."))
        if own < 0:
            continue
        for name in _imported(ast.parse(path.read_text(encoding="utf-8"))):
            other = room_of(name)
            if other >= 0:
                counts[own][other] += 1
    return counts


def _imported(tree: ast.AST) -> list[str]:
    found: list[str] = []
    for node in ast.iter_child_nodes(tree):
        if isinstance(node, ast.If) and "TYPE_CHECKING" in ast.unparse(node.test):
            continue
        if isinstance(node, ast.ImportFrom) and (node.module or "").startswith("pipeline."):
            found.append((node.module or "").removeprefix("pipeline."))
        else:
            found += _imported(node)
    return found


def draw(path: Path) -> None:
    """The rooms from top to bottom; each row shows what the room imports."""
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    counts = count_imports()
    groups = {"errors": "(words)", "config.schema": "(composition)", "usage": "(command)"}
    names = [next((group for name, group in groups.items() if name in room), min(room)) for room, _ in ROOMS]
    drawn = Figure(figsize=(11, 7.2), layout="constrained")
    FigureCanvasAgg(drawn)
    axes = drawn.subplots()
    for i, row in enumerate(counts):
        axes.axhline(i, color="#EEEEEE", lw=0.8, zorder=0)
        for j, count in enumerate(row):
            if count:
                colour = "#555555" if i == j else "#0072B2" if j < i else "#D55E00"
                axes.scatter(j, i, s=40 + 9 * count, color=colour, alpha=0.85)
                axes.text(j, i, str(count), ha="center", va="center", color="white", fontsize=7)
    axes.plot([-0.5, len(ROOMS) - 0.5], [-0.5, len(ROOMS) - 0.5], color="#555555", lw=0.8, ls=":")
    axes.set_xticks(range(len(names)), names, rotation=45, ha="left")
    axes.set_yticks(range(len(names)), [f"{name}: {words}" for name, (_, words) in zip(names, ROOMS, strict=True)])
    axes.xaxis.tick_top()
    axes.set_xlim(-0.6, len(ROOMS) - 0.4)
    axes.set_ylim(len(ROOMS) - 0.4, -0.6)
    axes.set_xlabel("imports (lines) from this room: every dot lies on the diagonal or left of it")
    for side in axes.spines.values():
        side.set_visible(False)
    path.parent.mkdir(parents=True, exist_ok=True)
    drawn.savefig(path, dpi=110)


if __name__ == "__main__":
    draw(Path(sys.argv[1]))
