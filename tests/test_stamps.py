import galsim
import numpy as np
import pytest

from porrima.psf import PSF, psf_from_name
from porrima.shapes import Adaptive, Failure, GaussianWeight, Plain
from porrima.stamps import measure_stamps

LOPSIDED = galsim.Sum(
    galsim.Gaussian(fwhm=0.12).shear(e1=0.1, e2=0.05) * 0.7,
    galsim.Gaussian(fwhm=0.2).shear(e1=-0.2, e2=0.1).shift(0.03, -0.01) * 0.3,
)
ESTIMATORS = [Plain(), Plain(0.3), Adaptive(), GaussianWeight(0.06), GaussianWeight(0.75)]
every_estimator = pytest.mark.parametrize("estimator", ESTIMATORS, ids=lambda e: e.name)


def drawn(profile, scale, size):
    return profile.drawImage(nx=size, ny=size, scale=scale, method="no_pixel", dtype=float)


def noisy_stars(n, scale, noise, seed=5):
    rng = np.random.Generator(np.random.Philox(seed))
    profile = galsim.Convolve(LOPSIDED, galsim.Pixel(0.1))
    places = rng.uniform(-0.5, 0.5, (n, 2)) * scale
    images = [drawn(profile.shift(x, y), scale, 41) for x, y in places.tolist()]
    for image in images:
        image.array[:] += rng.normal(0, noise, image.array.shape)
    return images


@every_estimator
def test_a_stamp_has_the_shape_that_the_estimator_gives_it_alone(estimator):
    image = PSF(name="lopsided", profile=LOPSIDED, extent=1.2).draw()
    found, alone = measure_stamps(image.array[None], image.scale, estimator).shape, estimator.measure(image)
    np.testing.assert_allclose(found.covariance()[0], alone.covariance(), rtol=0, atol=2e-12 * alone.r2)


@every_estimator
def test_centroid_moves_with_the_star(estimator):
    images = np.stack([drawn(LOPSIDED.shift(x, -2 * x), 0.01, 241).array for x in (0.0, 0.013)])
    found = measure_stamps(images, 0.01, estimator)
    np.testing.assert_allclose(np.diff(found.x), 0.013, atol=1e-11)
    np.testing.assert_allclose(np.diff(found.y), -0.026, atol=1e-11)


@pytest.mark.parametrize("noise", [0.0, 0.001, 0.01], ids=["clean", "noisy", "noisier"])
def test_adaptive_moments_of_survey_pixels_are_those_of_hsm_and_fail_where_it_fails(noise):
    images = noisy_stars(40, 0.1, noise)
    shape = measure_stamps(np.stack([i.array for i in images]), 0.1, Adaptive(), guess_sigma=0.12).shape
    limits = galsim.hsm.HSMParams(convergence_threshold=1e-10, max_amoment=41.0**2, max_ashift=20.5)
    for k, image in enumerate(images):
        hsm = galsim.hsm.FindAdaptiveMom(
            image, guess_sig=1.2, precision=1e-10, hsmparams=limits, strict=False
        )
        assert bool(hsm.error_message) == bool(shape.flag[k])
        if not shape.flag[k]:
            sigma = np.sqrt(shape.r2[k] / 2 * np.sqrt(1 - shape.e1[k] ** 2 - shape.e2[k] ** 2)) / 0.1
            ours = [shape.e1[k], shape.e2[k], sigma / hsm.moments_sigma]
            np.testing.assert_allclose(ours, [hsm.observed_shape.e1, hsm.observed_shape.e2, 1], atol=2e-7)


def test_a_star_smaller_than_its_pixel_collapses_and_is_flagged():
    image = drawn(galsim.Gaussian(sigma=0.02), 0.1, 21)
    assert galsim.hsm.FindAdaptiveMom(image, guess_sig=1.0, strict=False).error_message
    shape = measure_stamps(image.array[None], 0.1, Adaptive()).shape
    assert shape.flag[0] == Failure.NOT_POSITIVE
    assert np.isnan(shape.r2[0])


def test_failures_are_flagged_one_by_one_and_spoil_no_other_stamp():
    good = psf_from_name("psf1").draw().array
    bad = good.copy()
    bad[3, 4] = np.nan
    scale = psf_from_name("psf1").scale
    for estimator in ESTIMATORS:
        shape = measure_stamps(np.stack([good, bad, 0 * good, good]), scale, estimator).shape
        np.testing.assert_array_equal(shape.flag, [0, Failure.NOT_FINITE, Failure.NO_FLUX, 0])
        assert shape.r2[0] == shape.r2[3]
        assert np.isnan(shape.r2[1:3]).all()


def test_two_equal_stars_far_apart_have_no_centre_under_a_narrow_weight():
    star = galsim.Gaussian(fwhm=0.1)
    image = drawn(galsim.Sum(star.shift(-0.3, 0), star.shift(0.3, 0)), 0.01, 161)
    shape = measure_stamps(image.array[None], 0.01, GaussianWeight(0.05)).shape
    assert shape.flag[0] == Failure.NOT_CONVERGED


def test_a_narrow_weight_climbs_to_the_brighter_of_two_stars():
    star = galsim.Gaussian(fwhm=0.1)
    image = drawn(galsim.Sum(star.shift(-0.15, 0) * 0.7, star.shift(0.15, 0) * 0.3), 0.01, 161)
    found = measure_stamps(image.array[None], 0.01, GaussianWeight(0.05))
    assert found.shape.flag[0] == 0
    assert found.x[0] == pytest.approx(-0.15, abs=0.01)
    alone = GaussianWeight(0.05).measure(image)
    assert found.shape.r2[0] == pytest.approx(float(alone.r2), rel=1e-11)


def test_same_stamp_has_the_same_bits_in_any_batch():
    images = np.stack([i.array for i in noisy_stars(9, 0.05, 0.0005)])
    together = measure_stamps(images, 0.05, Adaptive()).shape
    alone = [measure_stamps(image[None], 0.05, Adaptive()).shape.r2[0] for image in images]
    np.testing.assert_array_equal(together.r2, alone)


def test_wrong_arguments_are_refused():
    with pytest.raises(ValueError, match=r"images must have shape \(n, ny, nx\), got \(5, 5\)"):
        measure_stamps(np.ones((5, 5)), 0.1, Adaptive())
    with pytest.raises(TypeError, match="got str"):
        measure_stamps(np.ones((1, 5, 5)), 0.1, "adaptive")
