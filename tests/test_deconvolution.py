import numpy as np
import pytest
from scipy.special import gamma

from porrima.deconvolution import fit_response
from porrima.galaxies import SERSIC, Galaxies
from porrima.moments import INDICES
from porrima.psf import psf_from_name, sheared_gaussian
from porrima.shear import gaussian_response

SECOND = [INDICES.index(powers) for powers in ((2, 0), (1, 1), (0, 2))]


@pytest.mark.parametrize("psf", ["psf2", "optical1"])
@pytest.mark.parametrize("mean_e2", [0.0, 0.16])
def test_fits_of_gaussian_galaxies_are_exact_in_second_moments(psf, mean_e2):
    galaxies = Galaxies.sersic(0.15, SERSIC["gaussian"], mean_e2=mean_e2)
    found, expected = fit_response(psf_from_name(psf), galaxies), gaussian_response(galaxies, "g")
    np.testing.assert_allclose(
        found.first[:, SECOND], expected.first[:, SECOND], atol=2e-5 * galaxies.inverse_r2
    )
    assert found.kappa_m == pytest.approx(1, abs=2e-5)
    assert found.kappa_c == pytest.approx(1, abs=2e-5)


def test_moments_of_odd_order_do_not_enter():
    found = fit_response(psf_from_name("psf1"), Galaxies.sersic(0.15, 1.0))
    odd = [(a + b) % 2 == 1 for a, b in INDICES]
    assert not np.any(found.first[:, odd])


@pytest.mark.parametrize("index", [1.0, 2.5])
def test_profile_does_not_matter_to_galaxies_much_smaller_than_the_psf(index):
    kappa = [
        fit_response(psf_from_name("psf0"), Galaxies.sersic(radius, index, mean_e2=0)).kappa_m
        for radius in (0.0005, 0.001, 0.002)
    ]
    assert kappa[0] == pytest.approx(1, abs=0.003)
    assert kappa[0] < kappa[1] < kappa[2]


@pytest.mark.parametrize("mean_e2", [0.0, 0.16])
def test_galaxies_much_larger_than_the_psf_weigh_their_middle(mean_e2):
    n = 0.7
    limit = 4**n * gamma(4 * n) / (gamma(2 * n) * gamma(2 * n + 2))
    found = fit_response(
        sheared_gaussian("narrow", 0, 0, fwhm=0.002), Galaxies.sersic(0.5, n, mean_e2=mean_e2)
    )
    assert found.kappa_m == pytest.approx(limit, rel=2e-3)
    assert found.kappa_c == pytest.approx(limit, rel=2e-3)


def c_of_size(psf, galaxies):
    """c1 and c2 over <x> <1/R_gal²>, for r → 0."""
    found = fit_response(psf, galaxies)
    return (found.first[1:, SECOND[0]] + found.first[1:, SECOND[2]]) / (2 * found.inverse_r2)


def test_round_psf_gives_no_c_and_a_long_one_gives_c_along_it():
    galaxies = Galaxies.sersic(0.1, 1.0)
    np.testing.assert_allclose(c_of_size(psf_from_name("psf0"), galaxies), 0, atol=1e-10)
    c1, c2 = c_of_size(psf_from_name("psf1"), galaxies)
    assert 0 < c1 < 0.054 / 4
    assert c2 / c1 == pytest.approx(-0.003 / 0.054, rel=1e-3)


def test_turning_the_psf_by_45_degrees_turns_c():
    galaxies = Galaxies.sersic(0.1, 1.0)
    along, across = (c_of_size(sheared_gaussian("turned", *e), galaxies) for e in ((0.05, 0.0), (0.0, 0.05)))
    np.testing.assert_allclose(across, [-along[1], along[0]], atol=1e-7)


def test_kernel_that_is_not_round_makes_c_against_it():
    found = fit_response(psf_from_name("psf0"), Galaxies.sersic(0.1, 1.0))
    kernel = np.zeros(len(INDICES))
    kernel[SECOND] = [1e-6, 0.0, 0.0]
    m, c1, c2 = found.first @ kernel
    assert m > 0
    assert c1 < 0
    assert abs(c2) < 1e-9 * abs(c1)


def test_table_of_sizes_is_the_mean_over_it():
    psf, sizes, weight = psf_from_name("psf1"), np.array([0.1, 0.2, 0.3]), np.array([0.5, 0.3, 0.2])
    each = [fit_response(psf, Galaxies.sersic(one, 1.0)).first for one in sizes]
    table = fit_response(psf, Galaxies.sersic(sizes, 1.0, weight))
    np.testing.assert_allclose(table.first, np.tensordot(weight, each, axes=1), rtol=1e-10, atol=1e-10)


def test_law_of_sizes_is_interpolated_to_a_thousandth():
    psf, sizes = psf_from_name("psf0"), np.geomspace(0.05, 0.8, 12)
    each = [fit_response(psf, Galaxies.sersic(one, 1.0)).first for one in sizes]
    table = fit_response(psf, Galaxies.sersic(sizes, 1.0))
    np.testing.assert_allclose(table.first[0, SECOND], np.mean(each, axis=0)[0, SECOND], rtol=1e-3, atol=1e-6)
