"""Machines that are not built as modelled, through the stages: refusals, refits, and what only the generator knows."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from pipeline.config.compose import compose_config
from pipeline.errors import ConfigError
from pipeline.rotor.stored import load_rotor
from pipeline.stages import refit_study
from pipeline.stages.generate import model_machine, read_probes
from pipeline.stages.measurement import build_measurement

SMALL = [
    "experiment=realistic",
    "machine.speeds={start_rpm: 600, stop_rpm: 5400, step_rpm: 480}",
    "identify.unknowns=[kxx,kyy]",
    "model.width=4",
]


@pytest.mark.parametrize(
    ("overrides", "words"),
    [
        (["identify.model_parameters.youngs_modulus=0"], "youngs_modulus: must be greater than 0"),
        (["identify.model_parameters.density=1.5"], "density: must be less than 1"),
        (["identify.model_parameters.unbalance_phase=2 mm"], "must convert to rad"),
        (["loss=residual"], "identify.model_parameters must come with loss=response"),
        (["identify.model_parameters.stiffness=0.1"], "has no 'stiffness'"),
        (["machine.bearings.nodess=3"], "did you mean 'nodes'"),
    ],
)
def test_a_wrong_tolerance_is_refused(overrides: list[str], words: str) -> None:
    """The key, what came, and no traceback; also where nodes are keys of the same machine."""
    with pytest.raises(ConfigError) as refused:
        compose_config(["stage=train", *SMALL, *overrides])
    assert words in str(refused.value)


@pytest.mark.parametrize(
    ("overrides", "words"),
    [
        (["identify.coupling_node=6"], "identify.coupling_node must be a node without a bearing"),
        (["identify.coupling_node=99"], "identify.coupling_node must be one of the nodes 0 to 8"),
        (["machine.rotor.discs=[]"], "identify.model_parameters.disc_mass must belong to something"),
    ],
)
def test_a_parameter_of_nothing_is_refused(overrides: list[str], words: str) -> None:
    """What the machine does not have can't be uncertain."""
    config = compose_config(["stage=train", *SMALL, *overrides])
    rotor, truth, complete = model_machine(config)
    with pytest.raises(ConfigError, match=words):
        build_measurement(config, rotor, read_probes(config, rotor, complete), truth)


def test_what_was_built_is_not_what_is_assumed() -> None:
    """The measurement has the stated rotor and weights; the readings are those of another machine."""
    config = compose_config(["stage=train", *SMALL])
    stated = compose_config(["stage=train", *SMALL, "machine=overhung"])
    readings = []
    for one in (config, stated):
        rotor, truth, complete = model_machine(one)
        measurement = build_measurement(one, rotor, read_probes(one, rotor, complete), truth)
        assert measurement.rotor.fingerprint == load_rotor(stated.machine.rotor).fingerprint
        assert measurement.dataset.excitations == replace(complete).excitations
        readings.append(measurement.dataset.displacement)
    assert np.abs(readings[0] / readings[1] - 1).max() > 0.05


def test_a_finer_mesh_of_the_same_shaft_is_nearly_the_same_machine() -> None:
    """Readings of three elements for one agree to the error of the mesh, and not to the last digit."""
    config = compose_config(["stage=train", *SMALL, "machine=overhung", "+machine.as_built={refinement: 3}"])
    stated = compose_config(["stage=train", *SMALL, "machine=overhung"])
    fine, coarse = (model_machine(one)[2] for one in (config, stated))
    assert fine.channels == coarse.channels
    off = np.abs(fine.displacement - coarse.displacement).max() / np.abs(coarse.displacement).max()
    assert 1e-9 < off < 0.01


@pytest.mark.slow
def test_refits_are_the_same_in_one_process_and_in_two() -> None:
    """Every data set is its seed's; so are its errors."""
    config = compose_config(["stage=robustness", *SMALL, "robustness.count=2", "robustness.workers=2"])
    together = list(refit_study._refit_all(config))
    alone = [refit_study.refit(config, seed) for seed in (0, 1)]
    for one, other in zip(together, alone, strict=True):
        assert one.names == other.names == ((1, "kxx"), (1, "kyy"), (6, "kxx"), (6, "kyy"))
        assert one.error == pytest.approx(other.error, rel=1e-6)
        assert one.probability is not None
    assert not np.allclose(alone[0].error, alone[1].error, rtol=1e-3)
    summary = refit_study._summarize(alone)
    assert summary["data_sets"] == 2
    assert summary["within_95_percent_interval"] == pytest.approx(np.mean([of.within for of in alone]))


def test_refits_need_a_modelled_machine() -> None:
    """Recordings can't be made again."""
    config = compose_config(["stage=robustness", "experiment=measured_demo", "robustness=refits"])
    with pytest.raises(ConfigError, match="robustness over refits must have loss=response and a modelled machine"):
        refit_study.run(config)


@pytest.mark.slow
@pytest.mark.parametrize("seed", [23, 67])
def test_far_from_the_stated_model_the_fit_reaches_its_minimum(seed: int) -> None:
    """Data sets whose fit ended in another valley when the readings counted in full from the start."""
    found = refit_study.refit(compose_config(["stage=robustness", "experiment=realistic"]), seed)
    assert found.misfit < 1.1
    assert found.probability is not None
    assert found.probability > 0.01
