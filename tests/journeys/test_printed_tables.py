"""The tables that README and docs print are those of the graph and of docs/measured: `make tables` writes them."""

from __future__ import annotations

import json
import re
from pathlib import Path

import pytest
from conftest import ARTIFACTS

from docs.tables import MEASURED, PAGES, ROOT, fill, find_differences, needs_artifacts, read_tables, read_templates

TEMPLATES = read_templates()
PRINTED = [(page, name) for page in PAGES for name in read_tables(page)]
NUMBER = re.compile(r"\| (?:[<>] )?[\d.e-]+ (?=\|)")


def test_every_template_is_printed() -> None:
    assert {name for _, name in PRINTED} == set(TEMPLATES)


@pytest.mark.parametrize("page", PAGES)
def test_no_figure_stands_in_a_table_of_its_own(page: str) -> None:
    text = (ROOT / page).read_text(encoding="utf-8")
    for table in read_tables(page).values():
        text = text.replace(table, "")
    assert [line for line in text.splitlines() if NUMBER.search(line)] == []


@pytest.mark.parametrize(("page", "name"), [each for each in PRINTED if not needs_artifacts(TEMPLATES[each[1]])])
def test_a_table_is_what_was_measured_once(page: str, name: str) -> None:
    assert read_tables(page)[name] == fill(TEMPLATES[name], ARTIFACTS), "make tables"


@pytest.mark.slow
@pytest.mark.parametrize(("page", "name"), [each for each in PRINTED if needs_artifacts(TEMPLATES[each[1]])])
def test_a_table_is_what_the_graph_made(page: str, name: str) -> None:
    """To one in the last digit; `make tables` writes the others."""
    assert find_differences(read_tables(page)[name], fill(TEMPLATES[name], ARTIFACTS)) == []


def test_what_was_measured_says_how() -> None:
    """Every figure of docs/measured has its command, and a table prints it."""
    templates = "".join(TEMPLATES.values())
    for path in MEASURED.glob("*.json"):
        for name, entry in json.loads(path.read_text(encoding="utf-8")).items():
            assert entry["command"].startswith(("python -m pipeline stage=", "python studies/"))
            for figure in entry["figures"]:
                least = "least " if figure.startswith("least ") else ""
                assert f"{least}{path.stem}/{name}/{figure.removeprefix('least ')}" in templates


@pytest.fixture
def measured(tmp_path: Path) -> Path:
    """Artifacts of an experiment with three figures."""
    (tmp_path / "x").mkdir()
    (tmp_path / "x" / "metrics.json").write_text(json.dumps({"a": {"1": 0.01236, "2": 173.2, "3": 4e-14}}))
    return tmp_path


@pytest.mark.parametrize(
    ("template", "text"),
    [
        ("{x/metrics.a.1}", "0.012"),
        ("{x/metrics.a.1 :3}", "0.0124"),
        ("{x/metrics.a.*}", "170"),
        ("{x/metrics.a.2 :d}", "173"),
        ("{x/metrics.a.2 :>150}", "> 150"),
        ("{x/metrics.a.2 *0.5 :3}", "86.6"),
        ("{least x/metrics.a.*}", "rounding, < 1e-10"),
    ],
)
def test_a_figure_in_its_digits(template: str, text: str, measured: Path) -> None:
    assert fill(template, measured) == text


@pytest.mark.parametrize(
    "template", ["{x/metrics.b}", "{y/metrics.a.1}", "{x/metrics.a.2 :>174}", "{losses/no/training.steps}"]
)
def test_a_figure_that_was_not_measured_is_refused(template: str, measured: Path) -> None:
    with pytest.raises(ValueError, match="must"):
        fill(template, measured)


@pytest.mark.parametrize(
    ("printed", "made", "same"),
    [
        ("| a | 0.38 |\n", "| a | 0.39 |\n", True),
        ("| a | 0.38 |\n", "| a | 0.40 |\n", False),
        ("| a | 0.38 |\n", "| b | 0.38 |\n", False),
        ("| a | 200 |\n", "| a | 300 |\n", True),
        ("| a | 197 |\n", "| a | 199 |\n", False),
        ("| a | 0.38 |\n", "| a | 0.38 |\n| b | 1 |\n", False),
    ],
)
def test_a_difference_is_more_than_one_in_the_last_digit(printed: str, made: str, same: bool) -> None:
    assert (find_differences(printed, made) == []) is same
