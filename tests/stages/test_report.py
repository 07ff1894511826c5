"""The report of experiments that `make reproduce` made: of measured and modelled machines, with and without a fit."""

from __future__ import annotations

import html
import json
import re
import shutil
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import pytest
from conftest import assert_says
from running import BROWSER, NO_BROWSER, ROOT, open_in_browser

from pipeline.config.compose import compose_config, compose_stages
from pipeline.stages import run_stage, run_stages

pytestmark = pytest.mark.slow
ARTIFACTS = ROOT / "artifacts"
MADE = ("measured_demo", "realistic")
OTHERS = {
    "noisy_stiffness_residual": {"coefficients", "fit", "modes", "response"},  # a loss without deviations
    "impulses": {"coefficients", "fit", "modes", "balancing"},  # forces of their own frequencies, residual unbalance
    "compressor_journal_and_isotropic": {"machine", "measured", "diagnosis", "origin"},  # refused: no fit
    "ball_bearing": {"coefficients", "fit", "modes", "response"},  # a resonance without damping
    "hydrostatic_stiffness": {"coefficients", "fit", "modes", "response"},  # exact readings
    "oil_temperatures": {"numbers", "coefficients", "fit", "modes"},  # three states, and one that nobody measured
    "rk4": {"verdicts", "coefficients", "fit", "balancing"},  # measured; supports are not determined
    "noisy_direct": {"coefficients", "fit", "modes", "response"},  # half of the coefficients are known
}
VERDICTS = ("good", "with care", "no")
MOST_BYTES, MOST_PANELS, MOST_NUMBERS = 10_000_000, 100, 500_000


def read_panels(page: Path) -> list[dict[str, Any]]:
    """What the page hands to plotly."""
    text = page.read_text(encoding="utf-8")
    (drawn,) = re.findall(r'<script type="application/json" id="panels">(.*?)</script>', text, re.S)
    return json.loads(drawn)


def count_numbers(value: Any) -> int:
    """Numbers in nested lists and dictionaries."""
    if isinstance(value, dict):
        return sum(count_numbers(item) for item in value.values())
    return sum(count_numbers(item) for item in value) if isinstance(value, list) else 1


@pytest.mark.parametrize("name", MADE)
def test_a_report_can_be_sent_on(name: str) -> None:
    """Less than 10 MB, with a bounded number of panels and numbers, and none of them empty."""
    page = ARTIFACTS / name / "report.html"
    assert max(page.stat().st_size, page.with_suffix(".pdf").stat().st_size) < MOST_BYTES
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
        "prediction",
        *(["spectra", "centreline", "held-out"] if name == "measured_demo" else []),
    ]
    assert [figure for figure in figures if f'id="figure-{figure}"' not in text] == []
    assert json.loads((ARTIFACTS / name / "training.json").read_text())["data_fingerprint"] in text
    assert_says(text, "±", "verification", "Stability map")
    asked = ["What was asked?", "What is the answer?", "What may be relied on?", "What is to be done next?"]
    first = text[text.index('<section id="answer">') :]
    assert re.findall(r"<td[^>]*>(What [^<]*\?)</td>", first[: first.index("</section>")]) == asked


def test_the_printed_coefficients_are_those_of_the_file() -> None:
    """A constant of the page, in MN/m with two digits of its deviation, beside the artifact's."""
    rows = np.genfromtxt(ARTIFACTS / "measured_demo" / "identified_coefficients.csv", delimiter=",", names=True)
    value, deviation = rows["kxx"][0] / 1e6, rows["kxx_std"][0] / 1e6
    text = (ARTIFACTS / "measured_demo" / "report.html").read_text(encoding="utf-8")
    shown, *_ = re.findall(r"node 1 kxx, MN/m</td>\s*<td[^>]*>([\d.]+) ± ([\d.]+)<", text)
    assert float(shown[0]) == pytest.approx(value, abs=0.51 * 10 ** -len(shown[0].split(".")[1]))
    assert float(shown[1]) == pytest.approx(deviation, rel=0.05)


@pytest.mark.skipif(BROWSER is None, reason=NO_BROWSER)
def test_a_browser_if_there_is_one_draws_every_panel_without_a_word() -> None:
    """Headless Chromium, without a network: each panel has its picture, and the console stays empty."""
    page = (ARTIFACTS / "measured_demo" / "report.html").resolve()
    shown, console = open_in_browser(page.as_uri(), "--host-resolver-rules=MAP * ~NOTFOUND")
    assert console == []
    panels = len(read_panels(page))
    assert f'data-drawn="{panels}"' in shown
    assert len(re.findall(r'<div class="panel[^"]*js-plotly-plot"', shown)) == panels


@pytest.mark.usefixtures("no_pictures")
@pytest.mark.parametrize("name", OTHERS)
def test_every_kind_of_experiment_has_a_report(name: str, tmp_path: Path) -> None:
    folder = shutil.copytree(ARTIFACTS / name, tmp_path / name)
    stages = "[verdict,report]" if (folder / "training.json").exists() else "report"
    run_stages(compose_stages([f"experiment={name}", f"stage={stages}", f"output={folder}", "tracking=none"]))
    text = (folder / "report.html").read_text(encoding="utf-8")
    sections = set(re.findall(r'<section id="([\w-]+)">', text))
    assert sections >= OTHERS[name]
    assert ("coefficients" in sections) == (name != "compressor_journal_and_isotropic")
    assert (folder / "report.pdf").read_bytes().startswith(b"%PDF")
    assert "coefficients" not in sections or list_contradictions(folder) == []
    if name == "impulses":  # opposite to the residual unbalance, as heavy
        assert re.search(r"node 2</td>\s*<td[^>]*>39\.93 ± 0\.10</td>\s*<td[^>]*>49\.95 ± 0\.15", text)
        assert re.search(r"39\.93 ± 0\.10</td>\s*<td[^>]*>229\.95 ± 0\.15", text)


def read_rows(text: str) -> list[list[str]]:
    """The cells of every table, without their marks."""
    rows = re.findall(r"<tr>(.*?)</tr>", text, re.S)
    return [[html.unescape(re.sub("<[^>]+>", "", one)) for one in re.findall(r"<td[^>]*>(.*?)</td>", row, re.S)]
            for row in rows]  # fmt: skip


def list_contradictions(folder: Path) -> list[str]:
    """Pairs of statements of a report, and of its files, that do not agree; and numbers that nobody can read."""
    text = (folder / "report.html").read_text(encoding="utf-8").partition("<main>")[2].partition("</main>")[0]
    rows, said = read_rows(text), html.unescape(re.sub("<[^>]+>", " ", text))
    files = {name: json.loads((folder / f"{name}.json").read_text()) for name in ("verdicts", "training", "diagnosis")}
    answer = " ".join(cell for row in rows[:5] for cell in row)
    good = 0
    wrong = re.findall(r"\d(?:\.\d+)?e\+\d+|(?<![\d.\w])-0(?![.\d])|\bnan\b", said)
    table = {row[0].split(",")[0]: row[1:] for row in rows if len(row) > 1 and re.match(r"node \d+ [kc]\w\w, ", row[0])}
    numbers = pd.read_csv(folder / "identified_coefficients.csv")
    for entry in files["verdicts"]["verdicts"]:
        name = f"node {entry['node']} {entry['coefficient']}"
        shown = [row[1] for row in rows if len(row) > 2 and name in row[0].split(", ") and row[1] in VERDICTS]
        why, stars = " ".join(entry["reasons"]), sum("*" in cell for cell in table[name])
        good += entry["verdict"] == "good"
        wrong += [f"{name}: {shown}, {entry['verdict']}"] if shown != [entry["verdict"]] else []
        lost, width = f"do not determine {entry['coefficient']} at" in why, len(table[name])
        wrong += [f"{name}: {why}, {stars} *"] if lost and stars < width / 2 else []
        wrong += [f"{name}: good, {stars} *"] if entry["verdict"] == "good" and stars > 1 else []
        known = re.search(rf"{entry['coefficient']} at node \d+ is known to ([\d.]+) %(?: only)? \(95 %\)", why)
        if known and entry["coefficient"][1] == entry["coefficient"][2]:
            at = numbers[numbers.bearing_node == entry["node"]]
            band = 196 * (at[f"{entry['coefficient']}_std"] / at[entry["coefficient"]].abs()).median()
            wrong += [f"{name}: {why}, {band}"] if float(known[1]) != pytest.approx(band, rel=0.06) else []
    wrong += [] if f"{good} of {len(files['verdicts']['verdicts'])} coefficients are good" in answer else [answer]
    before, after = files["diagnosis"]["determined"]["coefficients"], files["training"]["determined"]["coefficients"]
    wrong += [
        text
        for node, entries in after.items()
        for name, entry in entries.items()
        if entry["verdict"] != (expected := before[node][name]["verdict"])
        and (text := f"{name} at node {node} is {entry['verdict']} (expected: {expected})") not in said
    ]
    told = re.search(r"held-out speeds predicted to ([\d.]+) %", said)
    wrong += (
        [told[0]]
        if told and [row[1] for row in rows if len(row) == 4 and row[0].startswith("speeds,")] != [told[1]]
        else []
    )
    steps = next(row[1] for row in rows if row[:1] == ["What is to be done next?"])
    wrong += [steps] if "No single further run" in steps and "Add a run" in steps else []
    bad = [f"{row[2]} higher than {row[1]}" for row in rows if row[-1:] == ["higher than predicted"]] + re.findall(
        "THE MODEL IS REJECTED", said
    )
    wrong += bad if re.search(r"The model and the [a-z ]*noise[a-z ]* explain the readings", said) else []
    if (ratio := re.search(r"the readings lie ([\d.]+) times as far off as their noise(?:\.| \()", said)) is not None:
        probes = [float(row[2]) for row in rows if len(row) == 3 and re.fullmatch(r"[\d.]+", row[2]) and row[0] in said]
        away = pytest.approx(float(np.sqrt(np.mean(np.square(probes)))), rel=0.3, abs=0.02)
        wrong += [f"{ratio[0]}, {probes}"] if float(ratio[1]) != away else []
        rest = said[said.index(ratio[0]) :].split("Readings beyond")[0]
        wrong += re.findall("do not explain the readings", rest) * ("whole: good" in answer)
    if (critical := re.search(r"Critical speeds: (.*?), between", answer)) is not None:
        every = [row for row in rows if len(row) == 6 and row[0].isdigit() and "±" in row[1] + row[2] + "±"]
        listed = [row for row in every if row[5] != "0"]  # the others show no peak
        wrong += [critical[1]] if critical[1] != (", ".join(
            f"{row[1]} rpm (logarithmic decrement {row[2]})" for row in listed) or "none") else []  # fmt: skip
        wrong += [answer] if (len(every) > len(listed)) != ("critically damped" in answer) else []
        stable = re.search(r"smallest logarithmic decrement ([\d.]+(?: ± [\d.]+)?) at", answer)
        wrong += [] if stable is None or said.count(f"logarithmic decrement {stable[1]} at") > 1 else [stable[0]]
        wrong += [] if ("stable at all speeds" in answer) == ("identified machine is stable" in said) else ["stable"]
        band = [*map(float, (stable[1] if stable else "1").split(" ± ")), 0.0]
        wrong += ["stable at all speeds"] * (
            "stable at all" in answer and ("as identified" in answer) != (band[0] <= 1.96 * band[1])
        )
    pairs = (("at held-out speeds", "no speed was held out"), ("states no band", "Bands hold"))
    wrong += [f"{pair}" for pair in pairs if pair[0] in said and pair[1] in said]
    return wrong


@pytest.mark.parametrize("name", MADE)
def test_no_two_statements_contradict(name: str) -> None:
    assert list_contradictions(ARTIFACTS / name) == []


@pytest.mark.usefixtures("no_pictures")
@pytest.mark.parametrize("seed", [0, *(pytest.param(seed, marks=pytest.mark.nightly) for seed in (1, 2)), 4])
def test_no_two_statements_on_a_drawn_machine_contradict(seed: int, tmp_path: Path) -> None:
    """With an unbalance to predict that is no run's; 4 has resonances sharper than its speeds are apart."""
    made = ARTIFACTS / "ordinary" / "machines" / f"one_percent-{seed}"
    folder = shutil.copytree(made / "answer", tmp_path / "answer")
    unseen = ("tracking=none", "stage=report", "machine.prediction.unbalances.0.phase=10 deg")
    run_stage(compose_config([f"machine.file={made / 'machine.yaml'}", f"output={folder}", *unseen]))
    assert list_contradictions(folder) == []


@pytest.mark.usefixtures("no_pictures")
def test_a_reference_is_drawn_and_compared(tmp_path: Path) -> None:
    """Of coefficients 10 % larger than the identified ones, the difference is -9.09 % of the reference."""
    folder = shutil.copytree(ARTIFACTS / "measured_demo", tmp_path / "measured_demo")
    rows = np.genfromtxt(folder / "identified_coefficients.csv", delimiter=",", names=True)
    lines = [f"{row['bearing_node']:.0f},{row['speed_rpm']},{1.1 * row['kxx']}" for row in rows[::20]]
    reference = tmp_path / "catalogue.csv"
    reference.write_text("bearing_node,speed_rpm,kxx\n" + "\n".join(lines) + "\n")
    given = (f"report.reference={reference}", f"output={folder}", "experiment=measured_demo", "tracking=none")
    run_stage(compose_config([*given, "stage=report"]))
    text = (folder / "report.html").read_text(encoding="utf-8")
    assert "kxx reference" in text
    assert re.search(r"node 1 kxx</td>\s*<td[^>]*>9</td>\s*<td[^>]*>-9\.09</td>", text)
