"""stage=ingest on files at random: a right reading or a sentence of ours, never a traceback, never a silent error."""

from __future__ import annotations

import tempfile
from collections.abc import Callable
from functools import cache, partial
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
    RPM_OF,
    TO_PEAK,
    Vectors,
    long,
    probes_config,
    rotating,
    table_config,
    tacho_of,
    uff_set,
    vectors_of,
    wide,
    write_hdf5,
    write_tdms,
    write_uff,
)
from reading import RPM, RUNS, parsed
from test_motion import PAIR

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


def _vectors() -> Vectors:
    return Vectors(GRID, {name: 1e-5 * np.exp(1j * (i + GRID / 700)) for i, name in enumerate("ABCD")})


def _signals() -> dict[str, np.ndarray]:
    phi = 2 * np.pi * 17.3 * np.arange(4000) / 4000.0 + 0.2
    return {name: rotating(1e-5 * np.exp(1j * i), phi) for i, name in enumerate("ABCD")} | {"tacho": tacho_of(phi)}


def _waves(prefix: str) -> dict[str, Any]:
    return {
        "format": "waveform",
        "records": "constant_speed",
        "signal_unit": "m",
        "sample_rate": "4 kHz",
        "tacho": {"channel": f"{prefix}tacho", "edge": "rising"},
        "probes": probes_config(channel=lambda name: f"{prefix}{name}"),
        "shaft_angle": "from_x",
    }


def _uff(path: Path, binary: int) -> None:
    sets = [
        uff_set(GRID, vector * 1e6, 1, i + 1, [name], binary=binary, abscissa_spacing=1)
        for i, (name, vector) in enumerate(_vectors().of.items())
    ]
    write_uff(path, sets)


UFF = {
    "format": "uff58",
    "conventions": {"length": "um", "amplitude": "zero_to_peak", "phase": "lead", "speed": "rpm"},
    "probes": probes_config(record=lambda name: name),
    "shaft_angle": "from_x",
}
KINDS: dict[str, tuple[str, Callable[[Path], object], dict[str, Any]]] = {
    "table": ("csv", lambda path: wide(_vectors()).to_csv(path, index=False), table_config([])),
    "excel": ("xlsx", lambda path: wide(_vectors()).to_excel(path, index=False), table_config([])),
    "uff": ("uff", partial(_uff, binary=0), UFF),
    "binary uff": ("uff", partial(_uff, binary=1), UFF),
    "hdf5": ("h5", lambda path: write_hdf5(path, _signals()), _waves("")),
    "tdms": ("tdms", lambda path: write_tdms(path, _signals()), _waves("run/")),
    "signals csv": ("csv", lambda path: pd.DataFrame(_signals()).to_csv(path, index=False), _waves("")),
}
FEWER = {"signals csv", "excel", "hdf5", "tdms"}


@cache
def original(kind: str) -> tuple[bytes, np.ndarray]:
    """A good file, and what is read of it."""
    ending, write, _ = KINDS[kind]
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / f"good.{ending}"
        write(path)
        return path.read_bytes(), read(_section(kind, path)).dataset.displacement


def _section(kind: str, path: Path) -> dict[str, Any]:
    return KINDS[kind][2] | {"runs": [RUN | {"file": str(path)}]}


def read_bytes(kind: str, content: bytes) -> MeasuredRuns | None:
    """What is read of a file with these bytes; None where it is refused by name in a sentence."""
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / f"some.{KINDS[kind][0]}"
        path.write_bytes(content)
        return read_or_refused(_section(kind, path))


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
    content, true = original(kind)

    @given(share=st.floats(0, 1, exclude_max=True))
    @examples(12 if kind in FEWER else 40)
    def check(share: float) -> None:
        found = read_bytes(kind, content[: int(share * len(content))])
        if found is None:
            return
        left = found.dataset.displacement
        whole = slice(0, len(left) - 1) if any("cut off" in note for note in found.notes) else slice(None)
        if kind == "signals csv":
            assert found.notes or left == pytest.approx(true, rel=1e-3)  # a shorter record has the same vectors
        else:
            assert np.abs(left[whole] - true[: len(left)][whole]).max(initial=0.0) < 1e-12 * np.abs(true).max()

    check()


@pytest.mark.parametrize("kind", KINDS)
def test_a_file_with_other_bytes_in_it(kind: str) -> None:
    """No error but ours: what a changed digit means nobody can know. A head with anything behind it is refused."""
    content = original(kind)[0]

    @given(
        places=st.lists(st.tuples(st.floats(0, 1, exclude_max=True), st.integers(0, 255)), min_size=1, max_size=8),
        begins=st.integers(0, 80),
        tail=st.binary(max_size=300),
    )
    @examples(12 if kind in FEWER else 40)
    def check(places: list[tuple[float, int]], begins: int, tail: bytes) -> None:
        changed = bytearray(content)
        for share, byte in places:
            changed[int(share * len(changed))] = byte
        read_bytes(kind, bytes(changed))
        assert read_bytes(kind, content[:begins] + tail) is None

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
    dataset = found.dataset
    assert dataset.speeds == pytest.approx(np.sort(table.map(float)["speed"].to_numpy()) * RPM, rel=1e-9)
    assert np.isfinite(dataset.displacement).all()


@given(said=st.dictionaries(st.sampled_from([*CONVENTIONS, "other"]), st.one_of(st.none(), st.text(max_size=6))))
@examples(60)
def test_any_conventions(said: dict[str, Any]) -> None:
    """What is not the five conventions in full is refused by pydantic, in words that name a key of them."""
    from pydantic import ValidationError

    with pytest.raises(ValidationError) as caught:
        read(table_config([RUN | {"file": "a.csv"}], conventions=said))
    assert "conventions" in str(caught.value)
