"""What is known best and least of constant coefficients, in words and for JSON."""

from __future__ import annotations

from functools import partial
from typing import Any

from pipeline.identification.combinations import WORTH, Combinations
from pipeline.units import RAD_S_PER_RPM
from pipeline.write_numbers import write_number


def describe_combinations(combinations: Combinations) -> str:
    """Sentences: the best and the least known combination, the run that would tell more, and the tolerances."""
    ends = (("best", combinations.strongest), ("least", combinations.weakest))
    text = ", ".join(f"known {which} is {end.words} (+- {_show(100 * end.deviation)} %)" for which, end in ends)
    run = combinations.next_run
    if run is not None:
        rpm, deviation = write_number(run.speed / RAD_S_PER_RPM), _show(100 * run.deviation)
        text += f"; '{run.run}' at {rpm} rpm besides would tell that to +- {deviation} %"
    told = {kind: span for kind, span in combinations.parameters.items() if span[0] < WORTH}
    untold = [kind for kind in combinations.parameters if kind not in told]
    if told:
        listed = ", ".join(f"{kind} {_describe_span(*span)}" for kind, span in told.items())
        text += f". The data narrow the tolerances (what is left, as a share): {listed}"
    if untold:
        text += f". They tell next to nothing of {', '.join(untold)}"
    return text + "."


_show = partial(write_number, digits=2)


def _describe_span(least: float, most: float) -> str:
    return _show(least) if most - least < 0.05 else f"{_show(least)} to {_show(most)}"


def summarize_combinations(combinations: Combinations) -> dict[str, Any]:
    """The same for JSON, deviations in percent."""
    run, ends = combinations.next_run, (("strongest", combinations.strongest), ("weakest", combinations.weakest))
    more = None
    if run is not None:
        more = {"run": run.run, "speed_rpm": run.speed / RAD_S_PER_RPM, "deviation_percent": 100 * run.deviation}
    return {
        "sentence": describe_combinations(combinations),
        **{
            name: {"deviation_percent": 100 * combination.deviation, "shares": dict(combination.shares)}
            for name, combination in ends
        },
        "posterior_over_prior": {kind: list(span) for kind, span in combinations.parameters.items()},
        "next_run": more,
    }
