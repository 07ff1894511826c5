"""The figures that README prints are those of the graph, to every digit printed. Slow: they are read from artifacts."""

from __future__ import annotations

import re
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
from conftest import Artifacts

ROOT = Path(__file__).resolve().parents[2]
README = (ROOT / "README.md").read_text(encoding="utf-8")
Figure = Callable[[Artifacts], float]


def worst(experiment: str, file: str, metric: str, names: tuple[str, ...] = ()) -> Figure:
    """The largest ``metric`` of ``file`` over bearings and coefficients (those of ``names``, or all)."""

    def figure(artifacts: Artifacts) -> float:
        of: Any = artifacts.read(experiment, file)["coefficients"]
        return max(each[metric] for node in of.values() for name, each in node.items() if not names or name in names)

    return figure


def displacement(experiment: str) -> Figure:
    """Error of the vibration never seen, the worse of x and y."""
    return lambda artifacts: max(
        of["mean_error_percent"] for of in artifacts.read(experiment, "prediction")["displacement"].values()
    )


def held_out_run(experiment: str) -> Figure:
    """Error of the run that was not fitted."""
    return lambda artifacts: artifacts.read(experiment, "metrics")["fit"]["held_out_runs"]["error_percent"]


def paper_row(experiment: str, name: str) -> list[Figure]:
    """A row of the first table: the committed seed, and the worst start."""
    return [
        worst(experiment, "metrics", "mean_error_percent", (name,)),
        worst(experiment, "robustness", "worst_mean_error_percent", (name,)),
    ]


def noisy_row(experiment: str) -> list[Figure]:
    """A row of noisy data: the data set at hand, a typical one, the bound."""
    return [
        worst(experiment, "metrics", "median_error_percent"),
        worst(experiment, "robustness", "median_error_percent"),
        worst(experiment, "robustness", "median_bound_percent"),
    ]


def median(experiment: str) -> list[Figure]:
    """The committed seed's median error over speed."""
    return [worst(experiment, "metrics", "median_error_percent")]


def seeds(experiment: str) -> list[Figure]:
    """The same, and that of the worst seed."""
    return [*median(experiment), worst(experiment, "robustness", "worst_median_error_percent")]


ROWS: dict[str, list[Figure]] = {
    "| `ball_bearing` (Table 1) | kxx | 0.56 |": paper_row("ball_bearing", "kxx"),
    "| | kyy | 0.78 |": paper_row("ball_bearing", "kyy"),
    "| `hydrostatic_stiffness` (Figure 3) | kxx | 0.002 |": paper_row("hydrostatic_stiffness", "kxx"),
    "| | kyy | 0.001 |": paper_row("hydrostatic_stiffness", "kyy"),
    "| `hydrostatic_damping` (Figures 3, 4) | cxx | 0.005 |": paper_row("hydrostatic_damping", "cxx"),
    "| | cyy | 0.054 |": paper_row("hydrostatic_damping", "cyy"),
    "from `hydrostatic_stiffness` | x, y at the disc | a curve |": [displacement("hydrostatic_stiffness")],
    "from `hydrostatic_damping` | x, y at the disc | a curve |": [displacement("hydrostatic_damping")],
    "| three unbalances, the paper's Adam on the residual |": median("all_coefficients_paper"),
    "| `all_coefficients` | three unbalances |": seeds("all_coefficients"),
    "| `all_coefficients_backward` | and a force that turns backward |": seeds("all_coefficients_backward"),
    "| `compressor_two_journals` | three unbalances, a published compressor rotor |": seeds("compressor_two_journals"),
    "| `noisy_stiffness_residual` | kxx, kyy, by the paper's residual |": median("noisy_stiffness_residual"),
    "| `noisy_stiffness` | kxx, kyy |": noisy_row("noisy_stiffness"),
    "| `noisy_direct` | kxx, kyy, cxx, cyy |": noisy_row("noisy_direct"),
    "| `noisy_all` | all eight |": noisy_row("noisy_all"),
    "from hammer blows at 60 speeds |": median("impulses"),
    "| `measured_demo` | kxx, kyy, cxx, cyy, from synthetic recordings of run-ups |": [held_out_run("measured_demo")],
}


def agrees(printed: str, value: float) -> bool:
    """Whether a printed figure is ``value`` to its digits, or the bound of it that it says."""
    found = re.fullmatch(r"([<>] )?(?:[a-z ]+: )?([\d.]+(?:e-\d+)?)", printed)
    assert found, printed
    if found[1]:
        return value < float(found[2]) if found[1] == "< " else value > float(found[2])
    return f"{value:.{len(found[2].partition('.')[2])}f}" == found[2]


@pytest.mark.slow
@pytest.mark.parametrize("row", ROWS)
def test_a_row_of_the_readme_is_what_the_graph_made(row: str, artifacts: Artifacts) -> None:
    lines = [line for line in README.splitlines() if row in line]
    assert len(lines) == 1, lines
    printed = [cell.strip() for cell in lines[0].split(row)[1].split("|")]
    values = [figure(artifacts) for figure in ROWS[row]]
    print(row, list(zip(printed, values, strict=False)))
    assert [agrees(text, value) for text, value in zip(printed, values, strict=False)] == [True] * len(values)


def test_every_row_with_a_figure_is_held() -> None:
    tables = README[: README.index("All are trained as configured")]
    rows = [line for line in tables.splitlines() if line.startswith("| ") and not line.startswith("| experiment")]
    missing = [line for line in rows if not any(row in line for row in ROWS) and "refused" not in line]
    assert missing == []


@pytest.mark.parametrize(
    ("printed", "value", "right"),
    [("0.0021", 0.00212, True), ("0.0021", 0.00216, False), ("< 1e-12", 1e-13, True), ("> 150", 149.0, False)],
)
def test_a_figure_agrees_to_its_digits(printed: str, value: float, right: bool) -> None:
    assert agrees(printed, value) is right
