"""Tables of films: the modelled bearing, beyond their rows, and files and names that are none."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
import torch
from training import assert_close

from laws.test_law_set import ELLIPTICAL, LUND, SPEEDS, WARM, constant, known, laws, unknown
from pipeline.errors import ConfigError
from pipeline.laws.table import FOLDER, read_film_table
from pipeline.rotor.bearings import JournalTableConfig


def test_a_table_is_the_modelled_bearing() -> None:
    rows = np.loadtxt(FOLDER / f"{LUND['table']}.csv", delimiter=",", skiprows=5)
    by_rows = {**{k: v for k, v in LUND.items() if k != "table"}, "rows": rows.tolist()}
    for modelled, law in ((by_rows, LUND), (ELLIPTICAL, ELLIPTICAL)):
        config = JournalTableConfig.model_validate({**modelled, "oil_viscosity": 0.0166})
        ours = known(laws(law, oil=constant(0.0166)))[0]
        theirs = config.tabulate(SPEEDS, {})
        np.testing.assert_allclose(ours, theirs, rtol=1e-9, atol=1e-9 * np.abs(theirs).max())


def test_beyond_its_rows_a_table_goes_on_smoothly_and_says_so() -> None:
    given = laws(unknown(LUND, "radial_clearance"))
    curve = read_film_table(LUND["table"]).curves[0]
    for end, side in ((curve.nodes[0], -1), (curve.nodes[-1], 1)):
        before, after = (curve.evaluate(torch.tensor([end + step], dtype=torch.float64)) for step in (-1e-7, 1e-7))
        assert_close(before[0], after[0], rtol=1e-6, atol=1e-6)
        assert_close(before[1], after[1], rtol=1e-4, atol=1e-4)
        assert torch.isfinite(curve.evaluate(torch.tensor([end + 20.0 * side], dtype=torch.float64))[0]).all()
    shares = given.outside(torch.tensor([[0.0], [np.log(10.0)]], dtype=torch.float64), SPEEDS, WARM)
    assert (shares.shape, shares[0, 0]) == ((2, 1), 0)
    assert shares[1, 0] > 0.5


HEADER = "S,Kxx,Kxy,Kyx,Kyy,Bxx,Bxy,Byx,Byy\n"


@pytest.mark.parametrize(
    ("text", "said"),
    [
        (HEADER.replace("Bxx", "Cxx") + "1,1,1,1,1,1,1,1,1\n", "has no Bxx"),
        (HEADER + "1,1,1,1,1,1,1,1,x\n", "a number in every cell"),
        (HEADER + "1,1,1,1,1,1,1,1,1\n" * 5, "ascending Sommerfeld"),
        (HEADER + "1,1,1,1,1,1,1,1,1\n", "must have 4 rows"),
        (HEADER + "1,1,1,1,1,1,1,1,nan\n", "must be finite"),
        (HEADER, "must have 4 rows"),
        ("", "has no S"),
    ],
)
def test_a_file_that_is_no_table_is_refused(text: str, said: str, tmp_path: Path) -> None:
    path = tmp_path / "table.csv"
    path.write_text(text, encoding="utf-8")
    with pytest.raises(ConfigError, match=said):
        read_film_table(str(path))


def test_a_name_that_is_no_table_is_refused() -> None:
    with pytest.raises(ConfigError, match="did you mean 'lund_thomsen_two_axial_groove'"):
        read_film_table("lund_thomsen")
