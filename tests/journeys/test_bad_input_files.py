"""Bad data files, full disks, read-only folders: a sentence of ours (exit code 2), nothing half-written."""

from __future__ import annotations

import errno
import json
import os
import resource
import shutil
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager, suppress
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import pytest
from conftest import examples, known_names, refused, with_machine
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from pipeline.__main__ import main
from pipeline.config.compose import compose_config
from pipeline.config.schema import Config, DataConfig
from pipeline.data.coefficient_files import read_coefficients
from pipeline.data.dataset import VibrationDataset
from pipeline.data.tables import read_marks, write_table
from pipeline.data.vibration_files import read_dataset
from pipeline.errors import ConfigError, DataError, IdentifiabilityError, PipelineError, StorageError
from pipeline.evaluation.thresholds import read_rules
from pipeline.files import read_json, write_beside, write_json
from pipeline.identification.storage import load_model, save_model
from pipeline.reporting.figures import open_figure
from pipeline.rotor.bearing_table import BearingTable
from pipeline.rotor.ross_adapter import assemble
from pipeline.stages import run_stage
from pipeline.stages.measurement import load_identified, load_measurement

SMALL = [
    "experiment=ball_bearing",
    "tracking=none",
    *(f"machine.speeds.{key}" for key in ("start_rpm=500", "stop_rpm=5500", "step_rpm=500")),
    "machine.runs=[{name: one, unbalances: [{node: 1, magnitude: 1e-4}]},"
    "{name: two, unbalances: [{node: 0, magnitude: 2e-4, phase: 1}]}]",
    "optimizer.adam.steps=3",
    "optimizer.levenberg_marquardt.steps=20",
    "robustness.count=3",
]
EIGHT = ["kxx", "kxy", "kyx", "kyy", "cxx", "cxy", "cyx", "cyy"]
SPEEDS = np.arange(500.0, 5501.0, 500.0)
Change = Callable[[pd.DataFrame], pd.DataFrame]


@pytest.fixture(scope="session")
def base() -> Config:
    """Two ball bearings, eleven speeds, two runs, few steps."""
    return compose_config(SMALL)


@pytest.fixture(scope="session")
def finished(base: Config, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder in which every stage has run."""
    folder = tmp_path_factory.mktemp("finished") / "ball"
    for stage in ("generate", "train", "evaluate", "robustness", "predict"):
        run_stage(base.model_copy(update={"stage": stage, "output": str(folder)}))
    return folder


@pytest.fixture
def mine(finished: Path, tmp_path: Path) -> Path:
    """A copy of the finished folder, to be damaged."""
    return Path(shutil.copytree(finished, tmp_path / "my messung ü"))


def run(base: Config, stage: str, folder: Path, **sections: object) -> None:
    """One stage in ``folder``."""
    run_stage(base.model_copy(update={"stage": stage, "output": str(folder)} | sections))


def measured(folder: Path, **files: Path) -> DataConfig:
    """The data set of ``folder`` given as somebody's own files, some of them by other names."""
    names = {
        "vibration": "vibration.parquet",
        "excitation": "excitation.csv",
        "known": "known_coefficients.csv",
    }
    return DataConfig(**{key: str(files.get(key, folder / name)) for key, name in names.items()})


def contents(folder: Path) -> dict[str, bytes]:
    """Every file below ``folder``."""
    return {str(p.relative_to(folder)): p.read_bytes() for p in sorted(folder.rglob("*")) if p.is_file()}


def refused_by_train(
    base: Config, folder: Path, files: dict[str, Path], *fragments: str, kind: type[PipelineError] = DataError
) -> None:
    """Training on ``files`` is refused, and its output folder is not even made."""
    output = folder.parent / "output"
    before = contents(folder)
    with refused(*fragments, kind=kind):
        run(base, "train", output, data=measured(folder, **files))
    assert not output.exists()
    assert contents(folder) == before


def stored(table: pd.DataFrame, path: Path) -> Path:
    """``table`` as somebody else's program would write it, in the format of the ending."""
    if path.suffix == ".parquet":
        mixed = {name: str for name in table.columns[table.dtypes.map(str) == "object"]}
        table.astype(mixed).to_parquet(path, index=False)
    else:
        table.to_csv(path, index=False)
    return path


def put(column: str, value: object, rows: Sequence[int] = (4,)) -> Change:
    """A change of the table that sets some rows of a column."""

    def change(table: pd.DataFrame) -> pd.DataFrame:
        if not isinstance(value, (int, float)):
            table = table.astype({column: object})
        elif table[column].dtype != float:
            table = table.astype({column: float})
        table.loc[list(rows), column] = value
        return table

    return change


def keep(law: Callable[[pd.DataFrame], Any]) -> Change:
    """A change of the table that keeps the rows where ``law`` holds."""
    return lambda table: table[law(table)]


# --- vibration -----------------------------------------------------------------------------------

VIBRATION: dict[str, tuple[Change, str, str]] = {
    "NaN": (put("amplitude_m", np.nan), "must have finite numbers in the column 'amplitude_m'", "row 5 has"),
    "infinite": (
        put("phase_deg", -np.inf),
        "must have finite numbers in the column 'phase_deg'",
        "row 5 has",
    ),
    "text for a number": (put("speed_rpm", "fast"), "finite numbers in the column 'speed_rpm'", "'fast'"),
    "no rows": (keep(lambda t: t["node"] > 99), "must have at least one row", "it has none"),
    "a node the rotor lacks": (put("node", 99), "must use the rotor's nodes 0 to 2", "node 99"),
    "a negative node": (put("node", -1), "must use the rotor's nodes 0 to 2", "node -1"),
    "half a node": (put("node", 0.5), "must use the rotor's nodes 0 to 2", "node 0.5"),
    "unknown direction": (
        put("direction", "z"),
        "must have 'x', 'y' or an angle in degrees (from x towards y) in the column 'direction'",
        "'z'",
    ),
    "speed zero": (put("speed_rpm", 0.0), "must have speeds above zero", "0 rpm"),
    "negative speed": (put("speed_rpm", -500.0), "must have speeds above zero", "-500 rpm"),
    "unsorted speeds": (lambda t: t.iloc[::-1], "must have ascending speeds in every run", "is not sorted"),
    "one speed out of order": (
        lambda t: pd.concat([t.iloc[6:12], t.iloc[:6], t.iloc[12:]]),
        "must have ascending speeds in every run",
        "run 'one'",
    ),
    "negative amplitude": (put("amplitude_m", -1e-6), "must have amplitudes of zero or more", "-1e-06 m"),
    "all rows twice": (
        lambda t: pd.concat([t, t]).sort_values(["run", "speed_rpm"]),
        "must have one row a run, speed, node and direction",
        "twice",
    ),
    "a row again with another value": (
        lambda t: pd.concat([t.iloc[:1].assign(amplitude_m=1.0), t]),
        "must have one row a run, speed, node and direction",
        "twice",
    ),
    "a channel missing at one speed": (
        keep(lambda t: t.index != 3),
        "must have every channel at every speed of every run",
        "the first: run 'one', 500 rpm, node 1 y",
    ),
    "a speed missing in one run": (
        keep(lambda t: (t["run"] == "two") | (t["speed_rpm"] != 1000)),
        "must have every channel at every speed of every run",
        "6 of 132 are missing",
    ),
    "a run that nothing excites": (
        lambda t: pd.concat([t, t[t["run"] == "one"].assign(run="three")]),
        "must have a row for every run",
        "'three'",
    ),
    "an excited run without data": (
        keep(lambda t: t["run"] == "one"),
        "must have data of every run",
        "run 'two'",
    ),
    "x missing at a bearing": (
        keep(lambda t: (t["node"] != 0) | (t["direction"] != "x")),
        "needs x and y measured at every bearing",
        "x of node 0",
    ),
    "y missing at a bearing": (
        keep(lambda t: (t["node"] != 2) | (t["direction"] != "y")),
        "needs x and y measured at every bearing",
        "y of node 2",
    ),
    "only the disc measured": (
        keep(lambda t: t["node"] == 1),
        "needs x and y measured at every bearing",
        "node 0 is missing",
    ),
}


@pytest.mark.parametrize("ending", ["parquet", "csv"])
@pytest.mark.parametrize("case", VIBRATION)
def test_vibration_that_breaks_a_law(case: str, ending: str, base: Config, mine: Path) -> None:
    """Whatever is wrong with the numbers, the sentence says the law and what came, for both formats."""
    change, law, came = VIBRATION[case]
    path = stored(change(pd.read_parquet(mine / "vibration.parquet")), mine / f"theirs.{ending}")
    refused_by_train(base, mine, {"vibration": path}, law, came)


@pytest.mark.parametrize("ending", ["parquet", "csv"])
@pytest.mark.parametrize("column", ["run", "speed_rpm", "node", "direction", "amplitude_m", "phase_deg"])
def test_vibration_without_a_column(column: str, ending: str, base: Config, mine: Path) -> None:
    """A missing column is named, beside those that are there."""
    table = pd.read_parquet(mine / "vibration.parquet").rename(columns={column: f"{column}_"})
    path = stored(table, mine / f"theirs.{ending}")
    refused_by_train(base, mine, {"vibration": path}, f"must have the column '{column}'", f"'{column}_'")


UNPHYSICAL: dict[str, Change] = {
    "every sensor dead": lambda t: t.assign(amplitude_m=0.0),
    "a bearing that never moves": lambda t: t.assign(amplitude_m=t["amplitude_m"].where(t["node"] != 0, 0.0)),
    "x of a bearing dead": lambda t: t.assign(
        amplitude_m=t["amplitude_m"].where((t["node"] != 0) | (t["direction"] != "x"), 0.0)
    ),
    "no motion at one speed": lambda t: t.assign(amplitude_m=t["amplitude_m"].where(t["speed_rpm"] != 1000, 0.0)),
    "amplitudes that overflow": lambda t: t.assign(amplitude_m=1e300),
}


@pytest.mark.parametrize("case", UNPHYSICAL)
def test_vibration_that_determines_nothing(case: str, base: Config, mine: Path) -> None:
    """Finite numbers from which no coefficient follows are refused too, not trained into NaN."""
    path = stored(UNPHYSICAL[case](pd.read_parquet(mine / "vibration.parquet")), mine / "theirs.csv")
    refused_by_train(base, mine, {"vibration": path}, "must", kind=PipelineError)


WHOLE_FILES: dict[str, tuple[bytes, str]] = {
    "empty": (b"", "must be a"),
    "zeros": (b"\0" * 1000, "must"),
    "random": (np.random.default_rng(0).bytes(4000), "must be a"),
    "a picture": (b"\x89PNG\r\n\x1a\n" + bytes(range(256)), "must be a"),
    "text": ("Das ist kein Tisch. Öl!\n".encode(), "must"),
    "Parquet's ends alone": (b"PAR1PAR1", "must"),
    "UTF-16": ("run,speed_rpm,node,direction,amplitude_m,phase_deg\n".encode("utf-16"), "must be a"),
    "semicolons": (b"run;speed_rpm;node;direction;amplitude_m;phase_deg\none;500;0;x;1e-6;0\n", "must"),
}


@pytest.mark.parametrize("ending", ["parquet", "csv"])
@pytest.mark.parametrize("case", WHOLE_FILES)
def test_vibration_that_is_no_table(case: str, ending: str, base: Config, mine: Path) -> None:
    """A file that is no table at all is named and refused."""
    raw, law = WHOLE_FILES[case]
    path = mine / f"theirs.{ending}"
    path.write_bytes(raw)
    refused_by_train(base, mine, {"vibration": path}, f"'{path}'", law)


@pytest.mark.parametrize("key", ["vibration", "excitation", "known"])
@pytest.mark.parametrize("kind", ["nothing", "a folder"])
def test_a_given_file_that_is_not_there(key: str, kind: str, base: Config, mine: Path) -> None:
    """A file that is named in data.* must exist; it is never generated."""
    path = mine if kind == "a folder" else mine / "nothing.csv"
    refused_by_train(base, mine, {key: path}, f"'{path}' must exist")


def test_a_truncated_parquet_file(base: Config, mine: Path) -> None:
    """A Parquet file cut off anywhere is refused by training and by what looks at its marks."""
    rotor, path = assemble(base.machine.rotor), mine / "vibration.parquet"
    whole = path.read_bytes()
    lengths = {*range(0, len(whole), len(whole) // 80), *range(16), *(len(whole) - n for n in range(1, 16))}
    for length in sorted(lengths):
        path.write_bytes(whole[:length])
        assert read_marks(path) is None
        with refused("must be a complete Parquet file", "stage=generate"):
            read_dataset(path, mine / "excitation.csv", rotor)
    refused_by_train(base, mine, {}, "must be a complete Parquet file")


def test_an_older_schema(base: Config, mine: Path) -> None:
    """A Parquet file that an older version wrote is named as such."""
    import pyarrow.parquet as parquet

    path = mine / "vibration.parquet"
    table = parquet.read_table(path)
    marks = dict(table.schema.metadata) | {b"bearing_identification.schema": b"0"}
    parquet.write_table(table.replace_schema_metadata(marks), path)
    refused_by_train(base, mine, {}, "must have the file schema 1", "schema 0", "stage=generate")


@pytest.mark.parametrize("change", ["schema", "rotor", "origin"])
def test_marks_that_are_no_text(change: str, base: Config, mine: Path) -> None:
    """The marks in a Parquet file may hold any bytes."""
    import pyarrow.parquet as parquet

    path = mine / "vibration.parquet"
    table = parquet.read_table(path)
    marks = dict(table.schema.metadata) | {f"bearing_identification.{change}".encode(): b"\xff\xfe"}
    parquet.write_table(table.replace_schema_metadata(marks), path)
    with refused("must"):
        run(base, "train", mine)


def test_data_of_another_rotor(base: Config, mine: Path) -> None:
    """Vibration that was made for another shaft is refused, also where it is given as a data set."""
    shaft = base.machine.rotor.shaft[0].model_copy(update={"outer_diameter": 0.036})
    other = with_machine(base, rotor=base.machine.rotor.model_copy(update={"shaft": (shaft,)}))
    refused_by_train(other, mine, {}, "must have been made for this rotor", "made for another")
    with refused("must have been generated from the configured machine", "stage=generate"):
        run(other, "train", mine)


@pytest.mark.parametrize("stage", ["train", "evaluate", "robustness", "predict"])
def test_a_bearing_changed_since_generate(stage: str, base: Config, mine: Path) -> None:
    """Own data of another bearing are refused by every stage, and old results stay as they were."""
    before = contents(mine)
    other = with_machine(base, bearings=base.machine.bearings.model_copy(update={"n_balls": 9}))
    with refused("must have been generated from the configured machine", "changed since"):
        run(other, stage, mine)
    assert contents(mine) == before


def test_own_data_that_nobody_marked_are_never_overwritten(base: Config, mine: Path) -> None:
    """A measured file in the experiment's folder is not replaced by a generated one."""
    import pyarrow.parquet as parquet

    path = mine / "vibration.parquet"
    parquet.write_table(parquet.read_table(path).replace_schema_metadata({}), path)
    (mine / "known_coefficients.csv").unlink()
    before = path.read_bytes()
    with suppress(PipelineError):
        run(base, "train", mine)
    assert path.read_bytes() == before


# --- excitation ----------------------------------------------------------------------------------

EXCITATION: dict[str, tuple[Change, str, str]] = {
    "unknown kind": (put("kind", "hammer", [0]), "'unbalance' or 'force' in the column 'kind'", "'hammer'"),
    "unknown whirl": (
        put("whirl", "around", [1]),
        "'forward' or 'backward' in the column 'whirl'",
        "'around'",
    ),
    "a node the rotor lacks": (put("node", 3, [0]), "must use the rotor's nodes 0 to 2", "node 3"),
    "no magnitude": (put("magnitude", 0.0, [0]), "must have magnitudes above zero", "got 0"),
    "negative magnitude": (put("magnitude", -1.0, [0]), "must have magnitudes above zero", "got -1"),
    "infinite magnitude": (
        put("magnitude", np.inf, [0]),
        "finite numbers in the column 'magnitude'",
        "row 1",
    ),
    "phase NaN": (put("phase_deg", np.nan, [1]), "finite numbers in the column 'phase_deg'", "row 2"),
    "magnitude with a unit": (
        put("magnitude", "100 g mm", [0]),
        "finite numbers in the column",
        "'100 g mm'",
    ),
    "no excitation at all": (keep(lambda t: t["node"] > 9), "must have at least one row", "it has none"),
    "a run left out": (keep(lambda t: t["run"] == "one"), "must have a row for every run", "run 'two'"),
    "a run too many": (
        lambda t: pd.concat([t, t.iloc[:1].assign(run="zero")]),
        "must have data of every run",
        "run 'zero'",
    ),
}


@pytest.mark.parametrize("case", EXCITATION)
def test_excitation_that_breaks_a_law(case: str, base: Config, mine: Path) -> None:
    """The sentence says the law of the excitation file and what came."""
    change, law, came = EXCITATION[case]
    path = stored(change(pd.read_csv(mine / "excitation.csv")), mine / "theirs.csv")
    refused_by_train(base, mine, {"excitation": path}, law, came)


@pytest.mark.parametrize("column", ["run", "kind", "node", "magnitude", "phase_deg", "whirl"])
def test_excitation_without_a_column(column: str, base: Config, mine: Path) -> None:
    """A missing column is named."""
    path = stored(pd.read_csv(mine / "excitation.csv").drop(columns=column), mine / "theirs.csv")
    refused_by_train(base, mine, {"excitation": path}, f"must have the column '{column}'")


def eight_of(base: Config) -> Config:
    """All eight coefficients, as functions of the speed: constants could be told apart across the speeds."""
    unknowns = base.identify.model_copy(update={"unknowns": tuple(EIGHT)})
    network = compose_config(["experiment=hydrostatic_stiffness"]).model
    return base.model_copy(update={"identify": unknowns, "model": network})


def test_fewer_runs_than_the_unknowns_need(base: Config, mine: Path) -> None:
    """Eight unknowns need two runs; with one, the sentence counts equations and unknowns."""
    table = pd.read_parquet(mine / "vibration.parquet")
    force = pd.read_csv(mine / "excitation.csv")
    files = {
        "vibration": stored(table[table["run"] == "one"], mine / "v.parquet"),
        "excitation": stored(force[force["run"] == "one"], mine / "e.csv"),
    }
    refused_by_train(eight_of(base), mine, files, "4 of 8 unknowns", "2 real equations", kind=IdentifiabilityError)


@pytest.mark.parametrize("stage", ["train", "evaluate", "robustness"])
def test_fewer_runs_than_the_unknowns_need_in_a_configuration(stage: str, tmp_path: Path) -> None:
    """One run and eight unknowns: every stage refuses, and no result is left."""
    overrides = [*SMALL, "model=network", f"identify.unknowns={[*EIGHT]}".replace("'", "")]
    overrides = [text for text in overrides if not text.startswith("machine.runs")]
    with refused("the 1 run determine 4 of 8 unknowns", "force=true", kind=IdentifiabilityError):
        run(compose_config(overrides), stage, tmp_path / "x")
    assert not {"model.json", "metrics.json", "robustness.json"} & set(os.listdir(tmp_path / "x"))


def test_two_runs_of_the_same_unbalance_count_as_one(base: Config, mine: Path) -> None:
    """Eight unknowns need independent orbits: the same run again, twice as strong, adds no equation."""
    table = pd.read_parquet(mine / "vibration.parquet")
    force = pd.read_csv(mine / "excitation.csv")
    one, push = table[table["run"] == "one"], force[force["run"] == "one"]
    again = one.assign(run="two", amplitude_m=2 * one["amplitude_m"])
    push_again = push.assign(run="two", magnitude=2 * push["magnitude"])
    files = {
        "vibration": stored(pd.concat([one, again]), mine / "v.parquet"),
        "excitation": stored(pd.concat([push, push_again]), mine / "e.csv"),
    }
    refused_by_train(eight_of(base), mine, files, "multiples of each other", kind=IdentifiabilityError)


# --- coefficients --------------------------------------------------------------------------------

KNOWN: dict[str, tuple[Change, str, str]] = {
    "no cxx": (lambda t: t.drop(columns="cxx"), "must have the column 'cxx'", "it has"),
    "no speeds": (lambda t: t.drop(columns="speed_rpm"), "must have the column 'speed_rpm'", "it has"),
    "a speed left out": (
        keep(lambda t: (t["bearing_node"] != 2) | (t["speed_rpm"] != 1500)),
        "must have every speed of the data",
        "1 are missing for the bearing at node 2 (the first: 1500 rpm)",
    ),
    "a bearing left out": (
        keep(lambda t: t["bearing_node"] == 0),
        "must have rows for the bearing at node 2",
        "[0]",
    ),
    "NaN": (put("cyy", np.nan), "must have finite numbers in the column 'cyy'", "row 5"),
    "infinite": (put("cyy", np.inf), "must have finite numbers in the column 'cyy'", "row 5"),
    "text": (put("kxy", "soft"), "must have finite numbers in the column 'kxy'", "'soft'"),
    "no rows": (keep(lambda t: t["bearing_node"] > 9), "must have at least one row", "none"),
    "a row twice with other values": (
        lambda t: pd.concat([t, t.iloc[:1].assign(cxx=1e9)]),
        "must have one row a bearing and speed",
        "twice",
    ),
}


@pytest.mark.parametrize("case", KNOWN)
def test_known_coefficients_that_break_a_law(case: str, base: Config, mine: Path) -> None:
    """What the user takes as known must be there for every bearing and speed, once."""
    change, law, came = KNOWN[case]
    path = stored(change(pd.read_csv(mine / "known_coefficients.csv")), mine / "theirs.csv")
    refused_by_train(base, mine, {"known": path}, law, came)


MODELLED = [("evaluate", name) for name in KNOWN if name not in {"no cxx", "NaN"}]


@pytest.mark.parametrize(("stage", "case"), [*MODELLED, ("predict", "a speed left out")])
def test_modelled_coefficients_that_break_a_law(stage: str, case: str, base: Config, mine: Path) -> None:
    """A damaged truth is refused before anything is written; old results stay."""
    change, law, came = KNOWN[case]
    path = mine / "modelled_coefficients.csv"
    stored(change(pd.read_csv(path)), path)
    before = contents(mine)
    with refused(f"'{path}'", law, came):
        run(base, stage, mine)
    assert contents(mine) == before


def test_modelled_coefficients_that_break_a_law_in_robustness(base: Config, mine: Path) -> None:
    """Robustness reads the truth after training; a damaged one leaves its old results."""
    (mine / "modelled_coefficients.csv").write_bytes(b"\xff\x00garbage")
    before = contents(mine)
    with refused("modelled_coefficients.csv"):
        run(base, "robustness", mine)
    assert contents(mine) == before


@pytest.mark.slow
@pytest.mark.parametrize("stage", ["evaluate", "predict"])
def test_no_modelled_coefficients(stage: str, base: Config, mine: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """Measured data have no truth: the stages finish without errors of coefficients."""
    (mine / "modelled_coefficients.csv").unlink()
    run(base, stage, mine)
    said = capsys.readouterr().out
    if stage == "evaluate":
        assert "no modelled coefficients" in said
        assert json.loads((mine / "metrics.json").read_text())["coefficients"] == {}
    else:
        assert "displacement" not in json.loads((mine / "prediction.json").read_text())


@pytest.mark.slow
def test_a_modelled_coefficient_of_zero_has_no_relative_error(base: Config, tmp_path: Path) -> None:
    """Identifying kxy of a bearing that has none finishes, and its metrics are JSON."""
    unknowns = base.identify.model_copy(update={"unknowns": ("kxx", "kxy", "kyy")})
    run(base, "evaluate", tmp_path / "x", identify=unknowns)
    metrics = json.loads((tmp_path / "x" / "metrics.json").read_text(), parse_constant=_no_constant)
    assert metrics["coefficients"]["0"]["kxx"]["mean_error_percent"] < 1e-4


def _no_constant(name: str) -> None:
    raise AssertionError(f"{name} is no JSON")


# --- trained models ------------------------------------------------------------------------------

MODEL: dict[str, tuple[str, object, str]] = {
    "older schema": ("schema", 0, "must have schema 3"),
    "newer schema": ("schema", 99, "must have schema 3"),
    "no schema": ("schema", None, "must have schema 3"),
    "no model": ("model", None, "must"),
    "model is a list": ("model", [1, 2], "must"),
    "bearings of another rotor": ("bearing_nodes", [0], "must"),
    "nodes that are not the rotor's bearings": ("bearing_nodes", [0, 1], "must"),
    "unknown parametrisation": ("model.parametrisation", "cubic", "must"),
    "unknown coefficient": ("model.unknowns", ["kxx", "kzz"], "must"),
    "a coefficient short": ("model.unknowns", ["kxx"], "must"),
    "scale null": ("model.scale", [[None, 1.0], [1.0, 1.0]], "must"),
    "scale NaN": ("model.scale", [[float("nan"), 1.0], [1.0, 1.0]], "must"),
    "scale text": ("model.scale", ["ab", "cd"], "must"),
    "scale of one bearing": ("model.scale", [[1.0, 1.0]], "must"),
    "layers text": ("model.hidden", "ab", "must"),
    "layers too many": ("model.hidden", [10**9], "must"),
    "ranges null": ("model.ranges", None, "must"),
}


@pytest.mark.parametrize("case", MODEL)
def test_a_model_file_that_breaks_a_law(case: str, base: Config, mine: Path) -> None:
    """A model.json that does not describe the trained model is refused, never used."""
    key, value, law = MODEL[case]
    path = mine / "model.json"
    description = json.loads(path.read_text())
    node = description["model"] if key.startswith("model.") else description
    node[key.removeprefix("model.")] = value
    path.write_text(json.dumps(description))
    before = contents(mine)
    with refused(law, "stage=train"):
        run(base, "evaluate", mine)
    assert contents(mine) == before


def _weights(change: Callable[[Any], Any]) -> Callable[[Path], None]:
    def damage(path: Path) -> None:
        from safetensors.torch import load_file, save_file

        save_file(change(load_file(path)), path)

    return damage


WEIGHTS: dict[str, Callable[[Path], object]] = {
    "empty": lambda path: path.write_bytes(b""),
    "half": lambda path: path.write_bytes(path.read_bytes()[:-9]),
    "random": lambda path: path.write_bytes(np.random.default_rng(1).bytes(500)),
    "a pickle": lambda path: path.write_bytes(b"\x80\x04\x95\x05\x00\x00\x00\x00\x00\x00\x00K\x01."),
    "another name": _weights(lambda w: {"weights": w["parameters"]}),
    "another shape": _weights(lambda w: {"parameters": w["parameters"][:, :1].contiguous()}),
    "NaN": _weights(lambda w: {"parameters": w["parameters"] * float("nan")}),
    "whole numbers": _weights(lambda w: {"parameters": w["parameters"].long()}),
}


@pytest.mark.parametrize("case", WEIGHTS)
def test_weights_that_are_damaged(case: str, base: Config, mine: Path) -> None:
    """Weights that are not those of the model are refused."""
    WEIGHTS[case](mine / "model.safetensors")
    with refused("must hold a complete trained model", "stage=train"):
        run(base, "evaluate", mine)


@pytest.mark.parametrize("text", ["", "[]", "null", "{", '{"data_fingerprint": 1}', "[" * 100_000, "\xff"])
def test_an_account_of_training_that_is_damaged(text: str, base: Config, mine: Path) -> None:
    """A training.json that is no account of this training is refused."""
    (mine / "training.json").write_text(text, encoding="latin-1")
    with refused("training.json", "must"):
        run(base, "evaluate", mine)


@pytest.mark.parametrize("text", ["", "x,y\n1,2\n", "step,phase,loss\n1,adam,many\n", "\0\0"])
def test_a_history_that_is_damaged(text: str, base: Config, mine: Path) -> None:
    """A history.csv that can't be drawn is refused before metrics are written."""
    (mine / "history.csv").write_text(text)
    before = contents(mine)
    with refused("history.csv", "must"):
        run(base, "evaluate", mine)
    assert contents(mine) == before


@pytest.mark.parametrize("stage", ["evaluate", "predict"])
def test_a_model_of_other_unknowns(stage: str, base: Config, mine: Path) -> None:
    """A model that was trained for kxx and kyy is no answer to a question for damping too."""
    four = base.identify.model_copy(update={"unknowns": ("kxx", "kyy", "cxx", "cyy")})
    with refused("kxx", "cyy", "stage=train"):
        run(base, stage, mine, identify=four)


# --- every stage keeps what was there --------------------------------------------------------------


@pytest.mark.parametrize("stage", ["train", "evaluate", "robustness", "predict"])
def test_bad_data_leave_old_results_as_they_were(stage: str, base: Config, mine: Path) -> None:
    """A stage that refuses its input touches no file."""
    header = "run,kind,node,magnitude,phase_deg,whirl"
    (mine / "excitation.csv").write_text(f"{header}\none,unbalance,7,1,0,forward\n")
    before = contents(mine)
    with refused("must come from one stage=generate"):
        run(base, stage, mine)
    assert contents(mine) == before


@pytest.mark.slow
def test_the_command_line_answers_with_a_sentence_and_2(mine: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """Through the front door: exit code 2, one sentence, no traceback."""
    (mine / "vibration.parquet").write_bytes(b"PAR1")
    assert main([*SMALL, "stage=train", f"output='{mine}'"]) == 2
    _, err = capsys.readouterr()
    assert err.startswith(f"'{mine}/vibration.parquet' must be a complete Parquet file")
    assert "Traceback" not in err


def test_a_generate_for_files_of_others(base: Config, mine: Path) -> None:
    """Generate must write the experiment's own files; given ones are not overwritten."""
    before = contents(mine)
    with refused("generate must write the experiment's own files"):
        run(base, "generate", mine.parent / "x", data=measured(mine))
    assert contents(mine) == before


# --- formats and paths that must work ----------------------------------------------------------------


def _answers(folder: Path) -> dict[str, object]:
    files = ("model.safetensors", "model.json", "identified_coefficients.csv", "training.json")
    return {name: (folder / name).read_bytes() for name in files}


WAYS: dict[str, Callable[[pd.DataFrame, Path], Path]] = {
    "csv": lambda t, folder: stored(t, folder / "v.csv"),
    "csv of the upper case": lambda t, folder: stored(t, folder / "V.CSV"),
    "Parquet of somebody else": lambda t, folder: stored(t, folder / "v.parquet"),
    "more columns": lambda t, folder: stored(t.assign(comment="ü", quality=1), folder / "v.csv"),
    "columns in another order": lambda t, folder: stored(t[t.columns[::-1]], folder / "v.csv"),
    "channels in another order": lambda t, folder: stored(
        t.sort_values(["run", "speed_rpm", "direction", "node"], ascending=[True, True, False, False]),
        folder / "v.csv",
    ),
    "Excel's UTF-8": lambda t, folder: _bytes(folder / "v.csv", t, "utf-8-sig"),
    "Windows line ends": lambda t, folder: _bytes(folder / "v.csv", t, "utf-8", "\r\n"),
    "dictionary columns": lambda t, folder: stored(t.astype({"run": "category"}), folder / "v.parquet"),
}


def _bytes(path: Path, table: pd.DataFrame, encoding: str, line_end: str = "\n") -> Path:
    table.to_csv(path, index=False, encoding=encoding, lineterminator=line_end)
    return path


@pytest.mark.parametrize("way", WAYS)
def test_the_same_numbers_in_another_file_give_the_same_bits(way: str, base: Config, mine: Path) -> None:
    """CSV and Parquet of the same measurement train the same model, to the last bit."""
    path = WAYS[way](pd.read_parquet(mine / "vibration.parquet"), mine)
    output = mine.parent / "Ausgabe mit Leerzeichen – ö"
    run(base, "train", output, data=measured(mine, vibration=path))
    assert _answers(output) == _answers(mine)


@pytest.mark.slow
def test_relative_paths_with_spaces_and_letters_of_any_script(mine: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Files are found by any name, and from the folder the command was started in."""
    folder = mine.parent / "Прибор 測定"
    mine.rename(folder)
    monkeypatch.chdir(folder.parent)
    given = [
        f"data.{key}='Прибор 測定/{name}'"
        for key, name in {
            "vibration": "vibration.parquet",
            "excitation": "excitation.csv",
            "known": "known_coefficients.csv",
        }.items()
    ]
    assert main([*SMALL, "stage=train", "output='new ordner/ä b'", *given]) == 0
    assert _answers(Path("new ordner/ä b")) == _answers(folder)


def test_speeds_of_any_number_of_digits(base: Config, mine: Path) -> None:
    """A measured speed needs no round number: the same digits in both files are the same speed."""
    shift = 100.0 / 3e4 * np.sqrt(2.0)
    files = {}
    for key, name in {"vibration": "vibration.parquet", "known": "known_coefficients.csv"}.items():
        read = pd.read_parquet if name.endswith("parquet") else pd.read_csv
        table = read(mine / name)
        files[key] = stored(table.assign(speed_rpm=table["speed_rpm"] + shift), mine / f"{key}_shifted.csv")
    run(base, "train", mine.parent / "x", data=measured(mine, **files))
    assert (mine.parent / "x" / "training.json").exists()


def test_numbers_as_names_of_runs(base: Config, mine: Path) -> None:
    """A run may be called 007 or NA, in both formats."""
    names = {"one": "007", "two": "NA"}
    vibration = pd.read_parquet(mine / "vibration.parquet").replace({"run": names})
    excitation = stored(pd.read_csv(mine / "excitation.csv").replace({"run": names}), mine / "e.csv")
    for ending in ("csv", "parquet"):
        path = stored(vibration, mine / f"v.{ending}")
        dataset = read_dataset(path, excitation, assemble(base.machine.rotor))
        assert dataset.runs == ("007", "NA")


# --- fuzzing -----------------------------------------------------------------------------------------

EDITS = st.lists(
    st.tuples(
        st.floats(0, 1, exclude_max=True),  # where
        st.sampled_from(["set", "flip", "delete", "insert", "repeat"]),
        st.binary(min_size=1, max_size=8),
    ),
    min_size=1,
    max_size=6,
)
FUZZ = settings(
    examples(150),
    suppress_health_check=[HealthCheck.function_scoped_fixture, HealthCheck.too_slow],
)


def mutated(raw: bytes, edits: Sequence[tuple[float, str, bytes]]) -> bytes:
    """``raw`` with some bytes set, flipped, deleted, inserted or repeated."""
    data = bytearray(raw)
    for where, how, chunk in edits:
        at = int(where * len(data))
        if how == "set":
            data[at : at + len(chunk)] = chunk
        elif how == "flip" and data:
            data[at] ^= 1 << (chunk[0] % 8)
        elif how == "delete":
            del data[at : at + chunk[0]]
        elif how == "insert":
            data[at:at] = chunk
        elif how == "repeat":
            data[at:at] = data[at // 2 : at // 2 + chunk[0]]
    return bytes(data)


@pytest.fixture
def small(base: Config, mine: Path) -> Path:
    """The data set with two speeds and few bytes."""
    for name in ("vibration.parquet", "known_coefficients.csv"):
        read = pd.read_parquet if name.endswith("parquet") else pd.read_csv
        table = read(mine / name)
        marks = {"rotor": assemble(base.machine.rotor).fingerprint, "origin": "origin"}
        write_table(mine / name, table[table["speed_rpm"] <= 1000], marks)
    stored(pd.read_parquet(mine / "vibration.parquet"), mine / "vibration.csv")
    return mine


def _dataset(folder: Path, base: Config, vibration: str = "vibration.parquet") -> VibrationDataset:
    read_marks(folder / vibration)
    return read_dataset(folder / vibration, folder / "excitation.csv", assemble(base.machine.rotor))


READERS: dict[str, Callable[[Path, Config], object]] = {
    "vibration.parquet": _dataset,
    "vibration.csv": partial(_dataset, vibration="vibration.csv"),
    "excitation.csv": _dataset,
    "known_coefficients.csv": lambda folder, base: read_coefficients(
        folder / "known_coefficients.csv", (0, 2), SPEEDS[:2] * np.pi / 30, {0: known_names(base), 2: known_names(base)}
    ),
    "training.json": lambda folder, base: read_json(folder / "training.json"),
    "model.json": lambda folder, base: load_model(folder).table(_known()),
    "model.safetensors": lambda folder, base: load_model(folder).table(_known()),
}


def _known() -> BearingTable:
    speeds = SPEEDS * np.pi / 30
    return BearingTable((0, 2), speeds, np.zeros((2, len(speeds), 8)))


@pytest.mark.slow
@pytest.mark.parametrize("name", READERS)
def test_a_file_with_any_bytes_wrong_is_read_or_refused(name: str, base: Config, small: Path) -> None:
    """Whatever happened to a file on its way, its reader raises errors of ours only, and no warning."""
    path, whole = small / name, (small / name).read_bytes()
    READERS[name](small, base)

    @FUZZ
    @given(edits=EDITS)
    def damaged(edits: list[tuple[float, str, bytes]]) -> None:
        path.write_bytes(mutated(whole, edits))
        with suppress(PipelineError):
            READERS[name](small, base)

    damaged()


PANDAS_NOTES = {
    "no JSON": b"{",
    "another JSON": b"[1]",
    "no UTF-8": b"\xff",
    "an unknown type": b'{"index_columns": [], "column_indexes": [], "pandas_version": "3.1.1", "columns":'
    b' [{"name": "run", "field_name": "run", "pandas_type": "unicode", "numpy_type": "x"}]}',
    "nothing said": b"{}",
}


@pytest.mark.parametrize("case", PANDAS_NOTES)
def test_notes_of_pandas_in_a_parquet_file_do_not_matter(case: str, base: Config, small: Path) -> None:
    """What pandas notes in a Parquet file is not needed to read it, so damage there changes no number."""
    import pyarrow.parquet as parquet

    path = small / "vibration.parquet"
    before = _dataset(small, base).fingerprint
    table = parquet.read_table(path)
    marks = dict(table.schema.metadata) | {b"pandas": PANDAS_NOTES[case]}
    parquet.write_table(table.replace_schema_metadata(marks), path)
    with suppress(DataError):
        assert _dataset(small, base).fingerprint == before


@pytest.mark.slow
def test_a_threshold_file_with_any_bytes_wrong_is_read_or_refused(tmp_path: Path) -> None:
    """A damaged threshold file is a mistake in the configuration."""
    path = tmp_path / "x.yaml"
    whole = b"- metric: coefficients.*.kxx.mean_error_percent\n  max: 1.0e-4\n  why: because it is so\n"

    @FUZZ
    @given(edits=EDITS)
    def damaged(edits: list[tuple[float, str, bytes]]) -> None:
        path.write_bytes(mutated(whole, edits))
        with suppress(ConfigError):
            read_rules(path)

    damaged()


# --- full disks and read-only folders ----------------------------------------------------------------


@contextmanager
def largest_file(size: int) -> Iterator[None]:
    """The system refuses to let any file grow beyond ``size`` bytes: a full disk, for every library alike."""
    soft, hard = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (size, hard))
    try:
        yield
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, (soft, hard))


NUMBERS = pd.DataFrame(np.random.default_rng(2).random((2000, 4)), columns=list("abcd"))


def _picture(path: Path) -> None:
    with open_figure(path, 1, 1, 4, 4) as axes:
        axes[0, 0].imshow(np.random.default_rng(3).random((50, 50)))


@pytest.fixture
def writers(finished: Path) -> dict[str, Callable[[Path], object]]:
    """One writer of some kilobytes for every kind of file."""
    from dataclasses import replace

    import torch

    model = replace(load_model(finished), parameters=torch.zeros(2, 2000, dtype=torch.float64))
    return {
        "x.csv": partial(write_table, table=NUMBERS),
        "x.parquet": partial(write_table, table=NUMBERS),
        "x.json": partial(write_json, value={"x": "x" * 9000}),
        "x.png": _picture,
        "model.safetensors": lambda path: save_model(path.parent, model),
    }


KINDS = ["x.csv", "x.parquet", "x.json", "x.png", "model.safetensors"]


@pytest.mark.parametrize("old", [True, False], ids=["over an old file", "anew"])
@pytest.mark.parametrize("kind", KINDS)
def test_a_disk_that_is_full_in_the_middle_of_a_file(
    kind: str, old: bool, writers: dict[str, Callable[[Path], object]], tmp_path: Path
) -> None:
    """A file is written whole or not at all: the old one stays, no temporary one is left."""
    path = tmp_path / "results" / kind
    path.parent.mkdir()
    if old:
        path.write_bytes(b"old")
    before = contents(tmp_path)
    with refused(f"'{path}' must be writable", "output=FOLDER", kind=StorageError), largest_file(1000):
        writers[kind](path)
    assert contents(tmp_path) == before
    writers[kind](path)
    assert path.stat().st_size > 1000


def _raising(code: int, at: int = 1) -> Callable[..., None]:
    """A stand-in for os.replace that fails at its ``at``-th call."""
    real, calls = os.replace, []

    def replace(*arguments: Any, **options: Any) -> None:
        calls.append(1)
        if len(calls) >= at:
            raise OSError(code, os.strerror(code), str(arguments[1]))
        real(*arguments, **options)

    return replace


@pytest.mark.parametrize("code", [errno.EROFS, errno.ENOSPC, errno.EACCES, errno.EIO, errno.EDQUOT])
@pytest.mark.parametrize("kind", KINDS)
def test_a_file_that_cannot_be_put_in_its_place(
    kind: str,
    code: int,
    writers: dict[str, Callable[[Path], object]],
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """Where the rename fails, the system's reason is in the sentence and nothing is left behind."""
    path = tmp_path / kind
    path.write_bytes(b"old")
    monkeypatch.setattr(os, "replace", _raising(code))
    with refused("must be writable", os.strerror(code), kind=StorageError):
        writers[kind](path)
    assert contents(tmp_path) == {kind: b"old"}


@pytest.mark.parametrize("error", [OSError(errno.ENOSPC, "full"), KeyboardInterrupt(), ValueError()])
def test_a_writer_that_fails_half_way(error: BaseException, tmp_path: Path) -> None:
    """Whatever stops a writer, its half file is taken away and the old one stays."""
    path = tmp_path / "x.txt"
    path.write_text("old")

    def write(beside: Path) -> None:
        beside.write_text("half")
        raise error

    expected = StorageError if isinstance(error, OSError) else type(error)
    with pytest.raises(expected):
        write_beside(path, write)
    assert contents(tmp_path) == {"x.txt": b"old"}


@pytest.mark.parametrize("stage", ["configure", "generate", "train", "evaluate", "robustness", "predict"])
def test_a_folder_that_cannot_be_made(stage: str, base: Config, tmp_path: Path) -> None:
    """An output below a regular file is refused by every stage, and the file stays."""
    (tmp_path / "file").write_text("a file")
    with refused("must be writable", "Not a directory", kind=StorageError):
        run(base, stage, tmp_path / "file" / "x")
    assert contents(tmp_path) == {"file": b"a file"}


@pytest.mark.parametrize("stage", ["generate", "train", "evaluate", "robustness", "predict"])
def test_a_full_disk_in_a_stage(stage: str, base: Config, mine: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """A stage that can't save ends in a sentence; every file is the old one or a complete new one."""
    names = contents(mine).keys()
    with refused("must be writable", kind=StorageError), largest_file(300):
        run(base, stage, mine)
    assert contents(mine).keys() == names
    assert sum(len(raw) == 300 for raw in contents(mine).values()) == 0


@pytest.mark.parametrize("stage", ["generate", "train", "evaluate", "robustness", "predict"])
def test_a_read_only_folder(stage: str, base: Config, mine: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """In a folder that can be read but not written, every stage ends in a sentence and changes nothing."""
    before = contents(mine)
    monkeypatch.setattr(os, "replace", _raising(errno.EROFS))
    with refused("must be writable", "Read-only file system", kind=StorageError):
        run(base, stage, mine)
    assert contents(mine) == before


def identified(base: Config, folder: Path, **sections: object) -> bytes:
    """The coefficients that evaluate and predict work with."""
    config = base.model_copy(update={"stage": "evaluate", "output": str(folder)} | sections)
    measurement = load_measurement(config)
    return load_identified(config, measurement).table(measurement.known).values.tobytes()


@pytest.fixture
def fails_after(monkeypatch: pytest.MonkeyPatch) -> Callable[[int, Callable[[], None]], None]:
    """``fails_after(n, action)``: the disk is full after ``n`` files; True where the action noticed."""

    def act(files: int, action: Callable[[], None]) -> None:
        with monkeypatch.context() as patch:
            patch.setattr(os, "replace", _raising(errno.ENOSPC, at=files + 1))
            with suppress(StorageError):
                action()

    return act


@pytest.mark.parametrize("files", range(1, 5))
def test_a_training_saved_in_part_is_never_taken_for_a_whole_one(
    files: int, base: Config, mine: Path, fails_after: Callable[[int, Callable[[], None]], None]
) -> None:
    """Where saving stopped between two files, evaluate answers for one of the models, or refuses."""
    # Another parametrisation: other weights, and another meaning of weights.
    scaled = {"model": base.model.model_copy(update={"parametrisation": "scaled"})}
    whole = Path(shutil.copytree(mine, mine.parent / "whole"))
    run(base, "train", whole, **scaled)
    expected = (identified(base, mine), identified(base, whole))
    fails_after(files, partial(run, base, "train", mine, **scaled))
    with suppress(DataError):
        assert identified(base, mine) in expected


@pytest.mark.parametrize("files", range(1, 4))
def test_data_generated_in_part_are_never_taken_for_whole_ones(
    files: int, base: Config, mine: Path, fails_after: Callable[[int, Callable[[], None]], None]
) -> None:
    """Where generate stopped between two files, training answers for the configured data, or refuses."""
    other = with_machine(base, bearings=base.machine.bearings.model_copy(update={"n_balls": 12}))
    changed = {"machine": other.machine}
    whole = Path(shutil.copytree(mine, mine.parent / "whole"))
    run(base, "generate", whole, **changed)
    run(base, "train", whole, **changed)
    answers = {"old": _answers(mine), "new": _answers(whole)}
    fails_after(files, partial(run, base, "generate", mine, **changed))
    for which, sections in {"old": {}, "new": changed}.items():
        with suppress(DataError):
            run(base, "train", mine, **sections)
            assert _answers(mine) == answers[which]
