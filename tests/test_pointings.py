"""Sources on the pixels of exposures: against GalSim's own drawing, and rolled."""

from dataclasses import replace

import numpy as np
import pytest

from porrima.pointings import dither_pattern, pointings
from porrima.psf import psf_from_name


@pytest.fixture(scope="module")
def psf():
    return psf_from_name("optical1", pixel=0.1, jitter=0.029)


@pytest.fixture(scope="module")
def star(psf):
    return pointings(psf, 0.1, dither_pattern(3))


def test_stamps_are_what_galsim_draws(psf, star):
    found = star.images(np.array([0.12]), np.array([-0.07])).reshape(3, star.side, star.side)
    for image, place in zip(found, star.place, strict=True):
        shifted = psf.profile.shift(*(0.1 * place + (0.12, -0.07)))
        drawn = shifted.drawImage(nx=star.side, ny=star.side, scale=0.1, method="no_pixel", dtype=float)
        assert np.abs(image - drawn.array).max() < 1e-5 * image.max()


def test_a_roll_turns_the_sky_on_the_detector(star):
    rolled = replace(star, roll=np.full(3, 0.5 * np.pi))
    assert np.allclose(rolled.images(0.1, 0.05), star.images(0.05, -0.1), atol=1e-12)


def test_derivatives_are_differences_of_images(star):
    templates = star.derivatives()
    h = 0.01
    left, right = star.images(np.array([-h, h]), np.zeros(2))
    assert np.allclose((right - left) / (2 * h), templates[1], atol=0.01 * np.abs(templates[1]).max())
    second = (right - 2 * templates[0] + left) / h**2
    assert np.allclose(second, templates[3], atol=0.02 * np.abs(templates[3]).max())


def test_dithers_cover_the_pixel():
    places = np.concatenate([dither_pattern(4, k) for k in range(64)])
    assert np.all((places >= -0.5) & (places < 0.5))
    counts = np.histogram2d(*places.T, bins=4, range=[[-0.5, 0.5]] * 2)[0]
    assert counts.min() >= 12
    assert counts.max() <= 20
