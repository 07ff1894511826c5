"""Which model of the coefficients the data ask for: laws, laws with a correction, or a network."""

from __future__ import annotations

from dataclasses import asdict

from pipeline.config.schema import Config
from pipeline.data.tables import write_table
from pipeline.files import write_json
from pipeline.identification.choice import Judged, choose, judge_models, setup_model
from pipeline.identification.training import setup_of
from pipeline.reporting.console import say, table
from pipeline.stages.analysis import Analysis, use_threads
from pipeline.stages.measurement import prepare
from pipeline.tracking import StageRecord
from pipeline.write_numbers import write_number, write_rough

_MODELS = {"law": "law", "hybrid": "hybrid", "network": "network_operating"}
"""From simple to free: a tie goes to the first."""


def run(analysis: Analysis) -> StageRecord:
    """``choice.json`` and ``choice.csv``: a row a model.

    Raises ConfigError for data of a single state; as a fit does.
    """
    config, measurement = analysis.config, prepare(analysis)
    use_threads(config)
    setup = setup_of(config)
    kinds = list(_MODELS) if measurement.laws else ["network"]
    setups = {kind: setup_model(setup, kind) for kind in kinds}
    judged = judge_models(measurement, setups, lambda what: say(f"{config.name}: fits {what}"))
    chosen = choose(judged)
    _print(config, judged, chosen)
    folder = analysis.folder
    summary = {
        "chosen": chosen.name,
        "models": {model.name: asdict(model) | {"rejected": model.rejected} for model in judged},
    }
    rows = [
        {"model": model.name, "probability": model.probability, "criterion": model.criterion, "numbers": model.numbers}
        | {f"held_out_{label.replace(' ', '_')}": square for label, square in model.held_out.items()}
        for model in judged
    ]
    return StageRecord(
        {"choice": summary},
        {"data_fingerprint": measurement.dataset.fingerprint},
        [write_json(folder / "choice.json", summary), write_table(folder / "choice.csv", rows)],
    )


def _print(config: Config, judged: tuple[Judged, ...], chosen: Judged) -> None:
    labels = list(judged[0].held_out)
    header = ["model", "probability", "Akaike", "numbers", *(f"without {label}" for label in labels)]
    table(
        f"{config.name}: models, and the mean square of readings that were not fitted (1 is noise)",
        header,
        [
            [
                candidate.name,
                "-" if candidate.probability is None else write_rough(candidate.probability),
                f"{candidate.criterion - min(other.criterion for other in judged):.0f}",
                f"{candidate.numbers:.0f}",
                *(write_number(candidate.held_out[label], digits=3) for label in labels),
            ]
            for candidate in judged
        ],
    )
    for model in judged:
        if model.rejected:
            say(f"{config.name}: the readings contradict {model.name} (probability {write_rough(model.probability)})")
    why = (
        "it predicts best, but the readings contradict every model: check rotor, probes and weights"
        if chosen.rejected
        else "the simplest that is not contradicted and predicts as well as the best"
    )
    say(f"{config.name}: choose model={_MODELS[chosen.name]}: {why}")
