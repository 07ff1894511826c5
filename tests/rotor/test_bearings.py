"""Modelled bearings: whose oil warms and whose load changes, of coefficients at some speeds, and what is refused."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, Literal

import numpy as np
import pytest
from conftest import refused
from pydantic import ValidationError

from pipeline.coefficients import COEFFICIENTS
from pipeline.config.compose import compose_config
from pipeline.config.quantities import Angle, Length, ModelledLoad
from pipeline.config.rotor import RotorConfig
from pipeline.errors import ConfigError
from pipeline.laws.law_set import LawsConfig, make_laws
from pipeline.rotor.bearings import PerNodeBearingConfig, SpeedTableConfig, _Bearing
from pipeline.rotor.ross_adapter import bearing_table, ross
from pipeline.units import RAD_S_PER_RPM

ROTOR = RotorConfig.model_validate(
    {
        "shaft": [{"length": "1 m", "outer_diameter": "50 mm", "elements": 4}],
        "material": {"density": 7810.0, "youngs_modulus": "211 GPa", "shear_modulus": "81.2 GPa"},
        "bearing_nodes": [0, 4],
    }
)
OIL = {"law": "vogel", "reference": "40 degC", "viscosity": "30 mPa s", "b": "900 K", "c": "-95 degC"}
SIZES = {"journal_diameter": "99.8 mm", "length": "49.9 mm", "radial_clearance": "0.1 mm"}
TABLE = {"kind": "journal_table", "table": "lund_thomsen_two_axial_groove", **SIZES, "load_angle": "-90 deg"}
SHORT = {"kind": "cylindrical", **SIZES}
BALL = {"kind": "ball", "n_balls": 9, "ball_diameter": "12 mm", "contact_angle": "20 deg"}
SPEEDS = np.tile(np.linspace(60.0, 300.0, 5), 3)
STATES = {
    "oil_temperature": np.repeat([313.0, 323.0, 333.0], 5),
    "load": np.repeat([700.0, 700.0, 2000.0], 5),
}


def bearings(first: Mapping[str, Any], second: Mapping[str, Any] | None = None) -> PerNodeBearingConfig:
    return PerNodeBearingConfig.model_validate({"kind": "per_node", "nodes": {0: first, 4: second or first}})


def test_films_follow_temperature_and_load_as_the_laws_do() -> None:
    """Three ways to one answer: the law's splines in torch, the modelled table, and ROSS at each state."""
    own = {"static_load": "condition", "oil_viscosity": OIL}
    table = bearing_table(ROTOR, bearings({**TABLE, **own}, {**SHORT, **own}), SPEEDS, STATES)
    assert table.operating == STATES
    law = {"static_load": "condition"}
    section = {"oil": OIL, "bearings": {0: {**TABLE, **law}, 4: {**SHORT, "kind": "short_journal", **law}}}
    import torch

    laws = make_laws(LawsConfig.model_validate(section), (0, 4))
    values = laws.coefficients(torch.zeros(1, 0, dtype=torch.float64), SPEEDS, STATES)[0][0].numpy()
    size = np.abs(table.values[..., :4]).max()
    np.testing.assert_allclose(values, table.values, rtol=1e-8, atol=1e-9 * size)
    for warm, load in ((313.0, 700.0), (333.0, 2000.0)):
        at = (STATES["oil_temperature"] == warm) & (STATES["load"] == load)
        theirs = ross().CylindricalBearing(
            n=0,
            speed=SPEEDS[at],
            weight=load,
            bearing_length=0.0499,
            journal_diameter=0.0998,
            radial_clearance=1e-4,
            oil_viscosity=0.03 * np.exp(900 / (warm - 178.15) - 900 / 135.0),
        )
        listed = np.stack([getattr(theirs, name) for name in COEFFICIENTS], axis=-1)
        np.testing.assert_allclose(table.values[1, at], listed, rtol=1e-7, atol=1e-9 * size)


def test_a_modelled_journal_turns_in_its_bore() -> None:
    with pytest.raises(ValidationError, match="must be smaller than the journal's radius, but it is 60 mm"):
        bearings({**SHORT, "radial_clearance": "60 mm", "oil_viscosity": "20 mPa s"})


def test_what_follows_no_condition_is_the_same_at_all_of_them() -> None:
    """Speeds in the order of the points, each several times."""
    fixed = bearings({**SHORT, "static_load": "500 N", "oil_viscosity": "20 mPa s"}, {**BALL, "static_load": "500 N"})
    table, once = bearing_table(ROTOR, fixed, SPEEDS, STATES), bearing_table(ROTOR, fixed, SPEEDS[:5])
    np.testing.assert_array_equal(table.values, np.tile(once.values, (1, 3, 1)))


def test_a_ball_bearing_follows_its_load() -> None:
    table = bearing_table(ROTOR, bearings({**BALL, "static_load": "condition"}), SPEEDS, STATES)
    light, heavy = table.values[0, 0], table.values[0, -1]
    np.testing.assert_allclose(heavy, light * (2000 / 700) ** (1 / 3), rtol=1e-12)


def test_a_named_table_is_that_of_its_rows() -> None:
    from pipeline.config.compose import compose_config

    machine = compose_config(["machine=compressor_two_journals"]).machine
    assert machine.bearings.kind == "per_node"
    by_rows = machine.bearings.nodes[8]
    by_name = by_rows.model_copy(update={"rows": None, "table": "lund_thomsen_two_axial_groove"})
    both = PerNodeBearingConfig(kind="per_node", nodes={8: by_rows, 21: by_name})
    found = bearing_table(machine.rotor, both, np.linspace(50.0, 400.0, 6)).values
    np.testing.assert_array_equal(found[0], found[1])


def test_a_condition_that_is_missing_is_named() -> None:
    film = bearings({**SHORT, "static_load": "500 N", "oil_viscosity": OIL})
    loaded = bearings({**TABLE, "static_load": "condition", "oil_viscosity": 0.02})
    need, give = "need the operating condition", "give machine.operating.oil_temperature"
    for given, states, words in (
        (film, {"load": STATES["load"]}, [f"{need} oil_temperature, but there is load: {give}"]),
        (bearings({**BALL, "static_load": "condition"}), {}, [f"{need} load"]),
        (film, {"oil_temperature": np.full(15, 150.0)}, ["above Vogel's c"]),
        (loaded, {"load": np.full(15, 1.0)}, ["span the Sommerfeld numbers", "choose speeds from"]),
    ):
        with refused(*words, kind=ConfigError):
            bearing_table(ROTOR, given, SPEEDS, states)


class RollerBearingConfig(_Bearing):
    """A kind that somebody adds: what it is, and ROSS's element of it."""

    kind: Literal["roller"]
    n_rollers: int
    roller_length: Length
    static_load: ModelledLoad
    contact_angle: Angle

    def make_element(self, ross: Any, node: int, speeds: np.ndarray, share: float) -> Any:
        return ross.RollerBearingElement(
            n=node,
            n_rollers=self.n_rollers,
            l_rollers=self.roller_length,
            fs=self.static_load,
            alpha=self.contact_angle,
        )


def test_a_new_kind_that_ross_models_follows_its_load_without_more_code() -> None:
    given = {"kind": "roller", "n_rollers": 8, "roller_length": "16 mm", "contact_angle": "0 deg"}
    follows = RollerBearingConfig.model_validate(given | {"static_load": "condition"})
    values = follows.tabulate(SPEEDS, STATES, 0.0, ross())
    for load in (700.0, 2000.0):
        fixed = RollerBearingConfig.model_validate(given | {"static_load": load})
        at = STATES["load"] == load
        np.testing.assert_allclose(values[at], fixed.tabulate(SPEEDS[at], {}, 0.0, ross()), rtol=1e-12)
    assert values[0, 0] < values[-1, 0]
    with refused("need the operating condition load, but there is none", kind=ConfigError):
        follows.tabulate(SPEEDS, {}, 0.0, ross())


def test_a_constant_oil_may_be_a_number_or_a_law() -> None:
    named = {"static_load": "500 N", "oil_viscosity": {"law": "constant", "viscosity": "20 mPa s"}}
    plain = {"static_load": "500 N", "oil_viscosity": "20 mPa s"}
    np.testing.assert_array_equal(
        *(bearing_table(ROTOR, bearings({**SHORT, **oil}), SPEEDS[:5]).values for oil in (named, plain))
    )


FIRST, SECOND = (1000.0, *range(1, 9)), (3000.0, *range(11, 19))


def test_between_the_rows_are_straight_lines() -> None:
    table = SpeedTableConfig(kind="speed_table", rows=(FIRST, SECOND))
    found = table.tabulate(np.array([1000.0, 1500.0, 3000.0]) * RAD_S_PER_RPM)
    np.testing.assert_allclose(found, [FIRST[1:], np.array(FIRST[1:]) + 2.5, SECOND[1:]], rtol=1e-12)


def test_speeds_beyond_the_rows_are_refused() -> None:
    table = SpeedTableConfig(kind="speed_table", rows=(FIRST, SECOND))
    with pytest.raises(ConfigError, match="must span all speeds, but it has 1000 to 3000 rpm and 3100 rpm is needed"):
        table.tabulate(np.array([1500.0, 3100.0]) * RAD_S_PER_RPM)


@pytest.mark.parametrize(
    ("rows", "said"),
    [
        (f"[{list(SECOND)},{list(FIRST)}]", "ascending speeds"),
        (f"[{list(FIRST)}]", "at least 2"),
        (f"[{list(FIRST)[:5]},{list(SECOND)[:5]}]", "at least 9"),
    ],
)
def test_a_table_that_breaks_its_law_is_refused(rows: str, said: str) -> None:
    linear = "{kind: speed_table, rows: " + rows + "}"
    with pytest.raises(ConfigError, match=said):
        compose_config(["machine=two_discs", f"machine.bearings={linear}"])
