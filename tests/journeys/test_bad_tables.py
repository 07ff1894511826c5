"""Bad data tables: a sentence of ours says the law and what came, and no file is touched."""

from __future__ import annotations

import json
import os
from pathlib import Path

import numpy as np
import pandas as pd
import pytest
from conftest import Run, refused
from damaged import SMALL, Change, keep, put, refused_by_train, stored
from running import contents

from pipeline.coefficients import COEFFICIENTS
from pipeline.config.compose import compose_config
from pipeline.config.schema import Config
from pipeline.errors import IdentifiabilityError, PipelineError

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
def test_vibration_that_breaks_a_law(case: str, ending: str, run: Run, base: Config, mine: Path) -> None:
    """Whatever is wrong with the numbers, the sentence says the law and what came, for both formats."""
    change, law, came = VIBRATION[case]
    path = stored(change(pd.read_parquet(mine / "vibration.parquet")), mine / f"theirs.{ending}")
    refused_by_train(run, base, mine, {"vibration": path}, law, came)


@pytest.mark.parametrize("ending", ["parquet", "csv"])
@pytest.mark.parametrize("column", ["run", "speed_rpm", "node", "direction", "amplitude_m", "phase_deg"])
def test_vibration_without_a_column(column: str, ending: str, run: Run, base: Config, mine: Path) -> None:
    table = pd.read_parquet(mine / "vibration.parquet").rename(columns={column: f"{column}_"})
    path = stored(table, mine / f"theirs.{ending}")
    refused_by_train(run, base, mine, {"vibration": path}, f"must have the column '{column}'", f"'{column}_'")


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
def test_vibration_that_determines_nothing(case: str, run: Run, base: Config, mine: Path) -> None:
    """Finite numbers from which no coefficient follows are refused too, not trained into NaN."""
    path = stored(UNPHYSICAL[case](pd.read_parquet(mine / "vibration.parquet")), mine / "theirs.csv")
    refused_by_train(run, base, mine, {"vibration": path}, "must", kind=PipelineError)


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
def test_vibration_that_is_no_table(case: str, ending: str, run: Run, base: Config, mine: Path) -> None:
    raw, law = WHOLE_FILES[case]
    path = mine / f"theirs.{ending}"
    path.write_bytes(raw)
    refused_by_train(run, base, mine, {"vibration": path}, f"'{path}'", law)


@pytest.mark.parametrize("key", ["vibration", "excitation", "known"])
@pytest.mark.parametrize("kind", ["nothing", "a folder"])
def test_a_given_file_that_is_not_there(key: str, kind: str, run: Run, base: Config, mine: Path) -> None:
    path = mine if kind == "a folder" else mine / "nothing.csv"
    refused_by_train(run, base, mine, {key: path}, f"'{path}' must exist")


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
def test_excitation_that_breaks_a_law(case: str, run: Run, base: Config, mine: Path) -> None:
    change, law, came = EXCITATION[case]
    path = stored(change(pd.read_csv(mine / "excitation.csv")), mine / "theirs.csv")
    refused_by_train(run, base, mine, {"excitation": path}, law, came)


@pytest.mark.parametrize("column", ["run", "kind", "node", "magnitude", "phase_deg", "whirl"])
def test_excitation_without_a_column(column: str, run: Run, base: Config, mine: Path) -> None:
    path = stored(pd.read_csv(mine / "excitation.csv").drop(columns=column), mine / "theirs.csv")
    refused_by_train(run, base, mine, {"excitation": path}, f"must have the column '{column}'")


def eight_of(base: Config) -> Config:
    """All eight coefficients, as functions of the speed: constants could be told apart across the speeds."""
    unknowns = base.identify.model_copy(update={"unknowns": COEFFICIENTS})
    network = compose_config(["experiment=hydrostatic_stiffness"]).model
    return base.model_copy(update={"identify": unknowns, "model": network})


def test_fewer_runs_than_the_unknowns_need(run: Run, base: Config, mine: Path) -> None:
    """Eight unknowns need two runs; with one, the sentence counts equations and unknowns."""
    table = pd.read_parquet(mine / "vibration.parquet")
    force = pd.read_csv(mine / "excitation.csv")
    files = {
        "vibration": stored(table[table["run"] == "one"], mine / "v.parquet"),
        "excitation": stored(force[force["run"] == "one"], mine / "e.csv"),
    }
    refused_by_train(run, eight_of(base), mine, files, "4 of 8 unknowns", "2 real equations", kind=IdentifiabilityError)


@pytest.mark.parametrize("stage", ["train", "evaluate", "robustness"])
def test_fewer_runs_than_the_unknowns_need_in_a_configuration(stage: str, run: Run, tmp_path: Path) -> None:
    overrides = [*SMALL, "model=network", f"identify.unknowns=[{','.join(COEFFICIENTS)}]"]
    overrides = [text for text in overrides if not text.startswith("machine.runs")]
    with refused("the 1 run determine 4 of 8 unknowns", "force=true", kind=IdentifiabilityError):
        run(stage, compose_config(overrides), tmp_path / "x")
    assert not {"model.json", "metrics.json", "robustness.json"} & set(os.listdir(tmp_path / "x"))


def test_two_runs_of_the_same_unbalance_count_as_one(run: Run, base: Config, mine: Path) -> None:
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
    refused_by_train(run, eight_of(base), mine, files, "multiples of each other", kind=IdentifiabilityError)


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
def test_known_coefficients_that_break_a_law(case: str, run: Run, base: Config, mine: Path) -> None:
    change, law, came = KNOWN[case]
    path = stored(change(pd.read_csv(mine / "known_coefficients.csv")), mine / "theirs.csv")
    refused_by_train(run, base, mine, {"known": path}, law, came)


MODELLED = [("evaluate", name) for name in KNOWN if name not in {"no cxx", "NaN"}]


@pytest.mark.parametrize(("stage", "case"), [*MODELLED, ("predict", "a speed left out")])
def test_modelled_coefficients_that_break_a_law(stage: str, case: str, run: Run, base: Config, mine: Path) -> None:
    change, law, came = KNOWN[case]
    path = mine / "modelled_coefficients.csv"
    stored(change(pd.read_csv(path)), path)
    before = contents(mine)
    with refused(f"'{path}'", law, came):
        run(stage, base, mine)
    assert contents(mine) == before


def test_modelled_coefficients_that_break_a_law_in_robustness(run: Run, base: Config, mine: Path) -> None:
    (mine / "modelled_coefficients.csv").write_bytes(b"\xff\x00garbage")
    before = contents(mine)
    with refused("modelled_coefficients.csv"):
        run("robustness", base, mine)
    assert contents(mine) == before


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
    unknowns = base.identify.model_copy(update={"unknowns": ("kxx", "kxy", "kyy")})
    run("evaluate", base, tmp_path / "x", identify=unknowns)
    metrics = json.loads((tmp_path / "x" / "metrics.json").read_text(), parse_constant=_no_constant)
    assert metrics["coefficients"]["0"]["kxx"]["mean_error_percent"] < 1e-4


def _no_constant(name: str) -> None:
    raise AssertionError(f"{name} is no JSON")
