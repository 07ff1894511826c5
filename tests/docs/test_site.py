"""The site of the documentation: built strictly, and nothing of it comes from the internet."""

from __future__ import annotations

import os
import re
import subprocess
import sys
from pathlib import Path

import pytest
from running import BROWSER, NO_BROWSER, ROOT, open_in_browser

pytestmark = pytest.mark.slow

_LOADED = re.compile(r"<(?:script|link|img|iframe)\b[^>]*\b(?:src|href)=[\"']?(?:https?:)?//[^>]*>")
_IMPORTED = re.compile(r"(?:@import|url\()\s*[\"']?(?:https?:)?//[^)]*")


@pytest.fixture(scope="module")
def site(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The built pages. A dead link, a page that is not in the navigation or a missing anchor fails."""
    folder = tmp_path_factory.mktemp("site")
    done = subprocess.run(
        [sys.executable, "-m", "mkdocs", "build", "--strict", "--site-dir", str(folder)],
        cwd=ROOT,
        env=os.environ | {"NO_MKDOCS_2_WARNING": "1"},
        capture_output=True,
        text=True,
        timeout=300,
    )
    assert done.returncode == 0, done.stderr
    return folder


def test_nothing_is_loaded_from_elsewhere(site: Path) -> None:
    """Scripts, styles, fonts and pictures are files of the site: an engineer's network may be closed."""
    pages = sorted(site.rglob("*.html"))
    assert len(pages) > 20
    for pattern, files in ((_LOADED, pages), (_IMPORTED, [*site.rglob("*.css"), *pages])):
        assert {p.name: found for p in files if (found := pattern.findall(p.read_text(encoding="utf-8")))} == {}


def test_a_page_has_its_tables_and_lists(site: Path) -> None:
    """Markdown that the site reads otherwise than git's pages do would stand there as text."""
    for page in site.glob("*.html"):
        text = re.sub(r"<(pre|code|script|style)\b.*?</\1>", "", page.read_text(encoding="utf-8"), flags=re.S)
        text = re.sub(r"<[^>]+>", "", text)
        assert not re.search(r"^\s*\|.*\|\s*$|^\s*\|---|\*\*\w|^- \w", text, re.M), page.name


@pytest.mark.skipif(BROWSER is None, reason=NO_BROWSER)
def test_the_search_needs_no_server(site: Path) -> None:
    """From the folder of the built pages, in headless Chromium."""
    page, console = open_in_browser(f"{(site / 'index.html').as_uri()}?q=clearance")
    assert console == []
    assert re.search(r"[1-9]\d* matching documents", page)
