"""What the tests that run stages share: experiments of few speeds and steps, and what lies in a folder."""

from __future__ import annotations

import json
import os
import shutil
import subprocess
import sys
from collections.abc import Iterable, Iterator
from contextlib import contextmanager
from functools import cache
from pathlib import Path
from types import FunctionType
from typing import Any

import pytest

from pipeline.coefficients import COEFFICIENTS
from pipeline.config.compose import compose_config
from pipeline.config.loader import list_options
from pipeline.config.operating import column_of
from pipeline.config.schema import Config

ROOT = Path(__file__).resolve().parents[1]
EXAMPLE = ROOT / "examples" / "measured_demo"
ENVIRONMENT = os.environ | {"PYTHONPATH": str(ROOT)}
PYTHON = [sys.executable, "-W", "error"]
FEW_SPEEDS = tuple(f"machine.speeds.{key}" for key in ("start_rpm=500", "stop_rpm=5500", "step_rpm=500"))
FEW = (
    *FEW_SPEEDS,
    *("optimizer.adam.steps=4", "optimizer.levenberg_marquardt.steps=4"),
    *("robustness.count=3", "robustness.seeds=[0,1]", "++robustness.workers=1"),
)
LINE = ("generate", "train", "evaluate", "robustness", "predict")
REFUSED = "compressor_journal_and_isotropic"  # not identifiable: no stage after diagnose
MEASURED = "measured_demo"  # read, not generated: test_measured_demo.py
EXPERIMENTS = [name for name in list_options("experiment") if name not in (REFUSED, MEASURED)]
DEFAULT = "hydrostatic_stiffness"
FIGURES = [
    *("identified", "stiffness", "damping", "training", "robustness"),
    *("prediction_time", "prediction_orbit", "prediction_response", "campbell"),
]


@cache
def composed(*overrides: str) -> Config:
    """Composing takes longer than most stages and methods of the tests."""
    return compose_config(overrides)


def few(experiment: str, *overrides: str) -> Config:
    """An experiment with few speeds and steps."""
    return composed(f"experiment={experiment}", "tracking=none", *FEW, *overrides)


def contents(folder: Path) -> dict[str, bytes]:
    """Every file below ``folder``, but the log, which has what failed, too."""
    every = [p for p in sorted(folder.rglob("*")) if p.is_file() and p.name != "log.txt"]
    return {str(p.relative_to(folder)): p.read_bytes() for p in every}


@contextmanager
def left_alone(folder: Path) -> Iterator[None]:
    """What the block does leaves every file below ``folder`` as it was."""
    before = contents(folder)
    yield
    assert contents(folder) == before


def names_in(folder: Path) -> set[str]:
    """Names of everything in ``folder``, hidden files too, but the log, which only slow steps have."""
    return {path.name for path in folder.iterdir()} - {"log.txt"} if folder.exists() else set()


def strict_json(path: Path) -> Any:
    """JSON as the standard has it: NaN is none."""

    def refuse(word: str) -> None:
        raise AssertionError(f"{path} holds {word}")

    return json.loads(path.read_text(encoding="utf-8"), parse_constant=refuse)


def python(*words: str, cwd: Path = ROOT, **others: Any) -> subprocess.CompletedProcess[str]:
    """A new interpreter on this checkout, with warnings as errors, such as ``python("-m", "pipeline", "--help")``."""
    return subprocess.run([*PYTHON, *words], cwd=cwd, env=ENVIRONMENT, text=True, capture_output=True, **others)


def identified_columns(config: Config) -> list[str]:
    """Those of identified_coefficients.csv: the response loss states a standard deviation of each."""
    deviations = [f"{name}_std" for name in COEFFICIENTS] if config.loss.kind == "response" else []
    conditions = [column_of(name).column for name in config.machine.operating]
    return ["bearing_node", "speed_rpm", *conditions, *COEFFICIENTS, *deviations]


def at_night(test: Any, names: str, values: Iterable[object], **others: Any) -> Any:
    """A test of the day with other values of the parameters ``names``."""
    night = FunctionType(test.__code__, test.__globals__, test.__name__, test.__defaults__, test.__closure__)
    night.__annotations__ = test.__annotations__
    night.pytestmark = [m for m in test.pytestmark if m.name != "parametrize" or m.args[0] != names]
    return pytest.mark.parametrize(names, values, **others)(night)


BROWSER = shutil.which("chromium") or shutil.which("chromium-browser") or shutil.which("google-chrome")
NO_BROWSER = "no Chromium here (apt-get install chromium): what it would show is checked without one elsewhere"


def open_in_browser(address: str, *flags: str) -> tuple[str, list[str]]:
    """What a page has become in headless Chromium, and what its scripts said."""
    flags += ("--headless", "--no-sandbox", "--disable-gpu", "--enable-logging=stderr", "--virtual-time-budget=60000")
    done = subprocess.run(
        [str(BROWSER), *flags, "--dump-dom", address], capture_output=True, text=True, timeout=120, check=True
    )
    return done.stdout, [line for line in done.stderr.splitlines() if ":CONSOLE" in line]


GROUNDED = {
    "material": {"density": 7810.0, "youngs_modulus": 211e9, "shear_modulus": 81.2e9},
    "shaft": [{"length": 1.2, "outer_diameter": 0.05, "inner_diameter": 0.0, "elements": 8}],
    "discs": [
        {"node": 3, "mass": 12.0, "diametral_inertia": 0.05, "polar_inertia": 0.09},
        {"node": 8, "mass": 5.0, "diametral_inertia": 0.02, "polar_inertia": 0.04},
    ],
    "bearing_nodes": (1, 6),
}
"""SI: a rotor with a disc between its bearings and an overhung one, which tests put on soft ground."""
