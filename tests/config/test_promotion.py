"""Promoted values: where they are in force and said to be, what wins over them, and files that are refused."""

from __future__ import annotations

from pathlib import Path

import pytest
import yaml
from conftest import assert_says
from tuning.test_space import NO_STUDY

from pipeline.config.compose import compose_config
from pipeline.errors import ConfigError, DataError


@pytest.fixture
def study(tmp_path: Path) -> Path:
    """A folder in which a study promoted three values."""
    folder = tmp_path / "a study"
    folder.mkdir()
    values = {"model.width": 17, "model.activation": "silu", "training.tolerance": 0.03}
    best = {"study": "x", "trial": 5, "values": values, "held_out_loss": {"configured": 0.07, "promoted": 1.4e-7}}
    (folder / "best.yaml").write_text(yaml.safe_dump(best))
    return folder


@pytest.mark.slow
def test_promoted_values_are_in_force_where_training_is(study: Path) -> None:
    """train, what reads its answer, and the written configuration use them; a study itself does not."""
    for stage in ("configure", "generate", "train", "evaluate", "robustness", "predict"):
        config = compose_config([f"stage={stage}", f"tuning.promoted={study}"])
        assert (config.model.width, config.model.activation, config.training.tolerance) == (17, "silu", 0.03)
        assert (config.promoted.trial, len(config.promoted.in_force)) == (5, 3)
    config = compose_config(["stage=tune", f"tuning.promoted={study}"])
    assert (config.model.width, config.promoted) == (48, None)


@pytest.mark.slow
@pytest.mark.parametrize(
    ("override", "overridden"),
    [
        ("model.width=24", ["model.width"]),
        ("model=network_32", ["model.width", "model.activation"]),
        ("training.tolerance=0.5", ["training.tolerance"]),
        ("++model.activation=sine", ["model.activation"]),
        ("model.depth=2", []),
        ("seed=3", []),
    ],
)
def test_the_command_line_wins_over_promoted_values(study: Path, override: str, overridden: list[str]) -> None:
    """A value, or the group that it is in, given explicitly is in force; the other promoted values stay."""
    config = compose_config([f"tuning.promoted={study}", override])
    plain = compose_config([NO_STUDY, override])
    assert set(config.promoted.overridden) == set(overridden)
    for key in overridden:
        section, field = key.split(".")
        assert getattr(getattr(config, section), field) == getattr(getattr(plain, section), field)
    assert len(config.promoted.in_force) == 3 - len(overridden)


@pytest.mark.slow
@pytest.mark.parametrize(
    "text",
    [
        "",
        "{",
        "[]",
        "study: x",
        "study: x\ntrial: 1\nvalues: {machine.rotor.file: x}",
        "study: x\ntrial: -1\nvalues: {}",
        "\x00",
    ],
)
def test_a_damaged_best_file_is_a_sentence(study: Path, text: str) -> None:
    (study / "best.yaml").write_text(text)
    with pytest.raises(DataError, match=r"best\.yaml' must hold .*tuned=false"):
        compose_config([f"tuning.promoted={study}"])


@pytest.mark.slow
def test_promoted_values_of_another_kind_of_model_are_refused(study: Path) -> None:
    """A network's width does not fit a constant that a configuration file chose; the command line alone drops it."""
    with pytest.raises(ConfigError, match=r"tuned=false.*model\.\w+' is not one of ball_bearing"):
        compose_config(["experiment=ball_bearing", f"tuning.promoted={study}"])
    assert compose_config(["model=constant", f"tuning.promoted={study}"]).model.kind == "constant"


@pytest.mark.slow
def test_the_console_says_which_values_are_in_force(study: Path, capsys: pytest.CaptureFixture[str]) -> None:
    from pipeline.stages.before_fit import say_promoted

    say_promoted(compose_config([f"tuning.promoted={study}", "model.width=24"]))
    assert_says(
        capsys.readouterr().out,
        "study 'x' (trial 5) in force: model.activation tanh -> silu, training.tolerance 0.1 -> 0.03",
        "their loss is 1.4e-7, that of the configured values (tuned=false) 0.07",
        "given on the command line instead of tuned: model.width=24",
    )
