from dataclasses import replace

import galsim
import numpy as np
import pytest

from porrima.correction import Patch, change_behind, correct, like, residual_shear, shear_covariance
from porrima.galaxies import Galaxies
from porrima.multiplicity import MULTIPLICITY
from porrima.photometry import PHOTOMETRY
from porrima.prediction import integrate, population_moments, predict
from porrima.psf import psf_from_name, sheared_gaussian
from porrima.response import response
from porrima.shapes import Adaptive, Plain
from porrima.shear import gaussian_response, moments_bias
from porrima.systems import Population
from porrima.uncertainty import NAMES, uncertainty

MODELS = {"multiplicity": MULTIPLICITY["dk13"], "photometry": PHOTOMETRY["main-sequence"]}
N_STARS = 500
NONE = np.zeros(3)


@pytest.fixture(scope="module")
def moments(stars):
    population = Population.of(stars, **MODELS)
    return population_moments(population, integrate(population))


@pytest.fixture(scope="module")
def reply():
    return response(psf_from_name("psf1"), Adaptive())


@pytest.fixture(scope="module")
def known(stars, reply):
    return uncertainty(stars, reply, n_stars=N_STARS, **MODELS)


def true_and_measured(moments, psf, estimator, n_stars=N_STARS):
    """A PSF without companions, and its mean with them."""
    reply = response(psf, estimator)
    true = np.array([float(v) for v in (reply.shape0.e1, reply.shape0.e2, reply.shape0.r2)])
    return true, true + predict(moments, reply, n_stars).bias[:, 0] * [1.0, 1.0, true[2]]


def test_the_mean_of_stacks_corrected_is_the_psf(moments, known, reply):
    true, measured = true_and_measured(moments, psf_from_name("psf1"), Adaptive())
    change = change_behind(moments, [reply], N_STARS)
    found = correct(Patch(shape=measured, n_stars=N_STARS, error=NONE), known, change)
    assert found.corrected == pytest.approx(true, abs=1e-9)
    assert found.bias == pytest.approx(measured - true, abs=1e-9)


def test_with_plain_moments_the_change_behind_one_psf_is_that_behind_any(moments):
    change = change_behind(moments, like(psf_from_name("psf1"), Plain()), N_STARS)
    for other in (sheared_gaussian("wide", -0.1, 0.07, 0.16), sheared_gaussian("round", 0.0, 0.0, 0.11)):
        true, measured = true_and_measured(moments, other, Plain())
        left = change.taken_off(measured) - true
        assert np.abs(left[:2]).max() < 2e-3 * np.abs(measured - true)[2] / true[2]
        assert abs(left[2]) < 1e-6 * abs(measured - true)[2]


@pytest.mark.parametrize("name", ["psf1", "optical1"])
def test_the_change_behind_a_psf_alike_is_found_from_three_others(moments, name):
    psf = psf_from_name(name)
    change = change_behind(moments, like(psf, Adaptive()), N_STARS)
    profile = psf.profile.shear(galsim.Shear(g1=-0.02, g2=0.03)).dilate(1.04)
    other = replace(psf, name=f"{name} changed", profile=profile, grid=psf.scale)
    true, measured = true_and_measured(moments, other, Adaptive())
    left = change.taken_off(measured) - true
    one_for_all = change_behind(moments, like(psf, Adaptive())[:1], N_STARS).taken_off(measured) - true
    assert abs(left[2]) < 2e-3 * abs(measured - true)[2]
    assert np.abs(left[:2]).max() < 5e-3 * abs(measured - true)[2] / true[2]
    assert np.abs(left[:2]).max() < np.abs(one_for_all[:2]).max()


def test_errors_are_those_of_the_uncertainty_the_scatter_and_the_measurement(moments, known, reply):
    true, measured = true_and_measured(moments, psf_from_name("psf1"), Adaptive())
    change = change_behind(moments, [reply], N_STARS)
    error = np.array([1e-4, 2e-4, 3e-6])
    found, without = (
        correct(Patch(shape=measured, n_stars=N_STARS, error=e), known, change) for e in (error, NONE)
    )
    k = NAMES.index("bias_r2")
    low, high = known.interval("bias_r2")
    ends = without.model_error()[:, 2] + without.choice_shift()[:, 2]  # as `uncertainty` has them: no scatter
    assert ends == pytest.approx((np.array([low, high]) - known.value[k]) * true[2], rel=1e-3)
    assert found.error() ** 2 - without.error() ** 2 == pytest.approx(np.tile(error**2, (2, 1)), rel=1e-6)
    scatter = predict(moments, reply, N_STARS).sd[:, 0] * [1.0, 1.0, true[2]]
    assert np.all(found.scatter > scatter)  # the model's errors make stacks differ more in the mean
    assert found.scatter == pytest.approx(scatter, rel=0.2)


def test_the_interval_is_that_of_the_true_shape(moments, known, reply):
    """Where companions may do more than predicted, the true PSF is smaller than the corrected one."""
    _, measured = true_and_measured(moments, psf_from_name("psf1"), Adaptive())
    found = correct(
        Patch(shape=measured, n_stars=N_STARS, error=NONE), known, change_behind(moments, [reply], N_STARS)
    )
    (low, high), (down, up) = found.interval(), found.error() + found.choice_shift()
    assert low == pytest.approx(found.corrected - up)
    assert high == pytest.approx(found.corrected - down)
    narrow = found.interval(choices=False)
    assert np.all(narrow[0] >= low - 1e-15)
    assert np.all(narrow[1] <= high + 1e-15)
    twice = found.interval(2.0, choices=False)
    assert twice[1] - found.corrected == pytest.approx(2 * (narrow[1] - found.corrected))


def test_without_companions_nothing_is_taken_off(stars, reply):
    known = uncertainty(stars, reply, n_stars=N_STARS, binary_fraction=0.0, **MODELS)
    change = change_behind(known.prediction.population, [reply], N_STARS)
    shape = np.array([0.05, 0.0, 6.8e-3])
    found = correct(Patch(shape=shape, n_stars=N_STARS, error=NONE), known, change)
    assert found.corrected == pytest.approx(shape, abs=1e-12)
    assert found.error() == pytest.approx(np.zeros((2, 3)), abs=1e-12)


def test_what_is_left_of_m_is_in_proportion_to_what_is_left_of_the_size(moments, known, reply):
    _, measured = true_and_measured(moments, psf_from_name("psf1"), Adaptive())
    found = correct(
        Patch(shape=measured, n_stars=N_STARS, error=NONE), known, change_behind(moments, [reply], N_STARS)
    )
    prediction = predict(moments, reply, N_STARS)
    galaxies = Galaxies.of(0.1)
    for method in (galaxies, gaussian_response(galaxies)):
        left = residual_shear(found, prediction, reply, method)
        assert left.bias[0] > 0
        assert left.model[1, 0] / left.bias[0] == pytest.approx(
            found.model_error()[1, 2] / found.bias[2], rel=1e-9
        )
        assert np.all(left.measurement == 0)
        assert left.error[1, 0] == pytest.approx(np.hypot(left.model[1, 0], left.scatter[0]))
        assert np.all(left.error[1, 1:] < 1.01 * left.scatter[1:])  # c is random alone


def test_an_error_of_the_measured_size_is_an_m_of_its_own(reply):
    """Gaussian galaxies: m = δR²/R_gal², and an error of the ellipticity makes c = -δe R²/(2 R_gal²)."""
    galaxies, r2 = Galaxies.of(0.1, mean_e2=0.0), float(reply.shape0.r2)
    plain = response(psf_from_name("psf0"), Plain())
    covariance = np.diag([1e-8, 4e-8, 1e-6])
    expected = np.array([1e-3, 0.5e-4, 1e-4]) * r2 / 0.1
    for method in (galaxies, gaussian_response(galaxies)):
        found = np.sqrt(np.diag(shear_covariance(covariance, plain, method)))
        assert found == pytest.approx(expected * float(plain.shape0.r2) / r2, rel=1e-3)
    given = moments_bias(np.zeros((3, 1)), covariance[None], plain.shape0, galaxies).covariance[0]
    assert shear_covariance(covariance, plain, galaxies) == pytest.approx(given)
