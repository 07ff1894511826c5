"""The choice between laws, corrected laws and networks: by what they predict elsewhere."""

from __future__ import annotations

import numpy as np
import pytest
from oil_rig import LUND, SHORT, bearings_at, laws_of, measure, setup

from pipeline.errors import ConfigError
from pipeline.identification.choice import Judged, choose, judge_models, setup_model


def judged(name: str, probability: float, held_out: float) -> Judged:
    return Judged(name, probability, 1.0, 5.0, 100.0, {"45 degC": held_out, "65 degC": held_out})


def test_a_tie_goes_to_the_simpler_model_and_a_rejected_one_is_none() -> None:
    law, hybrid, network = judged("law", 0.3, 1.05), judged("hybrid", 0.5, 1.0), judged("network", 0.6, 9.0)
    assert choose((law, hybrid, network)).name == "law"
    assert choose((judged("law", 1e-9, 1.0), hybrid, network)).name == "hybrid"
    assert choose((judged("law", 0.3, 2.0), hybrid, network)).name == "hybrid"
    assert choose((judged("law", 1e-9, 4.0), judged("network", 1e-3, 3.0))).name == "network"


@pytest.mark.slow
def test_the_data_choose_their_law_and_refuse_another() -> None:
    truth = bearings_at(np.linspace(600.0, 4000.0, 6), (45.0, 65.0))
    said: list[str] = []
    found = judge_models(measure(truth, laws_of(LUND, (1, 1, 1.5, 0.7))), {"law": setup("law")}, said.append)
    assert choose(found).predicts == pytest.approx(1.0, abs=0.3)
    assert said == ["law", "law without 45 degC", "law without 65 degC"]
    setups = {kind: setup_model(setup("law"), kind) for kind in ("law", "hybrid")}
    wrong = judge_models(measure(truth, laws_of(SHORT, (1, 1, 1.5, 0.7))), setups, said.append)
    assert wrong[0].rejected
    assert choose(wrong).name == "hybrid"


@pytest.mark.slow
def test_one_state_is_no_choice() -> None:
    truth = bearings_at(np.linspace(600.0, 4000.0, 3), (45.0,))
    with pytest.raises(ConfigError, match="1 state"):
        judge_models(measure(truth, laws_of(LUND, (1, 1, 1, 1))), {"law": setup("law")}, print)
