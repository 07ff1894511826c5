"""What the tests share: modelled machines, seeded generators, and the guard of the process's global state.

Nothing heavy is imported here: most tests of the command line run without numpy, torch or ROSS.
"""

from __future__ import annotations

import gc
import json
import os
import re
import shutil
import sys
from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import contextmanager, nullcontext
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any
from unittest.mock import Mock

import pytest
from hypothesis import settings

if TYPE_CHECKING:
    import numpy as np
    import torch

    from pipeline.config.schema import Config
    from pipeline.errors import PipelineError
    from pipeline.identification.training import FitSetup
    from pipeline.rotor.bearing_table import BearingTable
    from pipeline.tuning.study import StudyProblem
    from pipeline.unknowns import UnknownSet
    from studies import Forks, Told

# The tests judge the checkout that they lie in, wherever they are started and whatever is installed.
sys.path.insert(0, str(Path(__file__).resolve().parents[1]))

from benchmarks.machines import Machine
from benchmarks.machines import machine as modelled_machine

# The matrices are small: threads of numpy's BLAS and of torch wait for each other longer than they work, above all
# where another program has the second core.
for threads in ("OPENBLAS_NUM_THREADS", "OMP_NUM_THREADS"):
    os.environ.setdefault(threads, "1")

# ROSS compiles how it draws orbits of modes, 7 s in each process, and no test asks for many.
os.environ.setdefault("NUMBA_DISABLE_JIT", "1")

# The packages make a million objects that stay, as `pipeline/__main__.py` says.
gc.set_threshold(100_000, 50, 100)

# The same examples each time: a random failure helps nobody who did not change anything.
settings.register_profile("repeatable", derandomize=True, deadline=None, database=None, max_examples=100)
settings.register_profile("nightly", parent=settings.get_profile("repeatable"), max_examples=1000)
settings.load_profile("repeatable")


def pytest_configure(config: pytest.Config) -> None:
    """`-m nightly` tries ten times the examples."""
    chosen = str(config.option.markexpr)
    if "nightly" in chosen and "not nightly" not in chosen:
        settings.load_profile("nightly")


def pytest_ignore_collect(collection_path: Path, config: pytest.Config) -> bool | None:
    """Where slow tests are left out, their modules are not even imported: that takes seconds."""
    if "not slow" not in config.option.markexpr or collection_path.suffix != ".py":
        return None
    slow = re.search(r"^pytestmark = \[?pytest\.mark\.slow", collection_path.read_text(encoding="utf-8"), re.M)
    return True if slow else None


@pytest.hookimpl(tryfirst=True)
def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    """What lies in nightly/ is nightly; with more examples, so is a test of examples."""
    more = settings.get_current_profile_name() == "nightly"
    for item in items:
        if item.path.parent.name == "nightly" or (more and getattr(item.obj, "is_hypothesis_test", False)):
            item.add_marker("nightly")


def examples(count: int) -> settings:
    """``count`` examples, and ten times as many where the profile is the nightly one."""
    return settings(max_examples=count * settings().max_examples // 100)


DATA = {"vibration.parquet", "excitation.csv", "known_coefficients.csv", "modelled_coefficients.csv"}
"""What ``generate`` writes into an experiment's folder."""
ANSWER = {
    *("model.safetensors", "model.json", "uncertainty.safetensors", "identified_coefficients.csv"),
    *("bad_points.csv", "residual_unbalance.csv", "model_parameters.csv", "history.csv", "training.json"),
}
"""What ``train`` adds."""


MachineFactory = Callable[..., Machine]
Run = Callable[..., "Config"]


def bearings_of(nodes: tuple[int, ...], speeds: np.ndarray, **coefficients: float) -> BearingTable:
    """The same coefficients at every node and speed (rad/s); those not named are zero."""
    import numpy as np

    from pipeline.coefficients import COEFFICIENTS
    from pipeline.rotor.bearing_table import BearingTable

    values = np.zeros((len(nodes), len(speeds), len(COEFFICIENTS)))
    for name, value in coefficients.items():
        values[..., COEFFICIENTS.index(name)] = value
    return BearingTable(nodes, np.asarray(speeds, dtype=float), values)


def unknown_at_all(nodes: tuple[int, ...], names: Sequence[str], shared: bool = False) -> UnknownSet:
    """The same coefficients unknown at every bearing, without a structure."""
    from pipeline.unknowns import tie, unknown_set

    return unknown_set(dict.fromkeys(nodes, tie(tuple(names))), shared)


def known_names(config: Config) -> tuple[str, ...]:
    """The coefficients that an experiment takes as known."""
    from pipeline.coefficients import COEFFICIENTS

    return tuple(name for name in COEFFICIENTS if name not in config.identify.named())


def with_machine(config: Config, **parts: object) -> Config:
    """``config`` with other parts of its machine."""
    return config.model_copy(update={"machine": config.machine.model_copy(update=parts)})


@pytest.fixture(scope="session")
def machine() -> MachineFactory:
    """``machine("experiment=NAME", ...)``: the machine of these overrides, made once a session."""
    return modelled_machine


@pytest.fixture(scope="session")
def hydrostatic(machine: MachineFactory) -> Machine:
    """The two discs on fluid-film bearings, 60 speeds from 100 to 6000 rpm, three runs."""
    return machine("experiment=hydrostatic_stiffness", "machine.speeds.step_rpm=100")


@pytest.fixture(scope="session")
def rotor_of(machine: MachineFactory) -> Machine:
    """The hydrostatic rotor at 60 speeds, where a file has no other."""
    return machine("experiment=noisy_stiffness", "machine.speeds.step_rpm=100")


@pytest.fixture(scope="session")
def ball(machine: MachineFactory) -> Machine:
    """The disc on two ball bearings, 25 speeds from 100 to 6000 rpm, one run."""
    return machine("experiment=ball_bearing", "machine.speeds.step_rpm=245")


@pytest.fixture
def rng() -> np.random.Generator:
    """A numpy generator of its own for each test, always the same."""
    import numpy as np

    return np.random.default_rng(20221115)


@pytest.fixture
def generator() -> torch.Generator:
    """A torch generator of its own for each test, always the same."""
    import torch

    return torch.Generator().manual_seed(20221115)


@pytest.fixture
def one_thread() -> Iterator[None]:
    """torch on one thread, as with ``threads: 1`` of the configuration."""
    import torch

    before = torch.get_num_threads()
    torch.set_num_threads(1)
    yield
    torch.set_num_threads(before)


@pytest.fixture(scope="session")
def run() -> Run:
    """``run(stage, of, folder)``: a stage of a configuration, or of overrides, in a folder; its configuration.

    Keywords are sections that take the place of the configuration's own.
    """
    from running import composed

    from pipeline.stages import run_stage

    def run_in(stage: str, of: Config | Sequence[str], folder: Path, **sections: object) -> Config:
        config = of if hasattr(of, "model_copy") else composed("tracking=none", *of)
        config = config.model_copy(update={"stage": stage, "output": str(folder)} | sections)
        run_stage(config)
        return config

    return run_in


def _leave_pictures_out() -> Iterator[None]:
    """Pictures take half of a stage's time, have tests of their own, and the graph draws those of each experiment."""
    pixel = memoryview(bytes(4)).cast("B", (1, 1, 4))
    drawing = Mock(**{"get_figheight.return_value": 1.0, "canvas.buffer_rgba.return_value": pixel})
    drawing.savefig.side_effect = lambda path: path.write_bytes(b"a picture")
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("pipeline.reporting.matplotlib_figures.draw_panels", lambda *_: drawing)
        yield


no_pictures = pytest.fixture(_leave_pictures_out)
pictures_left_out = contextmanager(_leave_pictures_out)


class Made:
    """``made(experiment)``: the folder of an experiment of which every stage has run; not to be written to."""

    def __init__(self, run: Run, root: Path) -> None:
        self.run, self.root = run, root

    def __call__(self, experiment: str, pictures: bool = False) -> Path:
        """Run with few speeds and steps, once; once more with ``pictures``."""
        from running import LINE, few

        folder = self.root / (f"{experiment} with pictures" if pictures else experiment)
        with nullcontext() if pictures else pictures_left_out():
            for stage in LINE if not folder.exists() else ():
                self.run(stage, few(experiment), folder)
        return folder


@pytest.fixture(scope="session")
def made(run: Run, tmp_path_factory: pytest.TempPathFactory) -> Made:
    """The experiments run so far, each once."""
    return Made(run, tmp_path_factory.mktemp("made"))


@pytest.fixture(scope="session")
def setup() -> FitSetup:
    """How the small rig is fitted."""
    from running import composed
    from small_rotor import FITTED

    from pipeline.identification.training import setup_of

    return setup_of(composed(*FITTED))


@pytest.fixture(scope="session")
def base() -> Config:
    """Two ball bearings, eleven speeds, two runs, few steps."""
    from damaged import SMALL
    from running import composed

    return composed(*SMALL)


@pytest.fixture(scope="session")
def finished(base: Config, run: Run, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder in which every stage of ``base`` has run."""
    from running import LINE

    folder = tmp_path_factory.mktemp("finished") / "ball"
    with pictures_left_out():
        for stage in LINE:
            run(stage, base, folder)
    return folder


@pytest.fixture
def mine(finished: Path, tmp_path: Path) -> Path:
    """A copy of the finished folder, to be damaged."""
    return Path(shutil.copytree(finished, tmp_path / "my messung ü"))


@pytest.fixture
def refused_by_train(run: Run, base: Config, mine: Path) -> Callable[..., None]:
    """Training on ``files`` in place of those of ``mine`` is refused, and its output folder is not even made."""
    from damaged import measured
    from running import contents

    def act(
        files: dict[str, Path], *fragments: str, kind: type[PipelineError] | None = None, of: Config = base
    ) -> None:
        output, before = mine.parent / "output", contents(mine)
        with refused(*fragments, kind=kind):
            run("train", of, output, data=measured(mine, **files))
        assert not output.exists()
        assert contents(mine) == before

    return act


@pytest.fixture
def folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A folder with spaces in its name, and another one that commands are given in."""
    (tmp_path / "elsewhere").mkdir()
    monkeypatch.chdir(tmp_path / "elsewhere")
    made = tmp_path / "my rig, übersee"
    made.mkdir()
    return made


ARTIFACTS = Path(__file__).resolve().parents[1] / "artifacts"


@dataclass(frozen=True)
class Artifacts:
    """What `make reproduce` made: a folder for each experiment. Tests read it and write nothing there."""

    root: Path

    def __call__(self, experiment: str, *files: str) -> Path:
        """The folder of an experiment, in which ``files`` must be."""
        folder = self.root / experiment
        for name in files or ("config.yaml",):
            if not (folder / name).exists():
                pytest.fail(f"run `make reproduce` first: artifacts/{experiment}/{name} is missing", pytrace=False)
        return folder

    def read(self, experiment: str, name: str) -> Any:
        """A JSON file of an experiment, such as ``metrics``."""
        return json.loads((self(experiment, f"{name}.json") / f"{name}.json").read_text(encoding="utf-8"))

    def copied(self, experiment: str, files: Iterable[str], folder: Path) -> Path:
        """``folder``, with copies of ``files`` of an experiment."""
        folder.mkdir(parents=True, exist_ok=True)
        names = sorted(files)
        source = self(experiment, *names)
        for name in names:
            shutil.copy(source / name, folder / name)
        return folder


@pytest.fixture
def quiet() -> Iterator[None]:
    """For tests that use MLflow themselves."""
    from pipeline.tracking.store import quiet_mlflow

    with quiet_mlflow(10.0):
        yield


@pytest.fixture(scope="session")
def artifacts() -> Artifacts:
    """``artifacts(experiment, files)``: the folder of what the graph made for an experiment."""
    return Artifacts(ARTIFACTS)


@pytest.fixture(scope="session")
def cheap(tmp_path_factory: pytest.TempPathFactory) -> StudyProblem:
    """A study of trials that take a tenth of a second; its data are not to be written to."""
    from studies import cheap_problem

    return cheap_problem(tmp_path_factory.mktemp("study") / "data")


@pytest.fixture
def make(cheap: StudyProblem, tmp_path: Path) -> Callable[..., StudyProblem]:
    """``make(n_trials=5)``: the cheap study with its storage in ``tmp_path`` and these values of ``tuning``."""
    from studies import with_tuning

    places = {"storage": f"sqlite:///{tmp_path}/studies.db", "folder": str(tmp_path / "best")}
    return lambda **tuning: with_tuning(cheap, **(places | tuning))


@pytest.fixture(scope="session")
def start(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Forks]:
    """``start(problem)``: a process that runs the study."""
    from studies import Forks

    forks = Forks(tmp_path_factory.mktemp("forks"))
    yield forks
    forks.close()


@pytest.fixture(scope="session")
def undisturbed(
    cheap: StudyProblem, start: Forks, tmp_path_factory: pytest.TempPathFactory
) -> Callable[..., list[Told]]:
    """``undisturbed(sampler="gp")``: the trials of a study with these values of ``tuning`` that nothing disturbed."""
    from studies import finished, trials_of, with_tuning

    known: dict[str, list[Told]] = {}

    def trials(**tuning: Any) -> list[Told]:
        key = json.dumps(tuning, sort_keys=True)
        if key not in known:
            storage = f"sqlite:///{tmp_path_factory.mktemp('reference')}/studies.db"
            problem = with_tuning(cheap, storage=storage, **tuning)
            runner = start(problem)
            assert (runner.end(), runner.said) == (0, "")
            known[key] = finished(problem)
            assert len(trials_of(problem)) == len(known[key]), "none was repeated"
        return known[key]

    return trials


@pytest.fixture(autouse=True)
def _global_state_is_left_alone() -> Iterator[None]:
    """No test, and nothing that it calls, leaves another folder, torch, matplotlib or Hydra state behind.

    torch's number of threads is the one thing that a stage sets (``threads`` of the configuration): put back.
    """
    before = _global_state()
    threads = sys.modules["torch"].get_num_threads() if _imported("torch") else None
    yield
    if threads is not None:
        sys.modules["torch"].set_num_threads(threads)
    after = _global_state()
    changed = [name for name, value in before.items() if after[name] != value]
    assert not changed, f"the test changed global state: {changed}"
    for name, quiet in _QUIET.items():
        assert after.get(name, quiet) == quiet, f"the test left {name} = {after[name]!r}"


_QUIET = {"open figures": [], "Hydra is set up": False}
"""What holds also for a package that the test was the first to import."""


def _imported(name: str) -> bool:
    module = sys.modules.get(name)
    return module is not None and not getattr(module.__spec__, "_initializing", False)


def _global_state() -> dict[str, Any]:
    """Only what is imported already: looking must import nothing."""
    state: dict[str, Any] = {"working folder": os.getcwd()}
    if _imported("torch"):
        torch = sys.modules["torch"]
        state["torch's default type"] = torch.get_default_dtype()
        state["torch's gradient mode"] = torch.is_grad_enabled()
        state["torch's determinism"] = torch.are_deterministic_algorithms_enabled()
        state["torch's generator"] = torch.get_rng_state().numpy().tobytes()
    if _imported("numpy"):
        kind, keys, *rest = sys.modules["numpy"].random.get_state()  # watched, not used
        state["numpy's generator"] = (kind, keys.tobytes(), *rest)
    if _imported("matplotlib"):
        # Reading the backend would choose one and import pyplot.
        settings_of = sys.modules["matplotlib"].rcParams
        state["matplotlib's settings"] = {key: settings_of[key] for key in settings_of if key != "backend"}
    if _imported("matplotlib.pyplot"):
        state["open figures"] = sys.modules["matplotlib.pyplot"].get_fignums()
    if _imported("hydra.core.global_hydra"):
        state["Hydra is set up"] = sys.modules["hydra.core.global_hydra"].GlobalHydra.instance().is_initialized()
    return state


@contextmanager
def refused(*fragments: str, kind: type[PipelineError] | None = None) -> Iterator[pytest.ExceptionInfo[Exception]]:
    """The block must end in an error of ours (a DataError if nothing is said) whose text has all ``fragments``."""
    from pipeline.errors import DataError

    with pytest.raises(kind or DataError) as caught:
        yield caught
    sentence = str(caught.value)
    assert_says(sentence, *fragments)
    assert "Traceback" not in sentence
    assert len(sentence) < 900


def assert_says(text: str, *fragments: str) -> None:
    """``text`` has all ``fragments``; those that it lacks are named."""
    assert [fragment for fragment in fragments if fragment not in text] == [], text
