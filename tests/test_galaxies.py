import numpy as np
import pytest
from astropy import units as u
from scipy.integrate import quad
from scipy.special import gammaincinv

from porrima.errors import InputError
from porrima.galaxies import SERSIC, Galaxies, r2_of_half_light, regauss_r2


@pytest.mark.parametrize("index", [0.5, 1.0, 2.5, 4.0])
def test_size_of_a_profile_is_the_integral_of_its_square_radius(index):
    b = gammaincinv(2 * index, 0.5)
    moments = [
        quad(lambda r, p=p: r**p * np.exp(-b * r ** (1 / index)), 0, 3000, limit=500, points=[1.0, 10.0])[0]
        for p in (1, 3)
    ]
    assert r2_of_half_light(index) == pytest.approx(moments[1] / moments[0], rel=1e-6)


def test_half_light_radius_of_a_gaussian_holds_half_of_its_light():
    (r2,) = Galaxies.sersic(0.3, SERSIC["gaussian"]).r2
    assert 1 - np.exp(-(0.3**2) / r2) == pytest.approx(0.5)


def test_half_light_radius_comes_back():
    galaxies = Galaxies.sersic([0.1, 0.4] * u.arcsec, SERSIC["de-vaucouleurs"], [3.0, 1.0])
    np.testing.assert_allclose(galaxies.half_light_radius, [0.1, 0.4])
    np.testing.assert_allclose(galaxies.weight, [0.75, 0.25])


@pytest.mark.parametrize("scatter", [0.0, 0.1, 0.4])
def test_mean_of_one_over_r2_of_a_log_normal_is_known(scatter):
    galaxies = Galaxies.log_normal(0.05, scatter)
    expected = np.exp(0.5 * (scatter * np.log(10)) ** 2) / 0.05
    assert galaxies.inverse_r2 == pytest.approx(expected, rel=1e-10)


def test_cut_of_a_log_normal_is_sharp():
    galaxies = Galaxies.log_normal(0.05, 0.4, smallest_r2=0.03)
    z = np.random.default_rng(20270101).normal(size=1_000_000)
    drawn = 0.05 * 10 ** (0.4 * z)
    kept = 1 / drawn[drawn >= 0.03]
    assert galaxies.r2.min() >= 0.03
    assert abs(galaxies.inverse_r2 - kept.mean()) < 5 * kept.std() / np.sqrt(kept.size)


def test_resolved_galaxies_have_at_least_the_resolution():
    galaxies = Galaxies.of([0.001, 0.004, 0.02, 0.1], [1, 1, 1, 3]).resolved(0.008, 1 / 3)
    np.testing.assert_allclose(galaxies.r2, [0.004, 0.02, 0.1])
    np.testing.assert_allclose(galaxies.weight, [0.2, 0.2, 0.6])


def test_size_in_regauss_of_a_gaussian_is_the_difference_of_the_two():
    np.testing.assert_allclose(regauss_r2(np.array([0.03]), 0.01, np.array([0.0])), 0.02)
    assert regauss_r2(np.array([0.03]), 0.01, np.array([0.1])) < 0.02


@pytest.mark.parametrize(
    ("make", "message"),
    [
        (lambda: Galaxies.of([]), "galaxies.r2: must hold at least one galaxy"),
        (
            lambda: Galaxies.of([0.1, -0.2]),
            "galaxies.r2: must be positive and finite \\[arcsec²\\], got -0.2",
        ),
        (lambda: Galaxies.of(0.0), "must be positive and finite"),
        (lambda: Galaxies.of(np.nan), "must be positive and finite"),
        (lambda: Galaxies.of([0.1, 0.2], [1.0]), "galaxies.weight: must be 2, one for each size, got 1"),
        (lambda: Galaxies.of([0.1, 0.2], [1.0, -1.0]), "not negative, got -1.0"),
        (lambda: Galaxies.of([0.1], [0.0]), "must have a positive sum"),
        (lambda: Galaxies.of(0.1, mean_e2=1.0), "galaxies.mean_e2: must be in \\[0, 1\\), got 1.0"),
        (lambda: Galaxies.of(0.1, index=9.0), "galaxies.index: must be in \\[0.3, 6.2\\], got 9.0"),
        (lambda: Galaxies.sersic(-0.3, 1.0), "galaxies.half_light_radius: must be positive"),
        (lambda: Galaxies.sersic(0.3, 0.0), "galaxies.index: must be in"),
        (lambda: Galaxies.log_normal(0.1, -0.1), "galaxies.scatter: must be finite and not negative"),
        (lambda: Galaxies.log_normal(-0.1, 0.1), "galaxies.median_r2: must be positive"),
        (lambda: Galaxies.log_normal(0.1, 0.1, smallest_r2=1e3), "leaves no galaxies"),
        (lambda: Galaxies.log_normal(0.1, 0.0, smallest_r2=0.2), "leaves no galaxies"),
        (lambda: Galaxies.of([0.1, 0.2]).larger_than(0.3), "leaves no galaxies"),
        (lambda: Galaxies.of(0.1).resolved(0.01, 1.0), "galaxies.resolution: must be in"),
    ],
)
def test_bad_galaxies_are_named(make, message):
    with pytest.raises(InputError, match=message):
        make()
