"""Composing a configuration: which override wins, what is kept, and that any override composes or is refused."""

from __future__ import annotations

import contextlib
from pathlib import Path

import pytest
from conftest import examples
from hypothesis import given
from hypothesis import strategies as st

from pipeline.config.compose import compose_config, compose_mapping
from pipeline.errors import ConfigError


def test_overrides_win_over_the_experiment_and_the_last_of_two_wins() -> None:
    config = compose_config(["seed=1", "experiment=nothing", "experiment=ball_bearing", "seed=2"])
    assert (config.seed, config.name) == (2, "ball_bearing")


@pytest.mark.parametrize(
    ("override", "folder"),
    [
        ("output=my folder/x", "my folder/x"),
        ("output='my (folder), x'", "my (folder), x"),
        ('output="a/${name}"', "a/hydrostatic_stiffness"),
        ('output="/tmp/ü/x"', "/tmp/ü/x"),
    ],
)
def test_paths_with_spaces_and_quotes(override: str, folder: str) -> None:
    assert compose_config([override]).output == folder


def test_composing_leaves_hydra_as_it_was(monkeypatch: pytest.MonkeyPatch) -> None:
    from hydra.core.global_hydra import GlobalHydra
    from hydra.core.hydra_config import HydraConfig
    from hydra.version import VersionBase
    from packaging.version import Version

    configured = HydraConfig.initialized()
    monkeypatch.setattr(VersionBase.instance(), "version_base", Version("1.2"))
    with pytest.raises(ConfigError):
        compose_mapping(["nothing=3"])
    assert not GlobalHydra.instance().is_initialized()
    assert (HydraConfig.initialized(), VersionBase.instance().getbase()) == (configured, Version("1.2"))


@pytest.mark.slow
@pytest.mark.parametrize("experiment", ["measured_demo", "oil_temperatures", "realistic"])
def test_what_groups_compose_to_is_kept_and_no_value_of_a_command(
    experiment: str, monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    """The same from the files of conf/ and from what was kept of them; with an override of Hydra's own part, too."""
    monkeypatch.setattr("pipeline.files.CACHE", tmp_path)
    given = [f"experiment={experiment}", "+machine.note=secret", "~report", "optimizer.adam.steps=3"]
    composed = []
    for more in ([], [], ["hydra.verbose=false"]):
        monkeypatch.setattr("pipeline.config.loader._COMPOSED", {})
        composed.append(compose_mapping([*given, *more]))
    assert composed == composed[:1] * 3
    (kept,) = (tmp_path / "configurations").iterdir()
    assert "secret" not in kept.read_text()


@pytest.mark.slow
@examples(12)
@given(
    key=st.sampled_from(
        ["seed", "+seed", "~seed", "machine", "model.kind", "stage", "experiment", "machine.rotor.shaft.0", ""]
    ),
    value=st.sampled_from(["", "null", "[]", "[1]", "{a: 1}", "${machine}", "${"]) | st.text(max_size=8),
)
def test_any_override_composes_or_is_refused_with_a_sentence(key: str, value: str) -> None:
    with contextlib.suppress(ConfigError):
        compose_config([f"{key}={value}"])
