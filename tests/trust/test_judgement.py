"""The verdict's words: what is determined of supports."""

from __future__ import annotations

from pipeline.trust.judgement import describe_supports


def test_the_verdict_names_what_is_determined_of_supports() -> None:
    """By the limits of coefficients, 5 and 30 %; what has no number of its own is no support's."""
    fitted = {
        f"support_mass node 1 {axis}": {"number": 20.0, "number_deviation": d}
        for axis, d in zip("xy", (0.9, 7.0), strict=True)
    }
    told = "support mass node 1 x well determined (+- 4.5 %); support mass node 1 y not determined (+- 35 %)"
    assert describe_supports({**fitted, "bow": {"deviation": 1e-6}}) == told
