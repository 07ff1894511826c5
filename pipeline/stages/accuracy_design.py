"""The runs and speeds that reach a stated accuracy at the machine's probes (``design.accuracy``), or why none do."""

from __future__ import annotations

import itertools
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from pipeline.config.messages import quote_override
from pipeline.config.runs import CandidateConfig
from pipeline.config.schema import Config
from pipeline.data.dataset import Excitation
from pipeline.data.sensors import list_directions, project
from pipeline.data.simulate import simulate
from pipeline.files import write_json, write_text
from pipeline.problem.accuracy import Plan, RunInformation, reach, run_information, scale_to_limits
from pipeline.problem.measurement import Measurement
from pipeline.problem.ranking import rank
from pipeline.reporting.console import say, table
from pipeline.rotor.bearing_table import BearingTable
from pipeline.rotor.model import RotorModel
from pipeline.rotor.parameters import OF_WEIGHT
from pipeline.rotor.stored import load_modelled_bearings, load_rotor
from pipeline.stages.diagnose import describe_noise
from pipeline.stages.execution import StageOutput
from pipeline.stages.generate import configure_sensors
from pipeline.stages.measurement import build_measurement
from pipeline.stages.planned_runs import Runs, format_runs, list_candidates, scale_runs
from pipeline.stages.workspace import locate_files, require_nodes
from pipeline.units import RAD_S_PER_RPM


@dataclass(frozen=True)
class Designer:
    """A machine that runs are designed for, on its modelled bearings."""

    config: Config
    rotor: RotorModel
    prior: BearingTable

    def limit(self, runs: Runs) -> Runs:
        """The runs, made smaller where an orbit would leave its share of the clearance."""
        complete = simulate(self.rotor, self.prior, tuple(itertools.chain.from_iterable(runs)))
        motion = project(complete, list_directions(self.rotor.bearing_nodes)).displacement
        orbits = motion.reshape(len(motion), -1, 2, len(runs))
        scale = scale_to_limits(orbits, self.config.design.clearance * self._clearances())
        return scale_runs(runs, scale)

    def _clearances(self) -> np.ndarray:
        """(B,) m, infinite for a bearing that states none."""
        bearings = [self.config.machine.bearings.at(node) for node in self.rotor.bearing_nodes]
        return np.array([getattr(bearing, "radial_clearance", np.inf) for bearing in bearings])

    def measure(self, runs: Runs) -> Measurement:
        """What the probes would read of the runs, without noise."""
        complete = simulate(self.rotor, self.prior, tuple(itertools.chain.from_iterable(runs)))
        channels = configure_sensors(self.config, self.rotor).channels
        seen = complete if channels is None else project(complete, channels)
        return build_measurement(self.config, self.rotor, seen, self.prior)

    def inform(self, plan: Measurement) -> RunInformation:
        """What each run would tell."""
        return run_information(plan, self.config.design.functions)

    def steps(self) -> list[int]:
        """Every how many of the speeds could be enough: both ends stay, and two speeds for each term or more."""
        intervals, least = len(self.prior.speeds) - 1, 2 * self.config.design.functions - 1
        return [k for k in range(1, intervals + 1) if intervals % k == 0 and intervals // k >= least] or [1]


def reach_accuracy(config: Config, accuracy: float) -> StageOutput:
    """``design.json`` and ``designed_excitation.yaml``, which can be used at once."""
    rotor, can, machine = load_rotor(config.machine.rotor), config.machine.candidates, config.machine
    speeds = np.array(machine.speeds.rpm()) * RAD_S_PER_RPM
    designer = Designer(config, rotor, load_modelled_bearings(machine.rotor, machine.bearings, speeds))
    possible = list_candidates(can)
    require_nodes(rotor, "machine.candidates", [weight.node for acting in possible for weight in acting])
    allowed = designer.limit(possible)
    plan = designer.measure(allowed)
    information = designer.inform(plan)
    best = reach(information, accuracy, config.design.runs, designer.steps())
    chosen, predicted = [allowed[c] for c in best.runs], information.medians(best.runs, best.every)
    plan_speeds = machine.speeds.model_copy(update={"step_rpm": best.every * machine.speeds.step_rpm})
    cures = {} if best.reached else _try_cures(designer, allowed, plan)
    numbers = {"accuracy": accuracy, "reached": best.reached, "predicted": predicted, "cures": cures}
    _print(config, numbers, chosen, best, plan_speeds.rpm())
    folder = locate_files(config).folder
    about = {"runs": [acting[0].run for acting in chosen], "speeds": plan_speeds.model_dump()}
    about["stated_noise"] = config.stated_noise.model_dump()
    written = [
        write_text(folder / "designed_excitation.yaml", format_runs(config, chosen, plan_speeds)),
        write_json(folder / "design.json", numbers | about),
    ]
    say(
        f"use them with: python -m pipeline stage=train {config.chosen} "
        f"{quote_override('machine.runs_file', str(written[0]))} {quote_override('output', f'{folder}_designed')}"
        + "".join(f" identify.model_parameters.{kind}=null" for kind in _superfluous(config, chosen))
    )
    return StageOutput({"predicted": predicted}, {"rotor_fingerprint": rotor.fingerprint}, written)


def _superfluous(config: Config, chosen: Sequence[Sequence[Excitation]]) -> list[str]:
    """The tolerances that a fit of these runs would refuse, as none has a weight."""
    weighed = any(weight.kind == "unbalance" for acting in chosen for weight in acting)
    return [] if weighed else [kind for kind in config.identify.model_parameters.deviations if kind in OF_WEIGHT]


def _try_cures(designer: Designer, allowed: Runs, plan: Measurement) -> dict[str, float]:
    """What would help -> the worst deviation with it, at all speeds."""
    most, can = designer.config.design.runs, designer.config.machine.candidates

    def worst(measurement: Measurement, runs: int = most) -> float:
        information = designer.inform(measurement)
        return information.worst(reach(information, 0.0, runs, [1]).runs)

    floorless = replace(plan, noise=replace(plan.noise, additive=0.0))
    cures = {
        f"all {len(allowed)} candidate runs": worst(plan, len(allowed)),
        "weights and forces twice as large": worst(designer.measure(scale_runs(allowed, np.full(len(allowed), 2.0)))),
    }
    if plan.noise.additive and plan.noise.multiplicative:
        cures["probes without a floor"] = worst(floorless)
    if plan.parameters:
        cures["a model that is known exactly"] = worst(replace(plan, parameters=()))
    if not (can.force_nodes and "backward" in can.whirls):
        nodes = can.force_nodes or can.unbalance_nodes
        cures["a force that turns backward"] = worst(designer.measure(allowed + designer.limit(_backward(can, nodes))))
    return cures


def _backward(can: CandidateConfig, nodes: Sequence[int]) -> Runs:
    return tuple((Excitation(f"backward_force_{n}", "force", n, can.force, 0.0, "backward"),) for n in nodes)


def _print(
    config: Config, numbers: dict[str, object], chosen: Sequence[Sequence[Excitation]], best: Plan, rpm: Sequence[float]
) -> None:
    predicted, accuracy, cures = numbers["predicted"], numbers["accuracy"], numbers["cures"]
    assert isinstance(predicted, dict)
    assert isinstance(cures, dict)
    assert isinstance(accuracy, float)
    rows = [[key, f"{100 * share:.2g}", "" if share <= accuracy else "not reached"] for key, share in predicted.items()]
    title = f"{config.name}: predicted standard deviation at {describe_noise(config)}, % of the coefficient (median)"
    table(title, ["bearing and unknown", "designed runs", f"at most {100 * accuracy:g}"], rows)
    acting = "; ".join(
        f"{run[0].run}: " + ", ".join(f"{e.magnitude:.3g} {'kg m' if e.kind == 'unbalance' else 'N'}" for e in run)
        for run in chosen
    )
    say(f"{config.name}: {len(chosen)} runs ({acting}) at {len(rpm)} speeds from {rpm[0]:g} to {rpm[-1]:g} rpm")
    if best.reached:
        say(f"every coefficient is predicted to {100 * accuracy:g} % or better")
        return
    short = {key: share for key, share in predicted.items() if share > accuracy}
    worst = rank(short)[0]
    say(
        f"{100 * accuracy:g} % can't be reached with {len(chosen)} runs for {len(short)} of {len(predicted)} "
        f"coefficients; the worst, {worst}, is known to {100 * short[worst]:.2g} % at best"
    )
    for name in reversed(rank(cures)):
        deviation = cures[name]
        say(f"with {name} the worst is {100 * deviation:.2g} %" + (" (enough)" if deviation <= accuracy else ""))
