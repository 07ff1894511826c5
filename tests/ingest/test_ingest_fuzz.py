"""stage=ingest on files at random: a right reading or a sentence of ours, never a traceback, never a silent error."""

from __future__ import annotations

import tempfile
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import pytest
from conftest import examples
from hypothesis import given
from hypothesis import strategies as st
from measured_files import (
    CONVENTIONS,
    METRE,
    PAIR,
    RPM_OF,
    TO_PEAK,
    Vectors,
    long,
    probes_config,
    rotating,
    table_config,
    tacho_of,
    vectors_of,
    wide,
)
from reading import RPM, RUNS, parsed

from pipeline.errors import ConfigError, DataError
from pipeline.ingest.dataset import MeasuredRuns, read_measured_runs

pytestmark = pytest.mark.slow

RUN = RUNS[0]


def read(section: dict[str, Any]) -> MeasuredRuns:
    """What a section ``ingest`` gives."""
    return read_measured_runs(parsed(section))


SAID = st.fixed_dictionaries(
    {
        "length": st.sampled_from(sorted(METRE)),
        "amplitude": st.sampled_from(sorted(TO_PEAK)),
        "phase": st.sampled_from(["lag", "lead"]),
        "phase_unit": st.sampled_from(["deg", "rad"]),
        "speed": st.sampled_from(sorted(RPM_OF)),
    }
)
ANGLES = st.floats(-720, 720)


@st.composite
def measured(draw: st.DrawFn) -> tuple[np.ndarray, np.ndarray, dict[str, tuple[int, float]]]:
    """Speeds (S,), displacements (S, 2) and two or three probes at any angle that spans the plane."""
    generator = np.random.default_rng(draw(st.integers(0, 2**32)))
    count = draw(st.integers(1, 12))
    rpm = np.cumsum(generator.uniform(1, 500, count)) + draw(st.floats(1, 3000))
    size = 10.0 ** draw(st.floats(-9, -4))
    displacement = size * (generator.standard_normal((count, 2)) + 1j * generator.standard_normal((count, 2)))
    first = draw(ANGLES)
    probes = {"A": (0, first), "B": (0, first + draw(st.floats(20, 160)))}
    if draw(st.booleans()):
        probes["C"] = (0, draw(ANGLES))
    return rpm, displacement, probes


@given(data=measured(), said=SAID, layout=st.sampled_from(["wide", "long"]), shuffle=st.integers(0, 99))
@examples(60)
def test_a_table_in_any_convention_is_read_back(
    data: tuple[np.ndarray, np.ndarray, dict[str, tuple[int, float]]], said: dict[str, str], layout: str, shuffle: int
) -> None:
    """Whatever the units, senses, layout, order of rows and angles of the probes: x and y within 1e-9."""
    rpm, displacement, probes = data
    vectors = vectors_of(rpm, lambda _: displacement[:, 0], lambda _: displacement[:, 1], probes)
    table = wide(vectors, said) if layout == "wide" else long({"one": vectors}, said)
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "one.csv"
        table.sample(frac=1, random_state=shuffle).to_csv(path, index=False)
        dataset = read(
            table_config(
                [RUN | {"file": str(path)}],
                layout,
                conventions=said,
                probes=probes_config(probes, **(PAIR if layout == "wide" else {})),
            )
        ).dataset
    assert dataset.speeds == pytest.approx(rpm * RPM, rel=1e-9)
    assert np.abs(dataset.displacement[:, :, 0] - displacement).max() < 1e-9 * np.abs(displacement).max()


GRID = np.arange(500.0, 1501.0, 100.0)


def _signals() -> pd.DataFrame:
    phi = 2 * np.pi * 17.3 * np.arange(4000) / 4000.0 + 0.2
    signals = {name: rotating(1e-5 * np.exp(1j * i), phi) for i, name in enumerate("ABCD")}
    return pd.DataFrame(signals | {"tacho": tacho_of(phi)})


WAVES = {
    "format": "waveform",
    "records": "constant_speed",
    "signal_unit": "m",
    "sample_rate": "4 kHz",
    "tacho": {"channel": "tacho", "edge": "rising"},
    "probes": probes_config(channel=lambda name: name),
    "shaft_angle": "from_x",
}
VECTORS = Vectors(GRID, {name: 1e-5 * np.exp(1j * (i + GRID / 700)) for i, name in enumerate("ABCD")})
KINDS = {"table": (wide(VECTORS), table_config([])), "signals": (_signals(), WAVES)}
"""A file of texts and its section: one that is cut may still be whole. Others: test_hostile_files.py."""


def read_cut(kind: str, share: float) -> MeasuredRuns | None:
    """What is read of so much of a file; None where it is refused by name in a sentence."""
    table, section = KINDS[kind]
    content = table.to_csv(index=False).encode()
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "some.csv"
        path.write_bytes(content[: int(share * len(content))])
        return read_or_refused(section | {"runs": [RUN | {"file": str(path)}]})


def read_or_refused(section: dict[str, Any]) -> MeasuredRuns | None:
    """What is read; None where it is refused in a sentence."""
    try:
        found, said = read(section), "it must"
    except (DataError, ConfigError) as error:
        found, said = None, str(error)
    assert "must" in said
    assert len(said) < 1200
    return found


@pytest.mark.parametrize("kind", KINDS)
def test_a_file_that_was_cut(kind: str) -> None:
    """Refused; or what is left is right, and where the last number may have lost digits that is said."""
    whole_file = read_cut(kind, 1.0)
    assert whole_file
    true = whole_file.dataset.displacement

    @given(share=st.floats(0, 1, exclude_max=True))
    @examples(12 if kind == "signals" else 40)
    def check(share: float) -> None:
        found = read_cut(kind, share)
        if found is None:
            return
        left = found.dataset.displacement
        whole = slice(0, len(left) - 1) if any("cut off" in note for note in found.notes) else slice(None)
        if kind == "signals":
            assert found.notes or left == pytest.approx(true, rel=1e-3)  # a shorter record has the same vectors
        else:
            assert np.abs(left[whole] - true[: len(left)][whole]).max(initial=0.0) < 1e-12 * np.abs(true).max()

    check()


CELLS = st.one_of(
    st.floats(),
    st.integers(-(10**20), 10**20),
    st.sampled_from(
        ["", "NaN", "inf", "1e400", "-1e308", "1,5", "0x10", "1_0", "True", "2026-01-01", "µ", '"', "\x00"]
    ),
    st.text(max_size=5),
)


@given(
    rows=st.lists(st.lists(CELLS, min_size=9, max_size=9), min_size=0, max_size=6),
    header=st.permutations(["speed", *(f"{name} {what}" for name in "ABCD" for what in ("amp", "ph"))]),
)
@examples(40)
def test_any_table(rows: list[list[Any]], header: list[str]) -> None:
    table = pd.DataFrame(rows, columns=header, dtype=object)
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "some.csv"
        try:
            table.to_csv(path, index=False)
        except (UnicodeEncodeError, ValueError):  # a surrogate or a zero byte that pandas does not write
            return
        found = read_or_refused(table_config([RUN | {"file": str(path)}]))
    if found is None:
        return
    assert found.dataset.speeds == pytest.approx(np.sort(table.map(float)["speed"].to_numpy()) * RPM, rel=1e-9)
    assert np.isfinite(found.dataset.displacement).all()


@given(said=st.dictionaries(st.sampled_from([*CONVENTIONS, "other"]), st.one_of(st.none(), st.text(max_size=6))))
@examples(60)
def test_any_conventions(said: dict[str, Any]) -> None:
    """What is not the five conventions in full is refused by pydantic, in words that name a key of them."""
    from pydantic import ValidationError

    with pytest.raises(ValidationError) as caught:
        read(table_config([RUN | {"file": "a.csv"}], conventions=said))
    assert "conventions" in str(caught.value)
