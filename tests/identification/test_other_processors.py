"""Another processor rounds otherwise: outcomes, choices, steps and printed figures stay the same."""

from __future__ import annotations

import itertools
import json
import os
import platform
import subprocess
import sys
from dataclasses import dataclass
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
import torch
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


def test_losses_below_rounding_are_no_improvement() -> None:
    """A training at the precision of its data converges, however its losses go up and down there."""
    from pipeline.config.identification import TrainingConfig
    from pipeline.identification.training import _Monitor

    def steps(losses: list[float]) -> int:
        problem: Any = SimpleNamespace(rounding=lambda: torch.tensor([1e-13]), scatter=lambda: 0.0)
        monitor = _Monitor(
            problem=problem,
            held_out=None,
            config=TrainingConfig(holdout_every=0, holdout_runs=[], tolerance=0.1),
            progress=None,
            watch=None,
        )
        monitor.begin("levenberg_marquardt", 100, 3)
        for loss in losses:
            if monitor(torch.zeros(1, 1, 2), torch.full((1, 1), loss, dtype=torch.float64)).all():
                break
        return monitor.step

    falling = [1.0, 1e-3, 1e-9, 1e-15]
    assert steps([*falling, 8e-16, 6e-16, 4e-16, 2e-16, 1e-16]) == steps([*falling, *[1e-15] * 5]) == 7
    assert steps([1.0, 1e-3, 1e-9, 8e-10, 6e-10, 4e-10, 2e-10]) == 7, "above rounding they are"


def test_the_rounding_of_a_loss_follows_the_size_of_the_data() -> None:
    """1e-13 of the loss without any bearing force, whatever the unit of the rows."""
    from pipeline.identification.residual_loss import ResidualProblem

    rng = np.random.default_rng(0)
    offset = torch.as_tensor(rng.normal(size=(2, 5, 3)))
    rest = torch.as_tensor(rng.uniform(size=2))
    matrix = torch.zeros(2, 5, 3, 3, dtype=torch.float64)
    found = [
        ResidualProblem(None, None, size * matrix, size * offset, size**2 * rest, None).rounding()
        for size in (1.0, 1e3)
    ]
    np.testing.assert_allclose(found[0], 1e-13 * np.sqrt((offset.numpy() ** 2).sum((1, 2)) + rest.numpy()))
    np.testing.assert_allclose(found[1], 1e3 * found[0])


@dataclass(frozen=True)
class _Features:
    """As much of an output error as the choice of its features reads: one unknown, three of them."""

    kept: Any

    @property
    def basis(self) -> Any:
        return SimpleNamespace(n_trend=1)

    def fitted(self) -> Any:
        return self.kept.flatten()


@pytest.mark.parametrize(
    ("last", "kept"),
    [(2.0, 2), (2.0 + 1e-6, 2), (2.0 - 1e-6, 2), (2.5, 3), (1.5, 2)],
)
def test_a_tie_goes_to_fewer_features(last: float, kept: int) -> None:
    """``last`` is what the third feature lowers chi-square by: 2 is Akaike's price of a number."""
    from pipeline.identification.selection import drop_features

    free = torch.tensor([[[9.0, 9.0, last**0.5]]], dtype=torch.float64)
    problem: Any = _Features(torch.ones(1, 3, dtype=torch.bool))
    chosen, start = drop_features(problem, free, np.eye(3))
    assert int(chosen.kept.sum()) == kept
    assert bool((start[0, 0, kept:] == 0).all())


def test_of_equal_minima_the_first_goes_on() -> None:
    """Starts that ended in one valley differ by rounding; those of other valleys follow, the best first."""
    from pipeline.problem.ranking import find_distinct

    for tie in (1e-9, -1e-9):
        assert find_distinct([3.0, 1.0, 1.0 + tie, 2.0, 1.005]) == [1, 3, 0]
    assert find_distinct([1.00001, 1.0]) == [1], "the better of two that differ"
    assert find_distinct([float("inf"), 1.0]) == [1, 0]


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


@pytest.mark.parametrize(("error", "text"), [(4.2e-12, "< 1e-8"), (0.0, "< 1e-8"), (1.234e-7, "1.2e-7"), (26.1, "26")])
def test_digits_of_rounding_are_not_printed(error: float, text: str) -> None:
    from pipeline.reporting.comparison import format_error

    assert format_error(error) == text
