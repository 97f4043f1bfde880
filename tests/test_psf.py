import dataclasses

import galsim
import numpy as np
import pytest

from porrima.errors import InputError
from porrima.psf import GSPARAMS, PSF, PSFS, psf_from_name
from porrima.units import SIGMA_PER_FWHM

TABLE_2 = {"psf0": (0.0, 0.0), "psf1": (0.054, -0.003), "psf2": (-0.021, 0.045)}


def gaussian(e1, e2, x, y, fwhm=0.137):
    """A Gaussian of distortion (e1, e2) and unchanged area, written out."""
    half = (fwhm * SIGMA_PER_FWHM) ** 2 / np.sqrt(1 - e1**2 - e2**2)
    q = half * np.array([[1 + e1, e2], [e2, 1 - e1]])
    p = np.linalg.inv(q)
    exponent = p[0, 0] * x**2 + 2 * p[0, 1] * x * y + p[1, 1] * y**2
    return np.exp(-exponent / 2) / (2 * np.pi * np.sqrt(np.linalg.det(q)))


def grid(image):
    ny, nx = image.array.shape
    return np.meshgrid(
        (np.arange(nx) - (nx - 1) / 2) * image.scale, (np.arange(ny) - (ny - 1) / 2) * image.scale
    )


@pytest.mark.parametrize("name", PSFS)
def test_presets_are_the_gaussians_of_table_2(name):
    image = psf_from_name(name).draw()
    x, y = grid(image)
    expected = gaussian(*TABLE_2[name], x, y) * image.scale**2
    assert image.array.dtype == np.float64
    np.testing.assert_allclose(image.array, expected, atol=1e-12 * expected.max(), rtol=0)


@pytest.mark.parametrize("name", PSFS)
def test_presets_have_the_size_and_distortion_of_table_2(name):
    image = psf_from_name(name).draw()
    x, y = grid(image)
    q11, q12, q22 = (np.sum(image.array * v) for v in (x * x, x * y, y * y))
    e1, e2 = TABLE_2[name]
    r2 = 2 * (0.137 * SIGMA_PER_FWHM) ** 2 / np.sqrt(1 - e1**2 - e2**2)
    np.testing.assert_allclose([q11 + q22, q11 - q22, 2 * q12], [r2, e1 * r2, e2 * r2], atol=1e-12 * r2)
    assert image.array.sum() == pytest.approx(1, abs=1e-13)


def test_r2_of_psf1_is_that_of_the_facts():
    image = psf_from_name("psf1").draw()
    x, y = grid(image)
    assert np.sum(image.array * (x**2 + y**2)) == pytest.approx(6.7794e-3, abs=5e-8)


def test_accuracy_parameters_change_no_preset():
    psf = dataclasses.replace(psf_from_name("psf2"), extent=0.8)
    loose = dataclasses.replace(psf, profile=psf.profile.withGSParams(galsim.GSParams()))
    tight = dataclasses.replace(
        psf, profile=psf.profile.withGSParams(GSPARAMS.withParams(folding_threshold=1e-12))
    )
    np.testing.assert_allclose(loose.draw().array, tight.draw().array, rtol=0, atol=1e-16)


def test_nothing_of_a_gaussian_is_left_at_the_edge_of_its_stamp():
    image = psf_from_name("psf1").draw().array
    assert max(image[0].max(), image[:, 0].max()) < 1e-30


def test_grid_follows_a_narrow_psf_and_never_gets_coarser_than_a_twelfth_of_a_vis_pixel():
    narrow = PSF(name="narrow", profile=galsim.Gaussian(fwhm=0.05))
    wide = PSF(name="wide", profile=galsim.Gaussian(fwhm=0.7))
    assert narrow.scale == pytest.approx(0.05 / 16, rel=2e-3)
    assert wide.scale == pytest.approx(0.1 / 12)


def test_stamp_is_centred_on_the_origin_of_the_profile_and_obeys_extent_and_margin():
    psf = PSF(name="off", profile=galsim.Gaussian(fwhm=0.137).shift(0.02, -0.01), extent=0.9)
    image = psf.draw()
    x, y = grid(image)
    assert np.sum(image.array * x) == pytest.approx(0.02, abs=1e-12)
    assert np.sum(image.array * y) == pytest.approx(-0.01, abs=1e-12)
    assert x.max() == pytest.approx(0.9, abs=psf.scale / 2)
    assert grid(psf.draw(margin=0.1))[0].max() == pytest.approx(1.0, abs=psf.scale / 2)


def test_equal_names_give_equal_psfs_that_cannot_be_changed():
    assert psf_from_name("psf1") == psf_from_name("psf1")
    assert hash(psf_from_name("psf1")) == hash(psf_from_name("psf1"))
    assert psf_from_name("psf1") != psf_from_name("psf2")
    with pytest.raises(dataclasses.FrozenInstanceError):
        psf_from_name("psf1").name = "mine"


def test_unknown_name_is_answered_with_the_known_ones_and_the_nearest():
    with pytest.raises(
        InputError, match=r"psf: must be one of psf0, psf1, psf2 .*nearest: psf1\), got psf1x"
    ):
        psf_from_name("psf1x")
