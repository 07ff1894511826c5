"""stage=robustness: refits in one process and in two, on pedestals, and far from the stated model."""

from __future__ import annotations

import numpy as np
import pytest
from parameters.test_as_built import SMALL

from pipeline.config.compose import compose_config
from pipeline.config.schema import Config
from pipeline.data.dataset import VibrationDataset
from pipeline.errors import ConfigError
from pipeline.evaluation.repeats import summarize_refits
from pipeline.parameters.as_built import stand_on_pedestals
from pipeline.problem.configured import model_machine
from pipeline.rotor.bearing_table import BearingTable
from pipeline.rotor.model import RotorModel
from pipeline.stages import robustness
from pipeline.stages.analysis import Analysis


@pytest.mark.slow
def test_refits_are_the_same_in_one_process_and_in_two() -> None:
    """Every data set is its seed's; so are its errors."""
    config = compose_config(["stage=robustness", *SMALL, "robustness.count=2", "robustness.workers=2"])
    alone = [robustness.measure_again(config, seed) for seed in (0, 1)]
    for one, other in zip(robustness.refit_all(config), alone, strict=True):
        assert one.names == other.names == ((1, "kxx"), (1, "kyy"), (6, "kxx"), (6, "kyy"))
        assert one.error == pytest.approx(other.error, rel=1e-6)
        assert one.probability is not None
    assert not np.allclose(alone[0].error, alone[1].error, rtol=1e-3)
    summary = summarize_refits(alone)
    assert summary["data_sets"] == 2
    assert summary["within_95_percent_interval"] == pytest.approx(np.mean([of.within for of in alone]))


@pytest.mark.slow
def test_refits_need_a_modelled_machine() -> None:
    """Recordings can't be made again."""
    config = compose_config(["stage=robustness", "experiment=measured_demo", "robustness=refits"])
    with pytest.raises(ConfigError, match="robustness over refits must have loss=response and a modelled machine"):
        robustness.run(Analysis(config))


@pytest.mark.slow
def test_on_pedestals_the_series_of_film_and_pedestal_is_found(monkeypatch: pytest.MonkeyPatch) -> None:
    """No test tells of a pedestal: the readings are explained, by bearings that are softer than the film."""
    pedestal = "+machine.as_built={pedestal_stiffness: 2e8 N/m, pedestal_mass: 20 kg}"
    stated = ["experiment=realistic", "machine=overhung", "~identify.model_parameters"]
    config = compose_config(["stage=robustness", *stated, pedestal])
    film = robustness.measure_again(config, 0)

    def felt(one: Config, seed: int) -> tuple[RotorModel, BearingTable, VibrationDataset]:
        rotor, truth, complete = model_machine(one, seed)
        return rotor, stand_on_pedestals(truth, one.machine.as_built), complete

    monkeypatch.setattr(robustness, "model_machine", felt)
    series = robustness.measure_again(config, 0)
    assert np.median(film.error) > 10
    assert np.median(series.error) < 1.5
    assert series.within.mean() > 75
    assert film.probability > 0.05


@pytest.mark.slow
@pytest.mark.parametrize("seed", [23, 67])
def test_far_from_the_stated_model_the_fit_reaches_its_minimum(seed: int) -> None:
    """Data sets whose fit ended in another valley when the readings counted in full from the start."""
    found = robustness.measure_again(compose_config(["stage=robustness", "experiment=realistic"]), seed)
    assert found.misfit < 1.1
    assert found.probability > 0.01
