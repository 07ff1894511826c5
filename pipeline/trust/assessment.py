"""The Judgement on an answer: what speaks for it and against it, and which run or mistake is worth trying."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np

from pipeline.config.schema import Config
from pipeline.data.excitation_files import list_candidates
from pipeline.data.sensors import name_channel
from pipeline.evaluation.errors import find_contradiction
from pipeline.identification.fit import loss_of
from pipeline.identification.held_out import held_out_points, held_out_runs
from pipeline.identification.identified import Answer
from pipeline.identification.quality import MISMATCH
from pipeline.problem.measurement import Measurement
from pipeline.trust.evidence import Evidence, gather, leave_out_unbounded
from pipeline.trust.judgement import judge, refuse_without_deviations
from pipeline.trust.mistakes import WORTH_TRYING, Found, Probe, find_mistakes
from pipeline.trust.next_run import weigh_candidates
from pipeline.trust.verdict import find_contradicted, judge_contradiction, judge_mistakes


def judge_answer(config: Config, answer: Answer, about: Mapping[str, Any]) -> dict[str, Any]:
    """The record of the Judgement, with the mark of the model that it is of; ``about`` is ``training.json``."""
    if answer.uncertainty is None:
        felt = _may_have_supports(config)
        judged = refuse_without_deviations(answer.table.nodes, answer.names, felt).record()
    else:
        judged = assess(config, answer, about)[0]
    return judged | {"model": about["model"]}


def _may_have_supports(config: Config) -> bool:
    """Whether a support may be part of what is identified: anywhere but in a simulation of the machine as modelled, and
    where supports are stated beside the bearings."""
    simulated = not _is_given(config) and config.machine.recordings.format == "none"
    return not config.machine.rotor.n_casings and (not simulated or config.machine.as_built is not None)


def _is_given(config: Config) -> bool:
    """Whether the data are files of other programs."""
    return bool(config.data.vibration or config.data.excitation)


def assess(config: Config, answer: Answer, about: Mapping[str, Any]) -> tuple[dict[str, Any], Evidence]:
    """The Judgement on a fit that states deviations, and what it rests on; ``about`` has ``fit`` and ``outcome`` of
    ``training.json``."""
    updated, uncertainty = answer.measurement, answer.uncertainty
    assert uncertainty is not None
    updated, fitted = leave_out_unbounded(updated, answer.model, _mark_fitted(config, updated))
    given = (updated, answer.model, uncertainty)
    evidence, linear = gather(*given, about["fit"], fitted, about["outcome"])
    gains = weigh_candidates(*given, linear, list_candidates(config.machine.candidates))
    mistakes: list[Found] = []
    wanders = (about["fit"]["whiteness"].get("probability") or 0.0) < MISMATCH
    if wanders and evidence.misfit.of_stated > WORTH_TRYING:
        values = updated.unknowns.leading(evidence.answer.values)
        probes = () if _is_given(config) else _list_probes(config)
        mistakes = find_mistakes(updated.as_stated(), values, config.model.kind == "constant", probes)
    against = judge_mistakes(mistakes, list(find_contradicted(evidence)))
    against += judge_contradiction(find_contradiction(about, config.model.kind))
    return judge(evidence, gains, against, _may_have_supports(config)).record(), evidence


def _list_probes(config: Config) -> tuple[Probe, ...]:
    """The probes that x and y were made of; none where the channels are the probes."""
    return tuple(
        Probe(name, *name_channel(probe.node, probe.angle)) for name, probe in config.machine.recordings.probes.items()
    )


def _mark_fitted(config: Config, measurement: Measurement) -> np.ndarray:
    """(S, P, R) mask of the readings that the fit had."""
    data, training = measurement.dataset, config.training
    keep = ~held_out_points(data.speeds, data.operating, training)
    fitted = np.broadcast_to(keep[:, None, None], data.displacement.shape).copy()
    if loss_of(config.loss).weighs_noise:
        fitted[..., held_out_runs(measurement, training)] = False
    return fitted & data.present[:, None]
