"""Bad data tables: a sentence of ours says the law and what came, and no file is touched."""

from __future__ import annotations

import json
import os
from pathlib import Path

import numpy as np
import pandas as pd
import pytest
from conftest import Run, refused
from damaged import FILES, SMALL, Change, Law, Refused, keep, loaded, put, stored
from running import left_alone, strict_json

from pipeline.coefficients import COEFFICIENTS
from pipeline.config.compose import compose_config
from pipeline.config.schema import Config
from pipeline.errors import IdentifiabilityError, PipelineError


def no(column: str) -> Law:
    """A table whose column has another name: it is named, beside those that are there."""
    return f"must have the column '{column}'", lambda t: t.rename(columns={column: f"{column}_"}), f"'{column}_'"


NODES = "must use the rotor's nodes 0 to 2"
ONCE = "must have one row a run, speed, node and direction"
EVERYWHERE = "must have every channel at every speed of a run"
BOTH = "needs x and y measured at every bearing"
VIBRATION: list[Law] = [
    ("must have finite numbers in the column 'amplitude_m'", put("amplitude_m", np.nan), "row 5 has"),
    ("must have finite numbers in the column 'phase_deg'", put("phase_deg", -np.inf), "row 5 has"),
    ("must have finite numbers in the column 'speed_rpm'", put("speed_rpm", "fast"), "'fast'"),
    ("must have at least one row", keep(lambda t: t["node"] > 99), "it has none"),
    *((NODES, put("node", node), f"node {node}") for node in (99, -1, 0.5)),
    ("must have 'x', 'y' or an angle in degrees (from x towards y) in the column", put("direction", "z"), "'z'"),
    *(("must have speeds above zero", put("speed_rpm", rpm), f"{rpm:g} rpm") for rpm in (0.0, -500.0)),
    ("must have amplitudes of zero or more", put("amplitude_m", -1e-6), "-1e-06 m"),
    (ONCE, lambda t: pd.concat([t, t]), "the first: run 'one', 500 rpm, node 0 x"),
    (ONCE, lambda t: pd.concat([t, t.iloc[-1:].assign(amplitude_m=1.0)]), "the first: run 'two', 5500 rpm, node 2 y"),
    (EVERYWHERE, keep(lambda t: t.index != 3), "the first: run 'one', 500 rpm, node 1 y"),
    (EVERYWHERE, keep(lambda t: (t["speed_rpm"] != 1000) | (t["node"] != 1)), "4 of 132 are missing"),
    ("must have a row for every run", lambda t: pd.concat([t, t[t["run"] == "one"].assign(run="three")]), "'three'"),
    ("must have data of every run", keep(lambda t: t["run"] == "one"), "run 'two'"),
    (BOTH, keep(lambda t: (t["node"] != 0) | (t["direction"] != "x")), "x of node 0"),
    (BOTH, keep(lambda t: (t["node"] != 2) | (t["direction"] != "y")), "y of node 2"),
    (BOTH, keep(lambda t: t["node"] == 1), "node 0 is missing"),
    *(no(column) for column in ("run", "speed_rpm", "node", "direction", "amplitude_m", "phase_deg")),
]
EXCITATION: list[Law] = [
    ("'unbalance' or 'force' in the column 'kind'", put("kind", "hammer", [0]), "'hammer'"),
    ("'forward' or 'backward' in the column 'whirl'", put("whirl", "around", [1]), "'around'"),
    (NODES, put("node", 3, [0]), "node 3"),
    *(("must have magnitudes above zero", put("magnitude", size, [0]), f"got {size:g}") for size in (-1e-300, -1.0)),
    ("finite numbers in the column 'magnitude'", put("magnitude", np.inf, [0]), "row 2"),
    ("finite numbers in the column 'phase_deg'", put("phase_deg", np.nan, [1]), "row 3"),
    ("finite numbers in the column 'magnitude'", put("magnitude", "100 g mm", [0]), "'100 g mm'"),
    ("must have at least one row", keep(lambda t: t["node"] > 9), "it has none"),
    ("must have a row for every run", keep(lambda t: t["run"] == "one"), "run 'two'"),
    ("must have data of every run", lambda t: pd.concat([t, t.iloc[:1].assign(run="zero")]), "run 'zero'"),
    *(no(column) for column in ("run", "kind", "node", "magnitude", "phase_deg", "whirl")),
]
EITHER: list[Law] = [  # table of coefficients
    *(("must have finite numbers in the column 'cyy'", put("cyy", value), "row 6") for value in (np.nan, np.inf)),
    ("must have finite numbers in the column 'kxy'", put("kxy", "soft"), "'soft'"),
    ("must have at least one row", keep(lambda t: t["bearing_node"] > 9), "none"),
    ("must have one row a bearing and speed", lambda t: pd.concat([t, t.iloc[:1].assign(cxx=1e9)]), "twice"),
]
KNOWN: list[Law] = [
    *EITHER,
    no("cxx"),
    ("must have speed_rpm in every row, or one row that holds at all speeds", no("speed_rpm")[1], "node 0"),
    (
        "must cover the speeds of the data (500 to 5500 rpm)",
        keep(lambda t: (t["bearing_node"] != 2) | (t["speed_rpm"] != 5500)),
        "bearing at node 2, must cover",
    ),
    ("must have rows of the bearing at node 2", keep(lambda t: t["bearing_node"] == 0), "it has 0"),
]
MISSING: Law = (
    "must have every speed of the data",
    keep(lambda t: (t["bearing_node"] != 2) | (t["speed_rpm"] != 1500)),
    "bearing at node 2, must have every speed of the data, but 1 are missing (the first: 1500 rpm)",
)
MODELLED: list[Law] = [
    *(law for law in EITHER if law[2] != "row 6"),
    no("speed_rpm"),
    MISSING,
    KNOWN[-1],
]
LAWS = [
    *(("vibration", "parquet", law) for law in VIBRATION),
    # A CSV file has its header in the first row.
    *(("vibration", "csv", (words, change, came.replace("row 5", "row 6"))) for words, change, came in VIBRATION),
    *(("excitation", "csv", law) for law in EXCITATION),
    *(("known", "csv", law) for law in KNOWN),
]


@pytest.mark.parametrize(
    ("key", "ending", "law"), LAWS, ids=lambda value: value if isinstance(value, str) else value[2]
)
def test_a_table_that_breaks_a_law(key: str, ending: str, law: Law, refused_by_train: Refused, mine: Path) -> None:
    """Whatever is wrong with the numbers, the sentence says the law and what came, for both formats."""
    words, change, came = law
    refused_by_train({key: stored(change(loaded(mine / FILES[key])), mine / f"theirs.{ending}")}, words, came)


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
def test_vibration_that_determines_nothing(case: str, refused_by_train: Refused, mine: Path) -> None:
    """Finite numbers from which no coefficient follows are refused too, not trained into NaN."""
    path = stored(UNPHYSICAL[case](pd.read_parquet(mine / "vibration.parquet")), mine / "theirs.csv")
    refused_by_train({"vibration": path}, "must", kind=PipelineError)


WHOLE_FILES: dict[str, tuple[bytes, str]] = {
    "empty": (b"", "must be a"),
    "zeros": (b"\0" * 1000, "must"),
    "random": (np.random.default_rng(0).bytes(4000), "must be a"),
    "a picture": (b"\x89PNG\r\n\x1a\n" + bytes(range(256)), "must be a"),
    "text": ("Das ist kein Tisch. Öl!\n".encode(), "must"),
    "Parquet's ends alone": (b"PAR1PAR1", "must"),
    "UTF-16": ("run,speed_rpm,node,direction,amplitude_m,phase_deg\n".encode("utf-16"), "must"),
    "semicolons": (b"run;speed_rpm;node;direction;amplitude_m;phase_deg\none;500;0;x;1e-6;0\n", "must"),
}


@pytest.mark.parametrize("ending", ["parquet", "csv"])
@pytest.mark.parametrize("case", WHOLE_FILES)
def test_vibration_that_is_no_table(case: str, ending: str, refused_by_train: Refused, mine: Path) -> None:
    raw, law = WHOLE_FILES[case]
    path = mine / f"theirs.{ending}"
    path.write_bytes(raw)
    refused_by_train({"vibration": path}, f"'{path}'", law)


@pytest.mark.parametrize("key", ["vibration", "excitation", "known"])
@pytest.mark.parametrize("kind", ["nothing", "a folder"])
def test_a_given_file_that_is_not_there(key: str, kind: str, refused_by_train: Refused, mine: Path) -> None:
    path = mine if kind == "a folder" else mine / "nothing.csv"
    refused_by_train({key: path}, f"'{path}' must exist")


def eight_of(base: Config) -> Config:
    """All eight coefficients, as functions of the speed: constants could be told apart across the speeds."""
    unknowns = base.identify.model_copy(update={"unknowns": COEFFICIENTS})
    network = compose_config(["experiment=hydrostatic_stiffness"]).model
    return base.model_copy(update={"identify": unknowns, "model": network})


@pytest.mark.parametrize("stage", ["train", "evaluate", "robustness"])
def test_fewer_runs_than_the_unknowns_need_in_a_configuration(stage: str, run: Run, tmp_path: Path) -> None:
    of_one_run = [text for text in SMALL if not text.startswith("machine.runs")]
    overrides = [*of_one_run, "model=network", f"identify.unknowns=[{','.join(COEFFICIENTS)}]"]
    with refused("the 1 run determine 4 of 8 unknowns", "force=true", kind=IdentifiabilityError):
        run(stage, compose_config(overrides), tmp_path / "x")
    assert not {"model.json", "metrics.json", "robustness.json"} & set(os.listdir(tmp_path / "x"))


@pytest.mark.parametrize(
    ("again", "words"), [([], ["4 of 8 unknowns", "2 real equations"]), ([2], ["multiples of each other"])]
)
def test_fewer_independent_runs_than_the_unknowns_need(
    again: list[int], words: list[str], base: Config, refused_by_train: Refused, mine: Path
) -> None:
    """Eight unknowns need two independent orbits: the same run again, twice as strong, adds no equation."""
    table = pd.read_parquet(mine / "vibration.parquet")
    force = pd.read_csv(mine / "excitation.csv")
    one, push = table[table["run"] == "one"], force[force["run"] == "one"]
    runs = [one, *(one.assign(run="two", amplitude_m=size * one["amplitude_m"]) for size in again)]
    pushes = [push, *(push.assign(run="two", magnitude=size * push["magnitude"]) for size in again)]
    files = {
        "vibration": stored(pd.concat(runs), mine / "v.parquet"),
        "excitation": stored(pd.concat(pushes), mine / "e.csv"),
    }
    refused_by_train(files, *words, kind=IdentifiabilityError, of=eight_of(base))


@pytest.mark.parametrize(
    ("stage", "law"), [*(("evaluate", law) for law in MODELLED), ("predict", MISSING), ("robustness", MISSING)]
)
def test_modelled_coefficients_that_break_a_law(stage: str, law: Law, run: Run, base: Config, mine: Path) -> None:
    words, change, came = law
    path = mine / "modelled_coefficients.csv"
    stored(change(pd.read_csv(path)), path)
    with left_alone(mine), refused(f"'{path}'", words, came):
        run(stage, base, mine)


@pytest.mark.slow
@pytest.mark.parametrize("stage", ["evaluate", "predict"])
def test_no_modelled_coefficients(
    stage: str, run: Run, base: Config, mine: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    (mine / "modelled_coefficients.csv").unlink()
    run(stage, base, mine)
    said = capsys.readouterr().out
    if stage == "evaluate":
        assert "no modelled coefficients" in said
        assert json.loads((mine / "metrics.json").read_text())["coefficients"] == {}
    else:
        assert "displacement" not in json.loads((mine / "prediction.json").read_text())


@pytest.mark.slow
def test_a_modelled_coefficient_of_zero_has_no_relative_error(run: Run, base: Config, tmp_path: Path) -> None:
    run("evaluate", base, tmp_path / "x", identify=base.identify.model_copy(update={"unknowns": ("kxx", "kxy", "kyy")}))
    metrics = strict_json(tmp_path / "x" / "metrics.json")
    assert metrics["coefficients"]["0"]["kxx"]["mean_error_percent"] < 1e-10
