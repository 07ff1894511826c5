"""What the tests of the comparison share: tasks of modelled machines, answered by a method, and the answer's error."""

from __future__ import annotations

from functools import cache

import numpy as np
from running import composed

from pipeline.comparison.cases import Case, Machine
from pipeline.methods.catalogue import METHODS
from pipeline.methods.method import Estimate, MethodOptions
from pipeline.problem.measurement import Measurement
from pipeline.stages.compare import build_machine

FILM = ("experiment=hydrostatic_stiffness", "machine.speeds.step_rpm=100")


@cache
def machine(*overrides: str) -> Machine:
    """The modelled machine of an experiment."""
    return build_machine(composed(*overrides))


def task(case: Case, *overrides: str) -> Measurement:
    """What a method sees of a case."""
    return machine(*overrides).measure(case)


def options(*overrides: str) -> MethodOptions:
    """What a method may know beside it."""
    config = composed(*overrides)
    return MethodOptions(config.comparison, config.seed, machine(*overrides).laws)


@cache
def answer(method: str, case: Case, *overrides: str) -> Estimate:
    """What a method makes of it, once for all tests that ask."""
    return METHODS[method].identify(task(case, *overrides), options(*overrides))


def errors(estimate: Estimate, case: Case, *overrides: str) -> np.ndarray:
    """(U,) median error over speed in percent of each unknown, the worst bearing's."""
    truth, unknowns = machine(*overrides).truth(case), task(case, *overrides).unknowns
    with np.errstate(divide="ignore", invalid="ignore"):
        relative = 100 * np.abs(estimate.coefficients.values / truth.values - 1)
    found = [np.median(relative[b, :, c]) for b, c in np.argwhere(unknowns.identified) if truth.values[b, 0, c]]
    return np.array(found)
