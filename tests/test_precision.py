"""Noise of the shape of a star: the influence of a pixel, and the limits of the formula."""

from dataclasses import replace

import numpy as np
import pytest

from porrima.exposure import EUCLID_VIS_WIDE
from porrima.precision import fitted_noise, influence, measured_noise
from porrima.psf import psf_from_name
from porrima.shapes import Adaptive, GaussianWeight, Plain
from porrima.stamps import measure_stamps


@pytest.mark.parametrize("estimator", [Adaptive(), GaussianWeight(0.1), Plain(0.3)], ids=lambda e: e.name)
def test_the_influence_is_what_a_changed_pixel_does(estimator):
    image = (
        psf_from_name("psf1")
        .profile.shift(0.01, -0.02)
        .drawImage(nx=31, ny=31, scale=0.03, dtype=float)
        .array
    )
    found = influence(image, 0.03, estimator)
    for row, column in [(15, 15), (13, 18), (20, 12)]:
        shapes = []
        for change in (1e-5, -1e-5):
            changed = image.copy()
            changed[row, column] += change
            shape = measure_stamps(changed[None], 0.03, estimator).shape
            shapes.append(np.array([shape.e1[0], shape.e2[0], shape.r2[0]]))
        r2 = shapes[0][2]
        slope = (shapes[0] - shapes[1]) / 2e-5 / [1, 1, r2]
        assert np.allclose(found[:, row, column], slope, rtol=1e-3, atol=1e-3)


def test_noise_falls_with_flux_and_with_exposures():
    psf = psf_from_name("optical1", pixel=0.1, jitter=0.029)
    four = fitted_noise(psf, EUCLID_VIS_WIDE, 0.009)
    alone = fitted_noise(psf, replace(EUCLID_VIS_WIDE, n_exposures=1), 0.009)
    assert alone.sigma_r2(20.0) / four.sigma_r2(20.0) == pytest.approx(2, rel=0.05)
    assert four.sigma_e(14.5) / four.sigma_e(12.0) == pytest.approx(10**0.5, rel=0.02)
    assert four.sigma_e(28.0) / four.sigma_e(27.0) == pytest.approx(10**0.4, rel=0.03)


def test_the_fit_of_a_gaussian_reaches_its_fisher_information():
    """Bright star behind a well sampled round Gaussian: 2 sigma^4 / F for each second moment."""
    psf = psf_from_name("psf0", pixel=0.001)
    exposures = replace(EUCLID_VIS_WIDE, pixel=0.03, n_exposures=1, sky=0.0, dark=0.0, read_noise=0.01)
    sigma2 = (0.137 / 2.35482) ** 2
    noise = fitted_noise(psf, exposures, 2 * sigma2)
    flux = exposures.electrons(14.0)
    assert noise.sigma_r2(14.0) == pytest.approx(np.sqrt(1 / flux), rel=0.02)
    assert noise.sigma_e(14.0) == pytest.approx(np.sqrt(1 / flux), rel=0.02)


def test_an_estimator_is_never_better_than_the_fit():
    psf = psf_from_name("psf0", pixel=0.05)
    exposures = replace(EUCLID_VIS_WIDE, pixel=0.05, n_exposures=1)
    fit = fitted_noise(psf, exposures, 2 * (psf.fwhm / 2.35482) ** 2)
    for magnitude in (16.0, 20.0, 23.0):
        assert measured_noise(psf, exposures, Adaptive()).sigma_r2(magnitude) > 0.95 * fit.sigma_r2(magnitude)


def test_adaptive_weights_that_collapse_are_refused():
    psf = psf_from_name("optical1", pixel=0.1, jitter=0.029)
    with pytest.raises(ValueError, match="image must be one that adaptive measures"):
        measured_noise(psf, EUCLID_VIS_WIDE, Adaptive())
