import galsim
import numpy as np
import pytest

from porrima.errors import InputError
from porrima.psf import PSF, psf_from_name
from porrima.shapes import Adaptive, Failure, GaussianWeight, Plain, Shape, estimator_from_name
from porrima.units import SIGMA_PER_FWHM

ESTIMATORS = [Plain(), Adaptive(), GaussianWeight(0.06), GaussianWeight(0.75)]
SIGMA = 0.137 * SIGMA_PER_FWHM
LOPSIDED = galsim.Sum(
    galsim.Gaussian(fwhm=0.12).shear(e1=0.1, e2=0.05) * 0.7,
    galsim.Gaussian(fwhm=0.2).shear(e1=-0.2, e2=0.1).shift(0.03, -0.01) * 0.3,
)
every_estimator = pytest.mark.parametrize("estimator", ESTIMATORS, ids=lambda e: e.name)


def measured(estimator, profile):
    return estimator.measure(PSF(name="test", profile=profile, extent=1.2).draw())


def second_moments(e1, e2):
    half = SIGMA**2 / np.sqrt(1 - e1**2 - e2**2)
    return half * np.array([[1 + e1, e2], [e2, 1 - e1]])


def assert_covariance(shape, expected, rtol=1e-11):
    np.testing.assert_allclose(
        shape.covariance(), expected[[0, 0, 1], [0, 1, 1]], atol=rtol * np.trace(expected), rtol=0
    )


@pytest.mark.parametrize("estimator", [Plain(), Adaptive()], ids=lambda e: e.name)
@pytest.mark.parametrize(
    ("name", "e"), [("psf0", (0, 0)), ("psf1", (0.054, -0.003)), ("psf2", (-0.021, 0.045))]
)
def test_plain_and_adaptive_moments_of_a_gaussian_are_its_own(estimator, name, e):
    shape = estimator.measure(psf_from_name(name).draw())
    assert_covariance(shape, second_moments(*e))
    assert shape.flag == 0


@pytest.mark.parametrize("sigma", [0.03, 0.06, 0.75])
def test_weighted_moments_of_a_gaussian_are_those_of_the_product_of_two(sigma):
    expected = np.linalg.inv(np.linalg.inv(second_moments(0.054, -0.003)) + np.eye(2) / sigma**2)
    assert_covariance(GaussianWeight(sigma).measure(psf_from_name("psf1").draw()), expected)


def test_adaptive_shape_is_that_of_hsm_to_its_float32_output():
    image = PSF(name="lopsided", profile=LOPSIDED, extent=1.2).draw()
    ours, hsm = Adaptive().measure(image), galsim.hsm.FindAdaptiveMom(image, precision=1e-10)
    r2 = 2 * (hsm.moments_sigma * image.scale) ** 2 / np.sqrt(1 - hsm.observed_shape.e**2)
    assert ours.e1 == pytest.approx(hsm.observed_shape.e1, abs=1e-7)
    assert ours.e2 == pytest.approx(hsm.observed_shape.e2, abs=1e-7)
    assert ours.r2 == pytest.approx(r2, rel=2.5e-7)


def test_adaptive_shape_goes_beyond_float32():
    # HSM's own sigma is a float32: this is why the answer is polished.
    image = psf_from_name("psf1").draw()
    raw = galsim.hsm.FindAdaptiveMom(image, precision=1e-10).moments_sigma
    assert np.float64(np.float32(raw)) == raw
    truth = 2 * SIGMA**2 / np.sqrt(1 - 0.054**2 - 0.003**2)
    assert Adaptive().measure(image).r2 == pytest.approx(truth, rel=1e-12)


@every_estimator
def test_turning_the_profile_by_45_degrees_turns_e1_into_e2(estimator):
    before = measured(estimator, LOPSIDED)
    after = measured(estimator, LOPSIDED.rotate(45 * galsim.degrees))
    np.testing.assert_allclose([after.e1, after.e2], [-before.e2, before.e1], atol=1e-10)
    assert after.r2 == pytest.approx(before.r2, rel=1e-10)


@every_estimator
def test_shape_does_not_depend_on_where_the_profile_lies_or_on_its_flux(estimator):
    here, there = measured(estimator, LOPSIDED), measured(estimator, 3.7 * LOPSIDED.shift(0.0123, -0.0211))
    np.testing.assert_allclose(there.covariance(), here.covariance(), atol=1e-11 * here.r2)


@pytest.mark.parametrize("estimator", [Plain(), Adaptive()], ids=lambda e: e.name)
def test_shape_scales_with_the_profile(estimator):
    small, large = measured(estimator, LOPSIDED), measured(estimator, LOPSIDED.dilate(1.3))
    assert large.r2 == pytest.approx(1.69 * small.r2, rel=1e-10)
    assert large.e1 == pytest.approx(float(small.e1), abs=1e-10)


@every_estimator
def test_an_image_of_nothing_is_flagged(estimator):
    shape = estimator.measure(galsim.ImageD(np.zeros((31, 31)), scale=0.01))
    assert shape.flag == Failure.NO_FLUX
    assert np.isnan(shape.covariance()).all()


@every_estimator
def test_an_image_with_a_bad_pixel_is_flagged(estimator):
    image = psf_from_name("psf0").draw()
    image.array[3, 4] = np.nan
    shape = estimator.measure(image)
    assert shape.flag == Failure.NOT_FINITE
    assert np.isnan([shape.e1, shape.e2, shape.r2]).all()


def test_a_single_bright_pixel_has_no_adaptive_shape():
    image = galsim.ImageD(np.zeros((41, 41)), scale=0.01)
    image.array[20, 20] = 1.0
    shape = Adaptive().measure(image)
    assert shape.flag & (Failure.NOT_CONVERGED | Failure.NOT_POSITIVE)
    assert np.isnan(shape.r2)


def test_two_equal_stars_far_apart_have_no_centre_under_a_narrow_weight():
    star = galsim.Gaussian(fwhm=0.1)
    shape = measured(GaussianWeight(0.05), galsim.Sum(star.shift(-0.3, 0), star.shift(0.3, 0)))
    assert shape.flag == Failure.NOT_CONVERGED
    assert np.isnan(shape.e1)


def test_a_negative_size_is_flagged_and_not_returned():
    shape = Shape.from_covariance(np.array([[2.0, 0.1, 1.0], [1.0, 2.0, 1.0], [-1.0, 0.0, -1.0]]))
    np.testing.assert_array_equal(shape.flag, [0, Failure.NOT_POSITIVE, Failure.NOT_POSITIVE])
    np.testing.assert_array_equal(np.isnan(shape.r2), [False, True, True])


def test_covariance_and_shape_are_two_ways_to_say_the_same():
    covariance = np.array([[2.0, 0.1, 1.0], [1.0, -0.3, 1.5]])
    np.testing.assert_allclose(Shape.from_covariance(covariance).covariance(), covariance, rtol=1e-15)


@pytest.mark.parametrize("name", ["adaptive", "plain", "gaussian:0.75"])
def test_estimators_are_found_by_name(name):
    assert estimator_from_name(name).name == name
    assert estimator_from_name(name) == estimator_from_name(name)


@pytest.mark.parametrize(
    ("name", "rule"),
    [
        ("moments", "estimator: must be one of adaptive, plain, plain:R, gaussian:S, got moments"),
        ("gaussian", "estimator: must be one of adaptive, plain, plain:R, gaussian:S, got gaussian"),
        ("gaussian:wide", "S of gaussian:S must be a number of arcsec, at least 0.02, got gaussian:wide"),
        ("gaussian:-1", "at least 0.02, got gaussian:-1"),
        ("plain:0", "R of plain:R must be a number of arcsec, at least 0.1, got plain:0"),
        ("gaussian:nan", "at least 0.02, got gaussian:nan"),
    ],
)
def test_wrong_estimator_names_are_answered_with_the_rule(name, rule):
    with pytest.raises(InputError, match=rule):
        estimator_from_name(name)
