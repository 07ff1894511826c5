"""README and the pages of docs: short, without dead links, and every command in them is one that the program takes."""

from __future__ import annotations

import itertools
import os
import re
import shlex
import subprocess
import sys
from pathlib import Path

import pytest
import yaml
from running import ENVIRONMENT, ROOT

DOCS = ROOT / "docs"
STUDIES = [path for path in (ROOT / "studies").rglob("*.md") if not (path.parent / "trials.csv").exists()]
"""Those that a person wrote; the report of a study is made."""
PAGES = [ROOT / "README.md", *sorted(DOCS.rglob("*.md")), *sorted(STUDIES), *sorted((ROOT / "examples").rglob("*.md"))]
BUILT_WITHOUT = {"measured/tables.md"}
"""Markdown that no page of the site is made of."""

_LINK = re.compile(r"\]\(([^)#]+)(?:#[^)]*)?\)")
_ITEM = re.compile(r"(- |\d+\. )")
_PARAGRAPH = re.compile(r"(?!- |\d+\. | {2}|#|\||<!--)\S")
_COMMAND = re.compile(r"^ {4,}(python -m pipeline .*)$", re.M)
_INLINE = re.compile(r"`(python -m pipeline [^`]*)`")
_ELSEWHERE = re.compile(r"machine\.file=|--config-dir|hydra/launcher|--help|--cfg|machine\.runs_file=|data\.known=my/")
"""Commands on files that a reader has, or that another test runs."""
_LONG = re.compile(r"stage=(compare|robustness|tune|senses|check)|postgresql|tracking\.uri")
"""Left out at night: many fits, which tests of their stages make of small machines; the check, which wants the results
of `make reproduce`; a database and a server that are not here."""


def commands(page: Path) -> list[str]:
    """The commands of a page, each on one line, with neither comments nor what the shell fills in."""
    text = page.read_text(encoding="utf-8").replace("\\\n", " ")
    found = [*_COMMAND.findall(text), *(" ".join(one.split()) for one in _INLINE.findall(text))]
    return [re.sub(r"\s+#.*", "", one) for one in found if not re.search(r"\b[A-Z]{3,}\b", one)]


COMMANDS = sorted({one for page in PAGES for one in commands(page) if not _ELSEWHERE.search(one)})


def test_readme_is_short() -> None:
    lines = (ROOT / "README.md").read_text(encoding="utf-8").splitlines()
    assert len(lines) <= 160
    assert [line for line in lines if len(line) > 100 and not line.startswith(("|", "![", "    "))] == []


@pytest.mark.parametrize("page", PAGES, ids=lambda page: str(page.relative_to(ROOT)))
def test_a_link_leads_somewhere(page: Path) -> None:
    """A link to another page, file or picture; those of the internet are left alone."""
    targets = _LINK.findall(page.read_text(encoding="utf-8"))
    assert [one for one in targets if "://" not in one and not (page.parent / one).exists()] == []


@pytest.mark.parametrize("page", PAGES, ids=lambda page: str(page.relative_to(ROOT)))
def test_the_site_reads_a_page_as_git_does(page: Path) -> None:
    """Python-Markdown wants a blank line before a list, and four spaces where a list goes on after one."""
    pairs = list(itertools.pairwise(["", *page.read_text(encoding="utf-8").splitlines()]))
    assert [line for before, line in pairs if _ITEM.match(line) and _PARAGRAPH.match(before)] == []
    assert [line for before, line in pairs if re.match(r" {2,3}\S", line) and not before] == []


def test_every_page_is_in_the_navigation() -> None:
    navigation = (ROOT / "mkdocs.yml").read_text(encoding="utf-8").partition("\nnav:")[2]
    pages = {page.relative_to(DOCS).as_posix() for page in (*DOCS.rglob("*.md"), *DOCS.glob("notebooks/*.ipynb"))}
    assert sorted(re.findall(r"[\w/]+\.(?:md|ipynb)\b", navigation)) == sorted(pages - BUILT_WITHOUT)


@pytest.mark.slow
def test_the_program_takes_every_command() -> None:
    """Its stages, experiments, keys and values exist; running them all would take hours. They are many, or the pattern
    no longer fits the pages."""
    from pipeline.config.compose import compose_stages, expand_sweeps
    from pipeline.errors import ConfigError

    refused = {}
    for command in COMMANDS:
        words = shlex.split(command)[3:]
        try:
            for job in expand_sweeps([w for w in words if w != "-m"])[0] if "-m" in words else [words]:
                compose_stages(job)
        except ConfigError as error:
            refused[command] = str(error)
    assert (refused, len(COMMANDS) > 30) == ({}, True)


@pytest.fixture(scope="module")
def results(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder in which a reader gives every command."""
    folder = tmp_path_factory.mktemp("results")
    for name in ("examples", "studies"):
        (folder / name).symlink_to(ROOT / name)
    return folder


@pytest.mark.nightly
@pytest.mark.parametrize("command", [command for command in COMMANDS if not _LONG.search(command)])
def test_a_command_runs_as_printed(command: str, results: Path) -> None:
    """In one folder, as a reader gives them; but those that are left out."""
    done = subprocess.run(
        ["bash", "-c", command],
        cwd=results,
        env=ENVIRONMENT | {"PATH": f"{Path(sys.executable).parent}:{os.environ['PATH']}"},
        capture_output=True,
        text=True,
    )
    assert done.returncode == 0, done.stderr[-500:]


def test_the_citation_has_what_its_format_asks_for() -> None:
    """https://citation-file-format.github.io, version 1.2.0: what a citation must have, at each place."""
    citation = yaml.safe_load((ROOT / "CITATION.cff").read_text(encoding="utf-8"))
    every = [citation, *citation["references"]]
    assert {"cff-version", "message", "title", "authors"} <= citation.keys()
    assert all(entry["title"] and entry["type"] for entry in every)
    assert all({"name"} == author.keys() or "family-names" in author for entry in every for author in entry["authors"])
