"""The report as a page and as a PDF: what it loads, places, escapes, and how it is used by keyboard."""

from __future__ import annotations

import json
import re
from html.parser import HTMLParser
from pathlib import Path

import numpy as np
import pytest
from conftest import assert_says

from pipeline.reporting.blocks import (
    Amplitude,
    Axes,
    Curve,
    Figure,
    HeatMap,
    Mark,
    Panel,
    Section,
    Table,
)
from pipeline.reporting.report.files import write_page, write_pdf

RPM = np.linspace(500, 3000, 40)
SIZE = 1e-6 * RPM / 500
HEAD = {"customer": "C & D", "author": ""}


def _sections() -> list[Section]:
    """One of each kind of block and of panel."""
    band = Curve(RPM, SIZE, "first run", deviation=0.1 * SIZE)
    panels = (
        Panel(
            "probe <!--<script>", "rotor speed (rpm)", (Axes((band,), "amplitude (µm pk-pk)", quantity="amplitude"),)
        ),
        Panel("polar", "", (Axes((Curve(RPM / 10, SIZE, "first run"),), "", quantity="amplitude"),), polar=45.0),
        Panel(
            "orbit", "x (µm)", (Axes((Curve(SIZE, SIZE[::-1], "orbit"),), "y (µm)", quantity="amplitude"),), equal=True
        ),
        Panel("map", "order", (Axes((), "rpm"),), heat=HeatMap(np.arange(3.0), np.arange(2.0), np.eye(2, 3), "level")),
    )
    table = Table(
        "rows", ["what", "size", "verdict"], [["a & b", Amplitude(3e-6, 1e-7), Mark("with care", "with care")]]
    )
    return [
        (
            "one",
            "First </script> section",
            (Mark("warning", "Words < here."), table, Figure("f", "Caption.", panels)),
        )
    ]


@pytest.fixture(scope="module")
def page(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A page of one section."""
    return write_page(tmp_path_factory.mktemp("page") / "report.html", "A & B", HEAD, _sections())


class _Links(HTMLParser):
    """Every address that the page's elements name, and its policy."""

    def __init__(self) -> None:
        super().__init__()
        self.addresses: list[str] = []
        self.policy = ""

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        given = dict(attrs)
        self.addresses += [value for name in ("src", "href", "srcset", "action", "data") if (value := given.get(name))]
        if given.get("http-equiv") == "Content-Security-Policy":
            self.policy = given.get("content") or ""


def test_the_page_loads_nothing_from_elsewhere(page: Path) -> None:
    """Links lead into the page alone, and its policy forbids a browser to fetch anything."""
    text = page.read_text(encoding="utf-8")
    links = _Links()
    links.feed(text)
    assert {address[:1] for address in links.addresses} == {"#"}
    assert links.policy.startswith("default-src 'none';")
    assert "http" not in links.policy
    style, *_ = re.findall(r"<style>(.*?)</style>", text, re.S)
    assert re.findall(r"url\(|@import", style) == []


def test_the_page_has_a_place_for_every_panel_and_escapes_what_it_prints(page: Path) -> None:
    text = page.read_text(encoding="utf-8")
    (drawn,) = re.findall(r'<script type="application/json" id="panels">(.*?)</script>', text, re.S)
    assert "<" not in drawn  # such a title would open a script inside this one
    panels = json.loads(drawn)
    assert [panel["id"] for panel in panels] == re.findall(r'<div class="panel[^"]*" id="(\w+)"', text)
    assert len(panels) == 4
    assert "Author" not in text
    assert_says(text, "<dt>Customer</dt><dd>C &amp; D</dd>", "Words &lt; here.", "First &lt;/script&gt; section")
    assert 'data-value="6.0"' in text  # 3 um zero-to-peak
    assert panels[0]["traces"][-1]["y"][0] == pytest.approx(2.0)
    assert panels[2]["traces"][-1]["x"][0] == pytest.approx(1.0)  # the place on an orbit is not doubled


def measure_luminance(colour: str) -> float:
    """Relative, of #rgb or #rrggbb (WCAG 2.1)."""
    digits = colour[1:] if len(colour) == 7 else "".join(2 * digit for digit in colour[1:])
    parts = np.array([int(digits[i : i + 2], 16) / 255 for i in (0, 2, 4)])
    linear = np.where(parts <= 0.04045, parts / 12.92, ((parts + 0.055) / 1.055) ** 2.4)
    return float(linear @ [0.2126, 0.7152, 0.0722])


def test_the_page_can_be_read_and_used_by_keyboard(page: Path) -> None:
    """Every text colour stands out of every ground (WCAG AA); choices have names, wide tables can be scrolled."""
    text = page.read_text(encoding="utf-8")
    style = text[text.index("<style>") : text.index("</style>")]
    colours, grounds = (re.findall(rf"[ {{]{key}: (#\w+)", style) for key in ("color", "background"))
    assert len(colours) > 5
    assert len(grounds) > 4
    ratios = [
        (measure_luminance(ground) + 0.05) / (measure_luminance(colour) + 0.05)
        for ground in grounds
        for colour in colours
    ]
    assert min(ratios) >= 4.5
    assert_says(
        text, '<label>Amplitudes <select id="amplitude">', '<label>Phase <select id="phase">', '<html lang="en">'
    )
    assert text.count('<div class="scroll"') == text.count(
        '<div class="scroll" tabindex="0" role="region" aria-label="'
    )


@pytest.mark.slow
@pytest.mark.parametrize(("paper", "size"), [("A4", b"595.28 841.89"), ("Letter", b"612.00 792.00")])
def test_a_pdf_has_the_same_sections(paper: str, size: bytes, tmp_path: Path) -> None:
    content = write_pdf(tmp_path / "report.pdf", "A & B", HEAD, _sections(), paper).read_bytes()
    assert content.startswith(b"%PDF")
    assert [part for part in (b"/MediaBox [0 0 " + size, b"/Outlines") if part not in content] == []
    assert content.count(b"/Subtype /Image") == 2  # two rows of panels
