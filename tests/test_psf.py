import dataclasses

import galsim
import numpy as np
import pytest

from porrima.errors import InputError
from porrima.psf import EXTENT_PER_FWHM, GSPARAMS, OPTICAL, PSF, PSFS, psf_from_name
from porrima.shapes import Adaptive
from porrima.spectra import Light
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
        InputError, match=r"psf: must be one of psf0, psf1, psf2, optical0.*nearest: psf1\), got psf1x"
    ):
        psf_from_name("psf1x")


SHAPES = {"optical0": "psf0", "optical1": "psf1", "optical2": "psf2", "optical1-rotated": "psf1"}


def measured(psf, **options):
    shape = Adaptive().measure(psf.draw(**options))
    assert shape.flag == 0
    return np.array([shape.e1, shape.e2, shape.r2])


@pytest.mark.parametrize("name", OPTICAL)
def test_optical_presets_have_the_adaptive_distortion_of_table_2(name):
    e1, e2, r2 = measured(psf_from_name(name))
    assert (e1, e2) == pytest.approx(TABLE_2[SHAPES[name]], abs=1e-12)
    documented = {"psf0": 5.5316e-3, "psf1": 5.5397e-3, "psf2": 5.5384e-3}
    assert r2 == pytest.approx(documented[SHAPES[name]], abs=5e-8)
    assert psf_from_name(name).fwhm == pytest.approx(0.133, abs=5e-4)


def test_turning_the_struts_turns_the_spikes_and_keeps_the_shape():
    straight, turned = (psf_from_name(name).draw(reach=3) for name in ("optical1", "optical1-rotated"))
    np.testing.assert_allclose(
        measured(psf_from_name("optical1")), measured(psf_from_name("optical1-rotated")), rtol=1e-12
    )
    spike = straight.true_center.x, straight.true_center.y + 2.5 / straight.scale
    row, column = round(spike[1]) - 1, round(spike[0]) - 1
    along = [image.array[row - 8 : row + 9, column - 8 : column + 9].sum() for image in (straight, turned)]
    assert max(along) > 1.5 * min(along)


def test_a_pixel_is_what_galsim_convolves_with():
    for name in ("psf0", "psf2"):
        given = psf_from_name(name)
        exact = galsim.Convolve(given.profile, galsim.Pixel(0.1, gsparams=GSPARAMS), gsparams=GSPARAMS)
        ours = psf_from_name(name, pixel=0.1)
        expected = ours.draw(exact)
        np.testing.assert_allclose(
            ours.draw().array, expected.array, rtol=0, atol=5e-7 * expected.array.max()
        )
        assert ours.name == f"{name}, pixel 0.1"


def test_jitter_and_diffusion_add_in_quadrature_to_a_gaussian():
    e1, e2, r2 = measured(psf_from_name("psf1", jitter=0.03, diffusion=0.04))
    q = psf_from_name("psf1").profile.original.sigma ** 2
    scale = q / np.sqrt(1 - 0.054**2 - 0.003**2)
    expected = 2 * scale + 2 * 0.05**2
    assert r2 == pytest.approx(expected, rel=5e-7)
    assert (e1, e2) == pytest.approx((0.054 * 2 * scale / expected, -0.003 * 2 * scale / expected), abs=5e-8)


@pytest.mark.parametrize("name", ["optical0", "roman:H158:SCA01"])
def test_pixel_and_jitter_of_a_diffraction_pattern_agree_with_galsims_fft(name):
    bare, ours = psf_from_name(name), psf_from_name(name, pixel=0.1, jitter=0.03)
    wide = galsim.InterpolatedImage(bare.draw(reach=6.5), x_interpolant="quintic")
    theirs = PSF(
        name="fft", profile=galsim.Convolve(wide, galsim.Pixel(0.1), galsim.Gaussian(sigma=0.03)), extent=0.8
    )
    image = theirs.profile.drawImage(nx=193, ny=193, scale=0.1 / 12, method="no_pixel", dtype=float)
    shape = Adaptive().measure(image)
    np.testing.assert_allclose(measured(ours)[:2], [shape.e1, shape.e2], atol=2e-5)
    assert measured(ours)[2] == pytest.approx(float(shape.r2), rel=5e-5)


def test_optical_psf_scales_with_its_wavelength():
    sizes = [measured(psf_from_name("optical0", light=Light.of(w)))[2] for w in (600.0, 900.0)]
    assert sizes[1] / sizes[0] == pytest.approx(2.25, rel=1e-6)


def test_a_wide_stamp_holds_what_a_wide_weight_reaches():
    psf = psf_from_name("optical0")
    assert psf.draw(reach=5.0).array.shape[0] * psf.scale == pytest.approx(10, rel=1e-2)
    assert psf.draw(reach=0.1).array.shape == psf.draw().array.shape
    assert psf.draw().array.shape[0] * psf.scale == pytest.approx(2 * EXTENT_PER_FWHM * psf.fwhm, rel=1e-2)


@pytest.mark.parametrize("name", ["optical1", "roman:J129:SCA07"])
def test_fwhm_is_the_width_of_the_disc_above_half_the_maximum(name):
    psf = psf_from_name(name)
    image = psf.profile.drawImage(nx=801, ny=801, scale=0.0005, method="no_pixel", dtype=float).array
    expected = 2 * np.sqrt((image > image.max() / 2).sum() / np.pi) * 0.0005
    assert psf.fwhm == pytest.approx(expected, rel=2e-3)


@pytest.mark.parametrize(
    ("name", "options", "message"),
    [
        ("psf0", {"pixel": -0.1}, "pixel: must be positive and finite [arcsec], got -0.1"),
        ("psf0", {"jitter": float("nan")}, "jitter: must be positive"),
        ("psf0", {"pixel_scale": 0.1}, "pixel_scale: is for FITS images only, got 0.1 for psf0"),
        ("optical0", {"subtract_background": True}, "subtract_background: is for FITS images only"),
        ("psf0", {"light": Light.of(700.0)}, "light: is for optical, Roman and chromatic PSFs only"),
        ("", {}, "psf: must not be empty"),
    ],
)
def test_options_that_do_not_fit_are_refused_in_one_line(name, options, message):
    with pytest.raises(InputError) as error:
        psf_from_name(name, **options)
    assert message in str(error.value)
    assert "\n" not in str(error.value)


@pytest.mark.parametrize("name", ["optical1", "roman:H158:SCA01", "psf1"])
def test_equal_options_give_equal_psfs_whatever_they_are(name):
    first, again, other = (psf_from_name(name, pixel=p) for p in (0.1, 0.1, 0.11))
    assert first == again
    assert hash(first) == hash(again)
    assert first != other
