"""stage=ingest of the measured rig's records: its files, its words, and what the guess is for."""

from __future__ import annotations

from pathlib import Path

import pytest
from conftest import Artifacts, assert_says
from running import composed, names_in, strict_json

from pipeline.config.schema import Config
from pipeline.data.coefficient_files import read_coefficients
from pipeline.errors import PipelineError
from pipeline.identification.output_error_fit import fit_output_error
from pipeline.identification.training import setup_of
from pipeline.stages import run_stage
from pipeline.stages.measurement import load_dataset, load_measurement

pytestmark = pytest.mark.slow


def config_of(folder: Path, *overrides: str) -> Config:
    return composed("experiment=rk4", "tracking=none", f"output={folder}", *overrides)


def test_the_files_and_the_words(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    run_stage(config_of(tmp_path, "stage=ingest"))
    assert_says(capsys.readouterr().out, "204 records of 68 conditions at 2 speeds, 4 probes", "angle a phase lag")
    summary = strict_json(tmp_path / "ingest.json")
    assert (summary["records"], summary["conditions"], summary["nodes"]) == (204, 68, [6, 22])
    assert "modelled_coefficients.csv" not in names_in(tmp_path)
    assert (tmp_path / "figures" / "ingest_records.png").stat().st_size > 10_000
    dataset = load_dataset(config_of(tmp_path))
    assert len(set(dataset.conditions or ())) == 68
    assert abs(dataset.frequencies / dataset.speeds[:, None] - 1).max() < 0.01
    cross = {node: ("kxy", "kyx", "cxy", "cyx") for node in (2, 26)}
    assert not read_coefficients(tmp_path / "known_coefficients.csv", (2, 26), dataset.speeds, cross).values.any()


def test_weights_on_a_node_that_the_rotor_lacks(tmp_path: Path) -> None:
    config = config_of(tmp_path, "stage=ingest", "machine.recordings.weights.0.node=99")
    with pytest.raises(PipelineError, match=r"machine\.recordings\.weights"):
        run_stage(config)


NEEDED = (
    *("vibration.parquet", "excitation.csv", "known_coefficients.csv", "training.json", "history.csv"),
    *("model.json", "model.safetensors", "uncertainty.safetensors"),
)


@pytest.mark.parametrize("guess", ["1e4 N/m", pytest.param("1e8 N/m", marks=pytest.mark.nightly)])
def test_the_guess_only_starts_the_fit(artifacts: Artifacts, tmp_path: Path, guess: str) -> None:
    """Two orders to either side of the configured one the same minimum, in which the rotor was solved."""
    config = config_of(artifacts.copied("rk4", NEEDED[:3], tmp_path), f"model.initial_stiffness={guess}")
    fit = fit_output_error(load_measurement(config), setup_of(config))
    solved = fit.problem.update(fit.weights)
    assert float(solved.loss(fit.weights)) == pytest.approx(0.4305217, rel=1e-6)
    stiffness = solved.unknowns(fit.weights)[0][0, 0, [0, 1, 4, 5]].numpy()
    assert stiffness == pytest.approx([7.05e5, 3.26e6, 2.23e5, 3.68e5], rel=0.03)
