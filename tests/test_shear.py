from dataclasses import replace

import galsim
import numpy as np
import pytest

from porrima.errors import InputError
from porrima.galaxies import Galaxies
from porrima.prediction import integrate, population_moments, predict
from porrima.psf import psf_from_name
from porrima.response import response
from porrima.shapes import Plain, Shape
from porrima.shear import (
    deconvolution_bias,
    ellipticity_factors,
    gaussian_response,
    moments_bias,
    naive_bias,
)

R2 = 0.05
NONE = np.zeros((2, 3, 3))


@pytest.fixture(scope="module")
def moments(population):
    return population_moments(population, integrate(population), np.array([0.2, 0.6]))


@pytest.fixture(scope="module")
def plain():
    return response(psf_from_name("psf1"), Plain())


def covariance_of(moments, found, n_stars):
    """Of (e1, e2, ln R²), to first order."""
    first = found.first / np.array([1.0, 1.0, float(found.shape0.r2)])[:, None]
    return first @ moments.covariance @ first.T / n_stars


def test_closed_forms_of_gaussian_galaxies(moments):
    n = 750
    bias = deconvolution_bias(moments, gaussian_response(Galaxies.of(R2), "g"), n)
    x, x2 = moments.mean_x, moments.mean_x2
    np.testing.assert_allclose(bias.m, x / R2)
    np.testing.assert_allclose(bias.c1, 0, atol=1e-18)
    np.testing.assert_allclose(bias.c2, 0, atol=1e-18)
    np.testing.assert_allclose(bias.sd_m, np.sqrt((x2 - x**2) / n) / R2)
    np.testing.assert_allclose(bias.sd_c1, np.sqrt(x2 / (2 * n)) / (2 * R2))
    np.testing.assert_allclose(bias.sd_c2, bias.sd_c1)
    off_diagonal = bias.covariance[:, [0, 0, 1], [1, 2, 2]]
    np.testing.assert_allclose(off_diagonal, 0, atol=1e-12 * bias.covariance.max())


def test_scatter_of_c_is_that_of_the_responsivity_and_of_the_elliptical_size(moments):
    # sqrt(<x²>/2N)/(P_gamma T) with the T = Qxx + Qyy of galaxies of e = 0.4
    galaxies = Galaxies.of(R2, mean_e2=0.16)
    bias = deconvolution_bias(moments, gaussian_response(galaxies), 100)
    elliptical = R2 / np.sqrt(1 - 0.16)
    np.testing.assert_allclose(bias.sd_c1, np.sqrt(moments.mean_x2 / 200) / (1.84 * elliptical))


def test_endless_patches_do_not_scatter(moments):
    bias = deconvolution_bias(moments, gaussian_response(Galaxies.of(R2)))
    assert not np.any(bias.covariance)


def test_a_larger_psf_makes_the_shear_too_large(moments, plain):
    galaxies = Galaxies.of(R2)
    assert np.all(deconvolution_bias(moments, gaussian_response(galaxies)).m > 0)
    assert np.all(moments_bias(predict(moments, plain).bias, NONE, plain.shape0, galaxies).m > 0)


def test_both_methods_agree_on_plain_moments(moments, plain):
    galaxies, n = Galaxies.of([0.02, 0.1]), 1000
    with_deconvolution = deconvolution_bias(moments, gaussian_response(galaxies), n)
    mean = plain.first @ moments.mean.T / np.array([1, 1, float(plain.shape0.r2)])[:, None]
    with_moments = moments_bias(mean, covariance_of(moments, plain, n), plain.shape0, galaxies)
    np.testing.assert_allclose(with_moments.m, with_deconvolution.m)
    np.testing.assert_allclose(with_moments.c1, 0, atol=1e-15)
    np.testing.assert_allclose(
        with_moments.covariance, with_deconvolution.covariance, atol=1e-12 * with_moments.covariance.max()
    )


def test_independent_errors_overstate_c_and_nothing_else(moments, plain):
    arguments = (predict(moments, plain).bias, NONE, plain.shape0, Galaxies.of(R2))
    true, naive = moments_bias(*arguments), naive_bias(*arguments)
    np.testing.assert_allclose(naive.m, true.m)
    assert np.all(naive.c1 > 100 * np.abs(true.c1))
    # both terms are e eta R_P²/R_gal², and add where they should cancel
    eta = predict(moments, plain).eta
    each = 0.054 * eta * float(plain.shape0.r2) / (R2 / np.sqrt(0.84) * 1.84)
    np.testing.assert_allclose(naive.c1, 2 * each, rtol=2e-3)


def test_round_psf_has_no_naive_c_either(moments):
    found = response(psf_from_name("psf0"), Plain())
    naive = naive_bias(predict(moments, found).bias, NONE, found.shape0, Galaxies.of(R2))
    np.testing.assert_allclose(naive.c1, 0, atol=1e-15)


def test_independent_errors_also_overstate_the_scatter_of_c_by_little(moments, plain):
    covariance = covariance_of(moments, plain, 100)
    arguments = (np.zeros((3, 2)), covariance, plain.shape0, Galaxies.of(R2))
    ratio = naive_bias(*arguments).sd_c1 / moments_bias(*arguments).sd_c1
    assert np.all((ratio > 1) & (ratio < 1.01))


def test_turning_psf_and_change_by_45_degrees_turns_c():
    change = np.array([[2e-5], [1e-5], [1e-3]])
    turned = np.array([[-1e-5], [2e-5], [1e-3]])
    one, galaxies = np.zeros((1, 3, 3)), Galaxies.of(R2)
    a = moments_bias(change, one, shape(0.05, 0.02), galaxies)
    b = moments_bias(turned, one, shape(-0.02, 0.05), galaxies)
    np.testing.assert_allclose([b.c1, b.c2, b.m], [-a.c2, a.c1, a.m])


def shape(e1, e2, r2=6.8e-3):
    return Shape(e1=np.array(e1), e2=np.array(e2), r2=np.array(r2), flag=np.array(0))


def test_bias_is_linear_in_the_moments(moments):
    double = replace(
        moments, mean=2 * moments.mean, covariance=4 * moments.covariance, shift=2 * moments.shift
    )
    found = gaussian_response(Galaxies.of(R2))
    one, two = (deconvolution_bias(m, found, 10) for m in (moments, double))
    np.testing.assert_allclose(two.m, 2 * one.m)
    np.testing.assert_allclose(two.covariance, 4 * one.covariance)


@pytest.mark.parametrize("responsivity", ["measured", "fixed", "g"])
@pytest.mark.parametrize("mean_e2", [0.0, 0.16, 0.4])
def test_factors_are_those_of_galaxies_sheared_one_by_one(responsivity, mean_e2):
    # second moments themselves: a ring of galaxies, lensed, each with a little taken off Q
    def shear_of(lens, removed):
        e = []
        for angle in np.arange(64) * np.pi / 64:
            g = np.sqrt(mean_e2) / (1 + np.sqrt(1 - mean_e2))
            intrinsic = galsim.Shear(g=g, beta=angle * galsim.radians)
            a = galsim.Shear(g1=lens).getMatrix() @ intrinsic.getMatrix()
            q = R2 / 2 * a @ a.T - removed
            e.append([q[0, 0] - q[1, 1], 2 * q[0, 1]] / np.trace(q))
        e = np.array(e)
        modulus2 = np.sum(e**2, axis=1)
        if responsivity == "g":
            return np.mean(e[:, 0] / (1 + np.sqrt(1 - modulus2)))
        measured = np.mean(modulus2) if responsivity == "measured" else mean_e2
        return np.mean(e[:, 0]) / (2 - measured)

    x, step, factors = 1e-4 * R2, 1e-3, ellipticity_factors(mean_e2, responsivity)
    wide, tilted = np.eye(2) * x / 2, np.diag([x / 2, -x / 2])
    m = [(shear_of(step, q) - shear_of(-step, q)) / (2 * step) for q in (wide, 0 * wide)]
    assert (m[0] - m[1]) / 1e-4 == pytest.approx(factors[0], rel=1e-3)
    assert -shear_of(0.0, tilted) / 1e-4 == pytest.approx(factors[1], rel=1e-3)


def test_mean_of_g_and_measured_responsivity_hardly_differ():
    of_g, measured = (ellipticity_factors(0.16, name) for name in ("g", "measured"))
    np.testing.assert_allclose(measured, of_g, rtol=0.16**2 / 6)


def test_bad_input_is_named(moments):
    found = gaussian_response(Galaxies.of(R2))
    with pytest.raises(InputError, match="n_stars: must be at least 1, got 0"):
        deconvolution_bias(moments, found, 0)
    with pytest.raises(ValueError, match="responsivity must be one of measured, fixed, g, got x"):
        gaussian_response(Galaxies.of(R2), "x")
    for name, bias, covariance in (
        ("bias", np.zeros(3), NONE),
        ("covariance", np.zeros((3, 2)), np.zeros((3, 3))),
    ):
        with pytest.raises(ValueError, match=f"{name} must have the shape"):
            moments_bias(bias, covariance, shape(0, 0), Galaxies.of(R2))
