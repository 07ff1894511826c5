"""All methods on all cases: in several processes, each result kept in a file, so that none is done again."""

from __future__ import annotations

import json
import multiprocessing
import signal
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import ProcessPoolExecutor, as_completed
from concurrent.futures.process import BrokenProcessPool
from pathlib import Path

from pydantic import ValidationError

from pipeline.comparison.cases import Case, Machine, Result, judge_method
from pipeline.config.comparison import MethodName
from pipeline.errors import DataError, PipelineError
from pipeline.files import hash_parts, read_json, write_json
from pipeline.processes import delay_interrupt, end_with_parent, limit_threads, settle_torch

_PACKAGES = ("comparison", "data", "identification", "laws", "methods", "problem", "rotor")
_ASKED = {"methods", "noise", "sensors", "speeds", "data_sets", "other_data_sets", "most_data_sets", "workers"}
"""Settings that say which results are asked for, and change none."""
Done = Callable[[int, int, Result], None]
"""(results so far, of how many, the newest one)."""


MethodRun = tuple[MethodName, Case]
"""One method on one case."""


def name_file(method: MethodName, case: Case) -> str:
    """Name of the file that keeps a result."""
    return f"{method}-{case.sensors}-{case.noise:g}-{case.speeds}-{case.data_set}.json"


def hash_inputs(machine: Machine) -> str:
    """The hash of machine, unknowns, settings and program; which cases are asked for does not change a result."""
    root = Path(__file__).parents[1]
    return hash_parts(
        machine.rotor.fingerprint,
        machine.vibration.fingerprint,
        machine.modelled.values.tobytes(),
        machine.identify.model_dump_json(),
        machine.settings.model_dump_json(exclude=_ASKED),
        f"{machine.noise_seed} {machine.seed}",
        json.dumps(machine.laws.to_record(), sort_keys=True) if machine.laws else "",
        *(path.read_bytes() for package in _PACKAGES for path in sorted((root / package).glob("*.py"))),
    )


def compare(machine: Machine, runs: Sequence[MethodRun], folder: Path, done: Done) -> list[Result]:
    """The results in the order of the runs; those that ``folder`` keeps are read.

    Raises StorageError where they can't be kept, PipelineError where a process dies, KeyboardInterrupt.
    """
    fingerprint = hash_inputs(machine)
    results = {run: kept for run in runs if (kept := _read_kept(folder / name_file(*run), fingerprint)) is not None}
    for run, result in _run_all(machine, [run for run in runs if run not in results]):
        write_json(folder / name_file(*run), {"fingerprint": fingerprint, "result": result.model_dump()})
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


def _run_all(machine: Machine, runs: Sequence[MethodRun]) -> Iterator[tuple[MethodRun, Result]]:
    workers = min(machine.settings.workers, len(runs))
    if workers <= 1:
        yield from ((run, judge_method(machine, *run)) for run in runs)
        return
    context = multiprocessing.get_context("spawn")  # torch and BLAS don't survive a fork
    with ProcessPoolExecutor(workers, context, _begin) as pool:
        try:
            with limit_threads(1), delay_interrupt():
                futures = {pool.submit(_work, machine, *run): run for run in runs}
            for future in as_completed(futures):
                yield futures[future], future.result()
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


_working = False
"""In a worker, whether a method is at work."""


def _begin() -> None:
    # The parent gets Ctrl-C too, and says when it is over: what is at work then ends, and the process in its own time.
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    signal.signal(signal.SIGTERM, _leave)
    end_with_parent()
    settle_torch(1)


def _leave(*_: object) -> None:
    if _working:
        raise SystemExit


def _work(machine: Machine, method: MethodName, case: Case) -> Result:
    global _working
    _working = True
    try:
        return judge_method(machine, method, case)
    finally:
        _working = False
