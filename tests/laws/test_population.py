"""The population of bearings: against closed forms, laws of similarity, and bearings that ROSS computes."""

from __future__ import annotations

import numpy as np
import pytest

from pipeline.laws.population import LACKS, draw_bearings, make_priors, stand_on_ground

NODES = np.geomspace(40.0, 700.0, 6)


def test_rolling_bearings_have_no_cross_coupling_and_keep_their_loss() -> None:
    """asinh(kxx / (w cxx)) falls with the logarithm of the speed; c over k is the same in both directions."""
    drawn = draw_bearings("rolling", NODES, 500.0, 0.05, np.random.default_rng(1))
    assert not drawn[..., [1, 2, 5, 6]].any()
    assert np.allclose(drawn[..., 4] / drawn[..., 0], drawn[..., 7] / drawn[..., 3])
    assert np.exp(np.log(drawn[:, 0, 0]).mean()) == pytest.approx(5e7, rel=0.1)


@pytest.mark.parametrize("family", ["plain", "lobed", "tilting_pad"])
def test_films_scale_with_load_and_speed(family: str) -> None:
    """The load times four, at speeds times four: the same Sommerfeld numbers (Lund and Thomsen 1978), so stiffness is
    four times as large, and damping as large as before. Viscosity falls over the speed by the same power.
    """
    first = draw_bearings(family, NODES, 300.0, 0.06, np.random.default_rng(2), count=40)
    second = draw_bearings(family, 4 * NODES, 1200.0, 0.06, np.random.default_rng(2), count=40)
    assert np.allclose(second[..., :4], 4 * first[..., :4], rtol=1e-9, atol=1e-3)
    assert np.allclose(second[..., 4:], first[..., 4:], rtol=1e-9, atol=1e-6)


@pytest.mark.parametrize("yields", [False, True])
def test_priors_are_normal_distributions_with_room_for_what_theory_lacks(yields: bool) -> None:
    """Symmetric, positive, no narrower than what theory lacks; the same again for the same seed."""
    families = (*LACKS, "unknown")
    priors = make_priors(families, NODES, 300.0, 0.06, yields=yields)
    for prior, same in zip(priors, make_priors(families, NODES, 300.0, 0.06, yields=yields), strict=True):
        assert np.array_equal(prior.mean, same.mean)
        assert np.array_equal(prior.root, same.root)
        deviation = np.sqrt((prior.root**2).sum(axis=1)).reshape(8, -1)
        assert np.linalg.eigvalsh(prior.root @ prior.root.T).min() > 0
        if prior.family in LACKS:
            size, angle, stiffness, damping = LACKS[prior.family]
            least = [size, angle, size, angle, stiffness, stiffness, damping, damping]
            assert (deviation >= np.array(least)[:, None] * 0.999).all()


def test_a_bearing_of_ross_lies_within_the_prior_of_its_family() -> None:
    """A short bearing of ordinary size, by ROSS: each coordinate within three deviations."""
    ross = pytest.importorskip("ross")
    from pipeline.impedance import to_coordinates

    bearing = ross.CylindricalBearing(
        n=0, speed=NODES, weight=300.0, bearing_length=0.03, journal_diameter=0.06, radial_clearance=5e-5,
        oil_viscosity=0.02,
    )  # fmt: skip
    names = ("kxx", "kxy", "kyx", "kyy", "cxx", "cxy", "cyx", "cyy")
    values = np.stack([np.asarray(getattr(bearing, name), dtype=float) for name in names], axis=-1)
    (prior,) = make_priors(("plain",), NODES, 300.0, 0.06)
    off = to_coordinates(values, NODES).T.ravel() - prior.mean
    assert (np.abs(off) < 3 * np.sqrt((prior.root**2).sum(axis=1))).all()


def test_on_rigid_ground_a_bearing_is_felt_as_it_is_and_on_pedestals_in_series() -> None:
    """Springs in series, far below the own frequency of the pedestal: Z H / (Z + H)."""
    rolling = draw_bearings("rolling", NODES, 500.0, 0.05, np.random.default_rng(3), count=20)
    rigid = stand_on_ground(rolling, NODES, np.random.default_rng(4), (1e9, 0.0), (1e6, 0.0))
    assert np.allclose(rigid, rolling, rtol=1e-6)
    soft = stand_on_ground(rolling, NODES, np.random.default_rng(4), (2.0, 0.0), (1e6, 0.0))
    larger = np.abs(rolling[..., [0, 3]] + 1j * NODES[:, None] * rolling[..., [4, 7]]).max(axis=(1, 2))
    ground, film = 2 * larger[:, None], rolling[..., 0] + 1j * NODES * rolling[..., 4]
    felt = film * ground / (film + ground)
    assert np.allclose(soft[..., 0], felt.real, rtol=1e-9)
    assert np.allclose(NODES * soft[..., 4], felt.imag, rtol=1e-9)
