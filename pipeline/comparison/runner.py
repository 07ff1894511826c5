"""All methods on all cases: in several processes, each result kept in a file, so that none is done again."""

from __future__ import annotations

import json
from collections.abc import Callable, Sequence
from functools import partial
from pathlib import Path

from pydantic import ValidationError

from pipeline.comparison.cases import Case, Machine, MethodRun, Result, judge_method
from pipeline.config.comparison import MethodName
from pipeline.errors import DataError
from pipeline.files import hash_parts, read_json, write_json
from pipeline.processes import run_all

_PACKAGES = ("comparison", "data", "identification", "laws", "methods", "problem", "rotor")
_ASKED = {"methods", "noise", "sensors", "speeds", "data_sets", "other_data_sets", "most_data_sets", "workers"}
"""Settings that say which results are asked for, and change none."""
Done = Callable[[int, int, Result], None]
"""(results so far, of how many, the newest one)."""


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
    rest = [run for run in runs if run not in results]
    less = "comparison.workers=1"
    for i, result in run_all(partial(judge_method, machine), rest, machine.settings.workers, 1, less):
        run = rest[i]
        write_json(folder / name_file(*run), {"fingerprint": fingerprint, "result": result.model_dump()})
        results[run] = result
        done(len(results), len(runs), result)
    return [results[run] for run in runs]


def _read_kept(path: Path, fingerprint: str) -> Result | None:
    """A result that is there already; None where there is none, another configuration or program made it, or it is
    damaged."""
    try:
        content = read_json(path)
        return Result.model_validate(content["result"]) if content["fingerprint"] == fingerprint else None
    except (DataError, KeyError, ValidationError):
        return None
