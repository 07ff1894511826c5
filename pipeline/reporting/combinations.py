"""What is known best and least of constant coefficients, in words and for JSON."""

from __future__ import annotations

from typing import Any

from pipeline.identification.combinations import WORTH, Combinations
from pipeline.units import RAD_S_PER_RPM


def describe_combinations(found: Combinations) -> str:
    """Sentences: the best and the least known combination, the run that would tell more, and the tolerances."""
    text = f"known best is {found.strongest.words} (+- {100 * found.strongest.deviation:.2g} %), "
    text += f"known least is {found.weakest.words} (+- {100 * found.weakest.deviation:.2g} %)"
    run = found.next_run
    if run is not None:
        rpm = run.speed / RAD_S_PER_RPM
        text += f"; '{run.run}' at {rpm:.4g} rpm besides would tell that to +- {100 * run.deviation:.2g} %"
    told = {kind: span for kind, span in found.parameters.items() if span[0] < WORTH}
    untold = [kind for kind in found.parameters if kind not in told]
    if told:
        listed = ", ".join(f"{kind} {_describe_span(*span)}" for kind, span in told.items())
        text += f". The data narrow the tolerances (what is left, as a share): {listed}"
    if untold:
        text += f". They tell next to nothing of {', '.join(untold)}"
    return text + "."


def _describe_span(least: float, most: float) -> str:
    return f"{least:.2g}" if most - least < 0.05 else f"{least:.2g} to {most:.2g}"


def summarize_combinations(found: Combinations) -> dict[str, Any]:
    """The same for JSON, deviations in percent."""
    run, ends = found.next_run, (("strongest", found.strongest), ("weakest", found.weakest))
    more = None
    if run is not None:
        more = {"run": run.run, "speed_rpm": run.speed / RAD_S_PER_RPM, "deviation_percent": 100 * run.deviation}
    return {
        "sentence": describe_combinations(found),
        **{name: {"deviation_percent": 100 * one.deviation, "shares": dict(one.shares)} for name, one in ends},
        "posterior_over_prior": {kind: list(span) for kind, span in found.parameters.items()},
        "next_run": more,
    }
