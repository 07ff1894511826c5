"""How cost grows with nodes, speeds, runs, probes and data sets, and how fast files are read.

The exponent of a growth is 1 where twice as much costs twice as much.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Collection
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import TYPE_CHECKING

from benchmarks.machines import machine, refined
from benchmarks.measure import BENCHMARKS, Action, Aim, Times, in_turns

if TYPE_CHECKING:
    from pipeline.data.dataset import VibrationDataset

_EXPERIMENT = "noisy_direct"


@dataclass(frozen=True)
class Growth(Times):
    """Times of ``scale`` times as much beside those of once as much."""

    @property
    def ratios(self) -> list[float]:
        """The exponents."""
        return [math.log(much / less) / math.log(self.scale) for much, less in zip(self.ours, self.peer, strict=True)]


def _nodes(times: float) -> Action:
    made = refined(_EXPERIMENT, round(4 * times))
    data = _show(made.dataset, made.rotor.bearing_nodes)
    return lambda: made.measured(data, made.config).response


def _speeds(times: float) -> Action:
    return _fit(lambda data: data, f"machine.speeds.step_rpm={40 / times:g}")


def fit_of_runs(times: float, nodes: Collection[int] = range(7)) -> Action:
    """A fit of four ``times`` as many repeats of three runs, by the probes at some ``nodes``."""

    def repeat(data: VibrationDataset) -> VibrationDataset:
        import numpy as np

        count = round(4 * times)
        names = [f"{run} {i}" for i in range(count) for run in data.runs]
        acting = [replace(e, run=f"{e.run} {i}") for i in range(count) for e in data.excitations]
        every = np.concatenate([data.displacement] * count, axis=2)
        many = replace(
            data,
            runs=tuple(names),
            displacement=every,
            excitations=tuple(acting),
            present=np.ones((1, len(names)), bool),
        )
        return _show(many, nodes)

    return _fit(repeat, "machine.speeds.step_rpm=100")


def _probes(times: float) -> Action:
    """Those at the bearings, or at all nodes."""
    return _fit(lambda data: data if times > 1 else _show(data, (1, 5)))


def _show(data: VibrationDataset, nodes: Collection[int]) -> VibrationDataset:
    """Only the probes at some ``nodes``."""
    shown = [p for p, (node, _) in enumerate(data.channels) if node in nodes]
    return replace(data, channels=tuple(data.channels[p] for p in shown), displacement=data.displacement[:, shown])


def _data_sets(times: float) -> Action:
    from pipeline.stages.robustness import measure_again

    config = machine(f"experiment={_EXPERIMENT}").config
    return lambda: [measure_again(config, seed) for seed in range(round(2 * times))]


def _fit(change: Callable[[VibrationDataset], VibrationDataset], *overrides: str) -> Action:
    """A fit from the data to the bands."""
    from pipeline.identification.answer import conclude
    from pipeline.identification.output_error_fit import fit_output_error
    from pipeline.identification.training import setup_of

    made = machine(f"experiment={_EXPERIMENT}", *overrides)
    data = change(add_noise(made.dataset))
    return lambda: conclude(fit_output_error(made.measured(data, made.config), setup_of(made.config)))


def add_noise(data: VibrationDataset, share: float = 0.01) -> VibrationDataset:
    """Readings with circular noise of a ``share`` of each."""
    import numpy as np

    parts = np.random.default_rng(0).standard_normal((2, *data.displacement.shape)) / np.sqrt(2)
    return replace(data, displacement=data.displacement * (1 + share * (parts[0] + 1j * parts[1])))


def _grow(make: Callable[[float], Action], times: float) -> Times:
    much, less = make(times), make(1)
    less()
    measured = in_turns(much, less, turns=3)
    return Growth(measured.ours, measured.peer, times)


for _what, _make, _times, _said in (
    (
        "nodes",
        _nodes,
        4,
        "the response of a rotor of 97 nodes",
    ),
    ("speeds", _speeds, 4, "a fit at 591 speeds"),
    ("runs", fit_of_runs, 4, "a fit of 48 runs at 60 speeds"),
    ("probes", _probes, 3.5, "a fit with probes at 7 nodes"),
    ("data_sets", _data_sets, 3, "6 data sets measured and fitted"),
):
    BENCHMARKS.add(f"exponent_of_{_what}", _said, f"{_times} times fewer; the ratio is the exponent", Aim(1.1))(
        partial(_grow, _make, _times)
    )


@BENCHMARKS.add("csv", "a table of 1,000,000 rows of 3 numbers", "pandas.read_csv", Aim(3))
def csv() -> Times:
    """Every number is checked, and a mistake explained."""
    import numpy as np
    import pandas as pd

    from pipeline.data.tables import read_table

    with TemporaryDirectory() as folder:
        path = Path(folder) / "x.csv"
        np.savetxt(path, np.random.default_rng(0).random((1_000_000, 3)), "%.9f", ",", header="t,x,y", comments="")
        return in_turns(lambda: read_table(path, dict.fromkeys("txy", "number")), lambda: pd.read_csv(path), turns=3)


@BENCHMARKS.add("uff", "a binary universal file of 8 records of 250,000 samples", "pyuff's read_sets", Aim(1.5))
def uff() -> Times:
    """Ours reads by pyuff, and looks for every mark of a cut file."""
    import numpy as np
    import pyuff

    from pipeline.ingest.uff import read_uff

    record = pyuff.prepare_58(
        binary=1,
        func_type=1,
        rsp_node=1,
        rsp_dir=1,
        ref_node=1,
        ref_dir=1,
        data=np.random.default_rng(0).random(250_000),
        x=np.arange(250_000.0),
        abscissa_spacing=1,
        orddenom_spec_data_type=0,
    )
    with TemporaryDirectory() as folder:
        path = Path(folder) / "x.uff"
        pyuff.UFF(str(path)).write_sets([record] * 8, mode="add")
        return in_turns(lambda: read_uff(path), lambda: pyuff.UFF(str(path)).read_sets(), turns=3)
