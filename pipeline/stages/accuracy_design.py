"""The runs and speeds that reach a stated accuracy at the machine's probes (``design.accuracy``), or why none do."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

from pipeline.config.schema import Config
from pipeline.data.dataset import Excitation
from pipeline.problem.planning import Designer, Planner, list_clearances, list_possible
from pipeline.problem.ranking import rank
from pipeline.reporting.console import say, table
from pipeline.rotor.parameters import OF_WEIGHT
from pipeline.rotor.stored import load_modelled_bearings, load_rotor
from pipeline.stages.analysis import Analysis
from pipeline.stages.diagnose import describe_noise
from pipeline.stages.execution import StageOutput
from pipeline.stages.planned_runs import write_design


def reach_accuracy(analysis: Analysis, accuracy: float) -> StageOutput:
    """``design.json`` and ``designed_excitation.yaml``, which can be used at once."""
    config, machine = analysis.config, analysis.config.machine
    rotor = load_rotor(machine.rotor)
    prior = load_modelled_bearings(machine.rotor, machine.bearings, machine.speeds.rad_s())
    planner = Planner(config, rotor, list_clearances(config, rotor))
    allowed = planner.limit(list_possible(config, rotor), prior)
    best, predicted, cures = Designer(planner, prior, allowed).reach(accuracy)
    chosen = [allowed[c] for c in best.runs]
    speeds = machine.speeds.model_copy(update={"step_rpm": best.every * machine.speeds.step_rpm})
    _print(config, accuracy, predicted, cures, chosen, speeds.rpm())
    numbers = {"accuracy": accuracy, "reached": best.reached, "predicted": predicted, "cures": cures}
    # A fit refuses tolerances of weights where no run has any.
    weighed = any(weight.kind == "unbalance" for acting in chosen for weight in acting)
    kinds = [] if weighed else [kind for kind in config.identify.model_parameters.deviations if kind in OF_WEIGHT]
    without = "".join(f" identify.model_parameters.{kind}=null" for kind in kinds)
    written = write_design(analysis, chosen, speeds, numbers | {"speeds": speeds.model_dump()}, without)
    return StageOutput({"predicted": predicted}, {"rotor_fingerprint": rotor.fingerprint}, written)


def _print(
    config: Config,
    accuracy: float,
    predicted: Mapping[str, float],
    cures: Mapping[str, float],
    chosen: Sequence[Sequence[Excitation]],
    rpm: Sequence[float],
) -> None:
    rows = [[key, f"{100 * share:.2g}", "" if share <= accuracy else "not reached"] for key, share in predicted.items()]
    title = f"{config.name}: predicted standard deviation at {describe_noise(config)}, % of the coefficient (median)"
    table(title, ["bearing and unknown", "designed runs", f"at most {100 * accuracy:g}"], rows)
    acting = "; ".join(
        f"{run[0].run}: " + ", ".join(f"{e.magnitude:.3g} {'kg m' if e.kind == 'unbalance' else 'N'}" for e in run)
        for run in chosen
    )
    say(f"{config.name}: {len(chosen)} runs ({acting}) at {len(rpm)} speeds from {rpm[0]:g} to {rpm[-1]:g} rpm")
    if max(predicted.values()) <= accuracy:
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
