"""Another processor rounds otherwise: trainings end the same, and the choice of a study stays the same."""

from __future__ import annotations

import itertools
import json
import os
import platform
import subprocess
import sys
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import pytest
from conftest import pictures_left_out
from running import ROOT

from pipeline.config.compose import compose_config
from pipeline.stages import run_stage

OLD_KERNELS = ("Nehalem", "Prescott")
"""OpenBLAS's kernels without AVX; some processors' own ones round a product as one of the two does."""
OLD_PROCESSOR = {
    "MKL_CBWR": "COMPATIBLE",
    "ATEN_CPU_CAPABILITY": "default",
    "NPY_DISABLE_CPU_FEATURES": "X86_V3 X86_V4 AVX512_ICL AVX512_SPR",
}
"""The same of MKL, torch and NumPy, which warns of features that the processor lacks anyway."""
SPEEDS = [f"machine.speeds.{key}" for key in ("start_rpm=500", "stop_rpm=5500", "step_rpm=100")]
SMALL = {
    "ball_bearing": SPEEDS,
    "hydrostatic_stiffness": [*SPEEDS, "model.width=8"],
    "hydrostatic_damping": [*SPEEDS, "model.width=8"],
    "noisy_direct": SPEEDS,
    "impulses": [],
}
PROGRAM = """
import sys
from pathlib import Path
from test_other_processors import train_all
train_all(Path(sys.argv[1]))
"""
PRODUCT = """
import hashlib
import numpy as np
one, other = np.random.default_rng(0).normal(size=(2, 99, 99))
print(hashlib.sha256((one @ other).tobytes()).hexdigest())
"""


def train_all(folder: Path) -> None:
    with pictures_left_out():
        for name, stage in itertools.product(SMALL, ("generate", "train", "evaluate")):
            places = [f"stage={stage}", f"experiment={name}", f"output={folder}/{name}", "tracking=none"]
            run_stage(compose_config([*places, *SMALL[name]]))


@dataclass(frozen=True, eq=False)
class Processor:
    """What trainings came to under some kernels."""

    folder: Path

    def training(self, name: str) -> dict[str, Any]:
        """``training.json``."""
        return dict(json.loads((self.folder / name / "training.json").read_text()))

    def errors(self, name: str) -> dict[str, float]:
        """The mean and median errors of every coefficient, in percent."""
        found = json.loads((self.folder / name / "metrics.json").read_text())["coefficients"]
        return {
            f"{node} {coefficient} {kind}": of[f"{kind}_error_percent"]
            for node, coefficients in found.items()
            for coefficient, of in coefficients.items()
            for kind in ("mean", "median")
        }


@pytest.fixture(scope="module")
def processors(tmp_path_factory: pytest.TempPathFactory) -> tuple[Processor, Processor]:
    """This one, and one without its vector instructions; data are generated on each."""
    if platform.machine().lower() not in ("x86_64", "amd64"):
        pytest.skip("only x86-64 has kernels of other processors to compare with")
    bits = _run(PRODUCT, {})
    differing = [name for name in OLD_KERNELS if _run(PRODUCT, {"OPENBLAS_CORETYPE": name}) != bits]
    assert differing, "a processor would be compared with itself"
    this, old = (Processor(tmp_path_factory.mktemp(name)) for name in ("this", "old"))
    train_all(this.folder)
    _run(PROGRAM, OLD_PROCESSOR | {"OPENBLAS_CORETYPE": differing[0]}, str(old.folder))
    return this, old


def _run(program: str, kernels: dict[str, str], *arguments: str) -> str:
    done = subprocess.run(
        [sys.executable, "-c", program, *arguments],
        env=os.environ | {"PYTHONPATH": f"{ROOT}:{ROOT}/tests:{ROOT}/tests/identification"} | kernels,
        cwd=ROOT,
        capture_output=True,
        text=True,
        timeout=600,
    )
    assert done.returncode == 0, done.stderr
    return done.stdout


@pytest.mark.slow
def test_the_kernels_differ(processors: tuple[Processor, Processor]) -> None:
    """Otherwise the tests below compare a processor with itself."""
    this, old = processors
    assert this.training("impulses")["data_fingerprint"] != old.training("impulses")["data_fingerprint"]


@pytest.mark.slow
@pytest.mark.parametrize("name", SMALL)
def test_a_training_ends_the_same(processors: tuple[Processor, Processor], name: str) -> None:
    """Outcome, number of features, steps within one, and every error to the digits that are printed."""
    this, old = (one.training(name) for one in processors)
    assert old["outcome"] == this["outcome"]
    assert abs(old["steps"] - this["steps"]) <= 1
    if "fit" in this:
        # A prior takes its share of a number; one feature more or less would be far off.
        numbers = this["fit"]["chi_square"]["numbers"]
        assert old["fit"]["chi_square"]["numbers"] == pytest.approx(numbers, rel=1e-6)
        assert old["fit"]["bad_points"] == this["fit"]["bad_points"]
    errors, others = (one.errors(name) for one in processors)
    for key, error in errors.items():
        assert others[key] == pytest.approx(error, rel=1e-3, abs=1e-11), key


@pytest.mark.parametrize("name", ["ball_bearing", "hydrostatic_stiffness", "hydrostatic_damping"])
def test_committed_studies_promote_with_room_to_spare(name: str) -> None:
    """Kernels and the sampler's path move the losses of finalists: the choice must not hang on that."""
    import pandas as pd
    import yaml

    folder = ROOT / "studies" / name
    losses = pd.read_csv(folder / "finalists.csv").groupby("trial")["held_out_loss"]
    promoted = yaml.safe_load((folder / "best.yaml").read_text())["trial"]
    least = compose_config([f"experiment={name}", "tuned=false"]).tuning.least_gain
    assert losses.median()[0] > 10 * least * losses.median()[promoted]
    assert losses.min()[0] > 10 * losses.max()[promoted]
