"""What a file of recordings says of itself, and what is left to a person."""

from __future__ import annotations

from pathlib import Path

import pandas as pd
import pytest
from conftest import refused

from pipeline.ingest.recognition import recognize_recordings


@pytest.mark.slow
def test_what_a_file_does_not_say_is_left_to_a_person(tmp_path: Path) -> None:
    """A convention that no word tells has no value; columns must belong together."""
    columns = {"n [1/min]": [600.0, 700.0], "A Amp": [1.0, 2.0], "A Phase": [3.0, 4.0], "note": [0, 0]}
    pd.DataFrame(columns).to_csv(tmp_path / "a.csv", index=False)
    kind, guesses = recognize_recordings(tmp_path / "a.csv", tmp_path)
    said = {key: guesses[key] for key in ("length", "amplitude", "phase", "phase_unit", "speed", "speeds", "baseline")}
    assert (kind, said) == (
        "tables",
        dict.fromkeys(("length", "amplitude", "phase", "phase_unit"), "???")
        | {"speed": "rpm", "speeds": "{start_rpm: 600, stop_rpm: 700, step_rpm: 100}", "baseline": '"???"'},
    )
    assert '"A": {node: 1, angle: 45 deg, columns: {amplitude: "A Amp", phase: "A Phase"}}' in guesses["probes"]
    assert "note" not in guesses["probes"]
    pd.DataFrame({"speed": [1.0], "A Phase": [2.0]}).to_csv(tmp_path / "c.csv", index=False)
    with refused("must have an amplitude and a phase of each probe", "speed, A Phase"):
        recognize_recordings(tmp_path / "c.csv", tmp_path)
