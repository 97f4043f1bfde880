import galsim
import numpy as np
import pytest

from porrima.sampling import Blur, convolved, fwhm_of, interpolated, sampled, upsampled

TIGHT = galsim.GSParams(
    folding_threshold=1e-8, maxk_threshold=1e-8, xvalue_accuracy=1e-12, kvalue_accuracy=1e-12
)
GAUSSIAN = galsim.Gaussian(sigma=0.06, gsparams=TIGHT)


def test_a_gaussian_stays_a_gaussian():
    image = sampled(GAUSSIAN, 0.005, 0.8, Blur(sigma=0.08))
    wider = galsim.Gaussian(sigma=0.1, gsparams=TIGHT)
    n = image.array.shape[0]
    expected = wider.drawImage(nx=n, ny=n, scale=0.005, method="no_pixel", dtype=float).array
    np.testing.assert_allclose(image.array, expected, rtol=0, atol=5e-7 * expected.max())


def test_a_pixel_averages():
    image = convolved(sampled(GAUSSIAN, 0.005, 0.8), Blur(pixel=0.1))
    expected = galsim.Convolve(GAUSSIAN, galsim.Pixel(0.1, gsparams=TIGHT), gsparams=TIGHT)
    n = image.array.shape[0]
    drawn = expected.drawImage(nx=n, ny=n, scale=0.005, method="no_pixel", dtype=float).array
    np.testing.assert_allclose(image.array, drawn, rtol=0, atol=1e-7 * drawn.max())


def test_nothing_comes_back_at_the_other_edge():
    image = galsim.ImageD(np.zeros((101, 101)), scale=0.01)
    image.array[50, 100] = 1.0
    blurred = convolved(image, Blur(pixel=0.1, sigma=0.02)).array
    assert np.abs(blurred[:, :30]).max() < 1e-4 * blurred.max()
    assert np.unravel_index(np.argmax(blurred), blurred.shape)[0] == 50


def test_samples_of_a_profile_are_kept_when_it_is_smooth():
    image = sampled(GAUSSIAN, 0.01, 1.6)
    n = image.array.shape[0]
    expected = GAUSSIAN.drawImage(nx=n, ny=n, scale=0.01, method="no_pixel", dtype=float).array
    np.testing.assert_allclose(image.array, expected, rtol=0, atol=5e-7 * expected.max())


def test_kinks_of_an_interpolated_image_are_smoothed_and_nothing_else():
    coarse = galsim.Image(
        GAUSSIAN.drawImage(nx=41, ny=41, scale=0.1, method="no_pixel", dtype=float).array, scale=0.1
    )
    kinky = galsim.InterpolatedImage(coarse, x_interpolant="quintic")

    def r2(image):
        x = (np.arange(len(image.array)) - len(image.array) // 2) * image.scale
        weight = np.exp(-(x**2) / 2 / 0.08**2)
        flux = image.array * weight * weight[:, None]
        return 2 * np.sum(flux * x**2) / flux.sum()

    fine = kinky.drawImage(nx=1601, ny=1601, scale=0.001, method="no_pixel", dtype=float)
    bare = kinky.drawImage(nx=193, ny=193, scale=0.1 / 12, method="no_pixel", dtype=float)
    smooth = sampled(kinky, 0.1 / 12, 0.8)
    assert abs(r2(smooth) / r2(fine) - 1) < abs(r2(bare) / r2(fine) - 1) / 5


def test_a_profile_that_needs_an_fft_is_drawn_by_one():
    both = galsim.Convolve(galsim.Gaussian(sigma=0.03), galsim.Gaussian(sigma=0.04))
    image = sampled(both, 0.005, 0.6)
    n = image.array.shape[0]
    expected = galsim.Gaussian(sigma=0.05).drawImage(nx=n, ny=n, scale=0.005, method="no_pixel", dtype=float)
    np.testing.assert_allclose(image.array, expected.array, rtol=0, atol=1e-5 * expected.array.max())


def test_upsampling_finds_a_band_limited_function_between_its_samples():
    def wave(x, y):
        return 1 + np.cos(2 * np.pi * (3 * x + y) / 32) + np.sin(2 * np.pi * 5 * y / 32)

    x = np.arange(32) - 16
    fine = upsampled(wave(x, x[:, None]), 4)
    reach = 15 * 4
    at = np.arange(-reach, reach + 1) / 4
    np.testing.assert_allclose(fine, wave(at, at[:, None]), atol=1e-12)


@pytest.mark.parametrize(
    "profile",
    [
        galsim.Gaussian(fwhm=0.13),
        galsim.Gaussian(fwhm=0.13).rotate(0.3 * galsim.radians),
        galsim.Moffat(3, fwhm=0.13),
    ],
    ids=["round", "turned", "Moffat"],
)
def test_fwhm_of_analytic_profiles(profile):
    assert fwhm_of(profile) == pytest.approx(0.13, rel=2e-3)


def test_interpolated_profile_goes_through_its_samples():
    image = sampled(GAUSSIAN, 0.01, 0.5)
    profile = interpolated(image.array, 0.01)
    n = image.array.shape[0]
    drawn = profile.drawImage(nx=n, ny=n, scale=0.01, method="no_pixel", dtype=float).array
    np.testing.assert_allclose(drawn, image.array / image.array.sum(), rtol=0, atol=1e-14)
