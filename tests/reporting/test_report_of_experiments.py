"""The report of experiments that `make reproduce` made: of measured and modelled machines, with and without a fit."""

from __future__ import annotations

import json
import re
import shutil
import subprocess
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from conftest import assert_says

from pipeline.config.compose import compose_config
from pipeline.stages import run_stage

pytestmark = pytest.mark.slow
ROOT = Path(__file__).resolve().parents[2]
ARTIFACTS = ROOT / "artifacts"
MADE = ("measured_demo", "realistic")
OTHERS = {
    "noisy_stiffness_residual": {"coefficients", "fit", "modes", "response"},  # a loss without deviations
    "impulses": {"coefficients", "fit", "modes", "balancing"},  # forces of their own frequencies, residual unbalance
    "compressor_journal_and_isotropic": {"machine", "measured", "diagnosis", "origin"},  # refused: no fit
}
MOST_BYTES, MOST_PANELS, MOST_NUMBERS = 10_000_000, 100, 500_000
BROWSER = shutil.which("chromium") or shutil.which("chromium-browser") or shutil.which("google-chrome")


def read_panels(page: Path) -> list[dict[str, Any]]:
    """What the page hands to plotly."""
    found = re.search(
        r'<script type="application/json" id="panels">(.*?)</script>', page.read_text(encoding="utf-8"), re.S
    )
    assert found is not None
    panels: list[dict[str, Any]] = json.loads(found[1])
    return panels


def count_numbers(value: Any) -> int:
    """Numbers in nested lists and dictionaries."""
    if isinstance(value, dict):
        return sum(count_numbers(item) for item in value.values())
    return sum(count_numbers(item) for item in value) if isinstance(value, list) else 1


@pytest.mark.parametrize("name", MADE)
def test_a_report_can_be_sent_on(name: str) -> None:
    """Less than 10 MB, with a bounded number of panels and numbers, and none of them empty."""
    page = ARTIFACTS / name / "report.html"
    assert page.stat().st_size < MOST_BYTES
    assert (ARTIFACTS / name / "report.pdf").stat().st_size < MOST_BYTES
    panels = read_panels(page)
    assert 20 < len(panels) < MOST_PANELS
    assert count_numbers(panels) < MOST_NUMBERS
    for panel in panels:
        assert any(value is not None for trace in panel["traces"] for value in trace.get("y", trace.get("r", ())))


@pytest.mark.parametrize("name", MADE)
def test_a_report_has_what_an_engineer_asks_for(name: str) -> None:
    text = (ARTIFACTS / name / "report.html").read_text(encoding="utf-8")
    figures = [
        "answer",
        "sketch",
        "bode",
        "polar",
        "orbits",
        "stiffness",
        "damping",
        "fit",
        "campbell",
        "stability",
        "prediction",
    ]
    figures += ["spectra", "centreline", "held-out"] if name == "measured_demo" else []
    for figure in figures:
        assert f'id="figure-{figure}"' in text, figure
    assert json.loads((ARTIFACTS / name / "training.json").read_text())["data_fingerprint"] in text
    assert_says(text, "±", "verification")
    asked = ["What was asked?", "What is the answer?", "What may be relied on?", "What is to be done next?"]
    first = text[text.index('<section id="answer">') :]
    assert re.findall(r"<td[^>]*>(What [^<]*\?)</td>", first[: first.index("</section>")]) == asked


def test_the_printed_coefficients_are_those_of_the_file() -> None:
    """A constant of the page, in MN/m with two digits of its deviation, beside the artifact's."""
    rows = np.genfromtxt(ARTIFACTS / "measured_demo" / "identified_coefficients.csv", delimiter=",", names=True)
    value, deviation = rows["kxx"][0] / 1e6, rows["kxx_std"][0] / 1e6
    text = (ARTIFACTS / "measured_demo" / "report.html").read_text(encoding="utf-8")
    found = re.search(r"node 1 kxx, MN/m</td>\s*<td[^>]*>([\d.]+) ± ([\d.]+)<", text)
    assert found is not None
    assert float(found[1]) == pytest.approx(value, abs=0.51 * 10 ** -len(found[1].split(".")[1]))
    assert float(found[2]) == pytest.approx(deviation, rel=0.05)


@pytest.mark.skipif(BROWSER is None, reason="no Chromium here; the page's places and numbers are checked without one")
def test_a_browser_if_there_is_one_draws_every_panel_without_a_word() -> None:
    """Headless Chromium, without a network: each panel has its picture, and the console stays empty."""
    assert BROWSER is not None
    page = ARTIFACTS / "measured_demo" / "report.html"
    flags = ["--headless", "--no-sandbox", "--disable-gpu", "--enable-logging=stderr", "--virtual-time-budget=60000"]
    flags += ["--host-resolver-rules=MAP * ~NOTFOUND", "--dump-dom"]
    done = subprocess.run(
        [BROWSER, *flags, page.resolve().as_uri()], capture_output=True, text=True, timeout=120, check=True
    )
    assert [line for line in done.stderr.splitlines() if ":CONSOLE" in line] == []
    panels = len(read_panels(page))
    assert f'data-drawn="{panels}"' in done.stdout
    assert len(re.findall(r'<div class="panel[^"]*js-plotly-plot"', done.stdout)) == panels


@pytest.mark.parametrize("name", OTHERS)
def test_every_kind_of_experiment_has_a_report(name: str, tmp_path: Path) -> None:
    folder = tmp_path / name
    shutil.copytree(ARTIFACTS / name, folder)
    run_stage(compose_config([f"experiment={name}", "stage=report", f"output={folder}", "tracking=none"]))
    text = (folder / "report.html").read_text(encoding="utf-8")
    sections = set(re.findall(r'<section id="([\w-]+)">', text))
    assert sections >= OTHERS[name]
    assert ("coefficients" in sections) == (name != "compressor_journal_and_isotropic")
    assert (folder / "report.pdf").read_bytes().startswith(b"%PDF")
    if name == "impulses":  # opposite to the residual unbalance, as heavy
        assert re.search(r"node 2</td>\s*<td[^>]*>39\.93 ± 0\.10</td>\s*<td[^>]*>49\.95 ± 0\.15", text)
        assert re.search(r"39\.93 ± 0\.10</td>\s*<td[^>]*>229\.95 ± 0\.15", text)


def test_a_reference_is_drawn_and_compared(tmp_path: Path) -> None:
    """Of coefficients 10 % larger than the identified ones, the difference is -9.09 % of the reference."""
    folder = tmp_path / "measured_demo"
    shutil.copytree(ARTIFACTS / "measured_demo", folder)
    rows = np.genfromtxt(folder / "identified_coefficients.csv", delimiter=",", names=True)
    lines = [f"{row['bearing_node']:.0f},{row['speed_rpm']},{1.1 * row['kxx']}" for row in rows[::20]]
    reference = tmp_path / "catalogue.csv"
    reference.write_text("bearing_node,speed_rpm,kxx\n" + "\n".join(lines) + "\n")
    given = [f"report.reference={reference}", f"output={folder}", "tracking=none"]
    run_stage(compose_config(["experiment=measured_demo", "stage=report", *given]))
    text = (folder / "report.html").read_text(encoding="utf-8")
    assert "kxx reference" in text
    assert re.search(r"node 1 kxx</td>\s*<td[^>]*>9</td>\s*<td[^>]*>-9\.09</td>", text)
