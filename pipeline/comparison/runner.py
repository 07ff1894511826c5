"""All methods on all cases: in several processes, each result kept in a file, so that none is done again."""

from __future__ import annotations

import json
import multiprocessing
import signal
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import FIRST_COMPLETED, ProcessPoolExecutor, wait
from concurrent.futures.process import BrokenProcessPool
from dataclasses import dataclass
from pathlib import Path

from pydantic import ValidationError

from pipeline.cache import hash_parts
from pipeline.comparison.cases import Case, Machine
from pipeline.comparison.result import Result, judge_method
from pipeline.config.comparison import ComparisonConfig, MethodName
from pipeline.config.identification import IdentifyConfig
from pipeline.errors import DataError, PipelineError
from pipeline.files import read_json, write_json
from pipeline.processes import delay_interrupt, end_with_parent, limit_threads

_PACKAGES = ("comparison", "data", "identification", "laws", "methods", "problem", "rotor")
_ASKED = {"methods", "noise", "sensors", "speeds", "data_sets", "other_data_sets", "most_data_sets", "workers"}
"""Settings that say which results are asked for, and change none."""
Done = Callable[[int, int, Result], None]
"""(results so far, of how many, the newest one)."""


@dataclass(frozen=True)
class MethodRun:
    """One method on one case."""

    method: MethodName
    case: Case

    @property
    def file(self) -> str:
        """Name of the file that keeps the result."""
        case = self.case
        return f"{self.method}-{case.sensors}-{case.noise:g}-{case.speeds}-{case.data_set}.json"


@dataclass(frozen=True, eq=False)
class ComparisonSetup:
    """Everything that determines a result, except the run."""

    machine: Machine
    identify: IdentifyConfig
    settings: ComparisonConfig
    seed: int

    def result(self, run: MethodRun) -> Result:
        """Let the method of the run identify its case."""
        return judge_method(self.machine, run.method, run.case, self.identify, self.settings, self.seed)

    def fingerprint(self) -> str:
        """The hash of machine, unknowns, settings and program; which cases are asked for does not change a result."""
        machine = self.machine
        root = Path(__file__).parents[1]
        return hash_parts(
            machine.rotor.fingerprint,
            machine.vibration.fingerprint,
            machine.modelled.values.tobytes(),
            self.identify.model_dump_json(),
            self.settings.model_dump_json(exclude=_ASKED),
            f"{machine.noise_seed} {self.seed}",
            "" if machine.laws is None else json.dumps(machine.laws.to_record(), sort_keys=True),
            *(path.read_bytes() for package in _PACKAGES for path in sorted((root / package).glob("*.py"))),
        )


def compare(setup: ComparisonSetup, runs: Sequence[MethodRun], folder: Path, done: Done) -> list[Result]:
    """The results in the order of the runs; those that ``folder`` keeps are read.

    Raises StorageError where they can't be kept, PipelineError where a process dies, KeyboardInterrupt.
    """
    fingerprint = setup.fingerprint()
    results = {run: kept for run in runs if (kept := _read_kept(folder / run.file, fingerprint)) is not None}
    todo = [run for run in runs if run not in results]
    for run, result in _run_all(setup, todo):
        write_json(folder / run.file, {"fingerprint": fingerprint, "result": result.model_dump()})
        results[run] = result
        done(len(results), len(runs), result)
    return [results[run] for run in runs]


def _read_kept(path: Path, fingerprint: str) -> Result | None:
    """A result that is there already; None where another configuration or program made it, or it is damaged."""
    if not path.exists():
        return None
    try:
        content = read_json(path)
        return Result.model_validate(content["result"]) if content["fingerprint"] == fingerprint else None
    except (DataError, KeyError, ValidationError):
        return None


def _run_all(setup: ComparisonSetup, runs: Sequence[MethodRun]) -> Iterator[tuple[MethodRun, Result]]:
    workers = min(setup.settings.workers, len(runs))
    if workers <= 1:
        yield from ((run, setup.result(run)) for run in runs)
        return
    context = multiprocessing.get_context("spawn")  # torch and BLAS don't survive a fork
    with ProcessPoolExecutor(workers, context, _begin, (setup,)) as pool:
        try:
            with limit_threads(1), delay_interrupt():
                futures = {pool.submit(_work, run): run for run in runs}
            while futures:
                finished, _ = wait(futures, return_when=FIRST_COMPLETED)
                for future in finished:
                    yield futures.pop(future), future.result()
        except BrokenProcessPool:
            raise PipelineError(
                "every process of the comparison must live, but one was killed (too little memory?): run the same "
                "command again to go on, with comparison.workers=1 for less memory"
            ) from None
        except BaseException:
            pool.shutdown(wait=False, cancel_futures=True)
            for process in multiprocessing.active_children():
                process.terminate()
            raise


_setup: ComparisonSetup | None = None
"""A worker has its own: sent once, not with every run."""
_working = False


def _begin(setup: ComparisonSetup) -> None:
    global _setup
    import torch

    # The parent gets Ctrl-C too, and says when it is over: what is at work then ends, and the process in its own time.
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    signal.signal(signal.SIGTERM, _leave)
    end_with_parent()
    torch.set_num_threads(1)
    _setup = setup


def _leave(*_: object) -> None:
    if _working:
        raise SystemExit


def _work(run: MethodRun) -> Result:
    global _working
    assert _setup is not None
    _working = True
    try:
        return _setup.result(run)
    finally:
        _working = False
