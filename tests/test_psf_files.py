import sys
import types
import warnings

import galsim
import numpy as np
import pytest
from astropy.io import fits

from data_files import data_file
from porrima.errors import InputError
from porrima.psf import psf_from_name
from porrima.psf_files import PSFWarning
from porrima.shapes import Adaptive
from porrima.spectra import Light

PROFILE = galsim.Moffat(beta=4, fwhm=0.16).shear(e1=0.04, e2=-0.02)


def pixels(scale=0.03, side=101, offset=(0, 0), profile=PROFILE):
    image = profile.drawImage(nx=side, ny=side, scale=scale, method="no_pixel", offset=offset, dtype=float)
    return image.array


def written(tmp_path, *planes, name="psf.fits", **header):
    """A file with an empty primary HDU for more than one plane, the header cards on the last HDU."""
    hdus = [fits.PrimaryHDU(planes[0])] if len(planes) == 1 else [fits.PrimaryHDU()]
    hdus += [fits.ImageHDU(plane) for plane in planes] if len(planes) > 1 else []
    for key, value in header.items():
        hdus[-1].header[key] = value
    fits.HDUList(hdus).writeto(tmp_path / name)
    return str(tmp_path / name)


def measured(psf):
    shape = Adaptive().measure(psf.draw())
    assert shape.flag == 0
    return np.array([shape.e1, shape.e2, shape.r2])


EXPECTED = measured(psf_from_name("psf0").__class__(name="moffat", profile=PROFILE))


@pytest.mark.parametrize(
    "header",
    [
        {"PIXELSCL": 0.03},
        {"CD1_1": -0.03 / 3600, "CD1_2": 0.0, "CD2_1": 0.0, "CD2_2": 0.03 / 3600},
        {"CD1_1": 0.018 / 3600, "CD1_2": -0.024 / 3600, "CD2_1": 0.024 / 3600, "CD2_2": 0.018 / 3600},
        {"CDELT1": -0.03 / 3600, "CDELT2": 0.03 / 3600},
        {"CDELT1": 0.03, "CDELT2": 0.03, "CUNIT1": "arcsec", "CUNIT2": "arcsec"},
        {"CDELT1": 30.0, "CDELT2": 30.0, "CUNIT1": "mas", "CUNIT2": "mas"},
    ],
    ids=["PIXELSCL", "CD", "turned CD", "CDELT in deg", "CDELT in arcsec", "CDELT in mas"],
)
def test_scale_comes_from_the_header(tmp_path, header):
    np.testing.assert_allclose(
        measured(psf_from_name(written(tmp_path, pixels(), **header))), EXPECTED, atol=5e-5
    )


def test_given_scale_is_taken_and_a_contradiction_is_reported(tmp_path):
    silent = written(tmp_path, pixels())
    assert measured(psf_from_name(silent, pixel_scale=0.03))[2] == pytest.approx(EXPECTED[2], rel=1e-3)
    contrary = written(tmp_path, pixels(), name="contrary.fits", PIXELSCL=0.05)
    with pytest.warns(PSFWarning, match=r"--pixel-scale 0.03 arcsec is taken, the header has 0.05"):
        assert measured(psf_from_name(contrary, pixel_scale=0.03))[2] == pytest.approx(EXPECTED[2], rel=1e-3)


def test_scale_of_the_primary_header_serves_for_an_extension(tmp_path):
    path = written(tmp_path, pixels(), pixels(), name="two.fits")
    with fits.open(path, mode="update") as hdus:
        hdus[0].header["PIXELSCL"] = 0.03
    np.testing.assert_allclose(measured(psf_from_name(f"{path}[2]")), EXPECTED, atol=5e-5)


def test_extensions_and_planes_are_found_by_number_and_name(tmp_path):
    narrow, wide = (pixels(profile=galsim.Gaussian(fwhm=f)) for f in (0.12, 0.2))
    path = written(tmp_path, narrow, wide, EXTNAME="WIDE")
    cube = written(tmp_path, np.stack([narrow, wide]), name="cube.fits", PIXELSCL=0.03)
    sizes = {
        name: measured(psf_from_name(name, pixel_scale=0.03))[2]
        for name in (
            f"{path}[1]",
            f"{path}[2]",
            f"{path}[WIDE]",
            path,
            f"{cube}[0,0]",
            f"{cube}[0,1]",
            f"{cube}[,1]",
        )
    }
    small, large = (2 * (f / 2.354820045030949) ** 2 for f in (0.12, 0.2))
    expected = [small, large, large, small, small, large, large]
    assert list(sizes.values()) == pytest.approx(expected, rel=3e-3)


def test_neither_flux_nor_type_nor_byte_order_matter(tmp_path):
    counts = np.round(pixels() * 2e9).astype(">i4")
    np.testing.assert_allclose(
        measured(psf_from_name(written(tmp_path, counts, PIXELSCL=0.03))), EXPECTED, atol=5e-5
    )


def test_it_is_galsims_quintic_through_the_pixels(tmp_path):
    array = pixels(scale=0.1, side=41)
    image = galsim.InterpolatedImage(galsim.Image(array, scale=0.1), x_interpolant="quintic")
    fine = image.drawImage(nx=801, ny=801, scale=0.0025, method="no_pixel", dtype=float)
    shape = Adaptive().measure(fine)
    found = measured(psf_from_name(written(tmp_path, array, PIXELSCL=0.1)))
    np.testing.assert_allclose(found, [shape.e1, shape.e2, shape.r2], rtol=2e-4, atol=1e-6)


def test_a_psf_off_centre_is_recentred_and_reported(tmp_path):
    path = written(tmp_path, pixels(offset=(3.3, -2.1)), PIXELSCL=0.03)
    with pytest.warns(PSFWarning, match=r"lies \+3.30, -2.10 pixels from the middle; it is recentred"):
        psf = psf_from_name(path)
    np.testing.assert_allclose(measured(psf), EXPECTED, atol=5e-5)
    image = psf.draw()
    assert np.unravel_index(np.argmax(image.array), image.array.shape) == (image.array.shape[0] // 2,) * 2


def test_a_background_is_reported_and_subtracted_on_demand(tmp_path):
    clean = measured(psf_from_name(written(tmp_path, pixels(), PIXELSCL=0.03)))
    path = written(tmp_path, pixels() + 2e-6, name="background.fits", PIXELSCL=0.03)
    with pytest.warns(PSFWarning, match=r"its edge is not dark: 0.02 of the flux if that is a background"):
        kept = measured(psf_from_name(path))
    taken_off = measured(psf_from_name(path, subtract_background=True))
    assert abs(taken_off[2] - clean[2]) < abs(kept[2] - clean[2]) / 20


def test_wings_that_the_stamp_cuts_are_reported_with_their_size(tmp_path):
    path = written(tmp_path, pixels(side=41, profile=galsim.Moffat(beta=1.6, fwhm=0.16)), PIXELSCL=0.03)
    with pytest.warns(PSFWarning, match=r"about 0.1 more beyond 0.61 arcsec if those are wings"):
        psf_from_name(path)


def broken(kind, tmp_path):
    """Name of a file that is of no use."""
    good, nan, edge = pixels(), pixels().copy(), np.roll(pixels(), 50, axis=1)
    nan[3, 4:6] = np.nan
    arrays = {
        "no scale": (good, {}),
        "cdelt 1": (good, {"CDELT1": 1.0, "CDELT2": 1.0}),
        "nan": (nan, {"PIXELSCL": 0.03}),
        "negative": (-good, {"PIXELSCL": 0.03}),
        "peak on the edge": (edge, {"PIXELSCL": 0.03}),
        "small stamp": (pixels(side=9), {"PIXELSCL": 0.03}),
        "tiny stamp": (pixels(side=5), {"PIXELSCL": 0.03}),
        "one dimension": (good[50], {"PIXELSCL": 0.03}),
        "cube": (np.stack([good, good]), {"PIXELSCL": 0.03}),
        "four dimensions": (good[None, None].repeat(2, 0), {"PIXELSCL": 0.03}),
        "not square": (good, {"CDELT1": 1e-5, "CDELT2": 2e-5}),
        "negative scale": (good, {"PIXELSCL": -0.03}),
        "scale a word": (good, {"PIXELSCL": "fine"}),
    }
    array, header = arrays[kind]
    return written(tmp_path, array, **header)


@pytest.mark.parametrize(
    ("kind", "message"),
    [
        ("no scale", "has no pixel scale (PIXELSCL, CDi_j or CDELTi): give --pixel-scale in arcsec"),
        ("cdelt 1", "has no pixel scale"),
        ("nan", "must have finite pixels only, got 2 of 10201 that are not"),
        ("negative", "must have a positive total flux, got -0.99"),
        ("peak on the edge", "must have its peak inside the stamp, got pixel [100, 50]"),
        (
            "small stamp",
            "must have an edge fainter than 0.05 of its peak: it is too small, or has a background, got 0.1",
        ),
        ("tiny stamp", "must have at least 8 pixels a side, got 5 x 5"),
        ("one dimension", "must be an image of two dimensions, got 1"),
        ("cube", "is a cube of 2 planes: name one, up to FILE.fits[0,1]"),
        ("four dimensions", "must be an image of two dimensions, got 4"),
        ("not square", "must have square pixels, got 0.036 x 0.072 arcsec"),
        ("negative scale", "must have a positive pixel scale [arcsec], got -0.03"),
        ("scale a word", "has a pixel scale that cannot be read"),
    ],
)
def test_an_image_that_is_no_psf_is_refused_in_one_line_that_names_it(tmp_path, kind, message):
    name = broken(kind, tmp_path)
    with pytest.raises(InputError) as error:
        psf_from_name(name)
    text = str(error.value)
    assert text.startswith(name)
    assert message in text
    assert "\n" not in text


@pytest.mark.parametrize(
    ("part", "message"),
    [
        ("[7]", "extension must be one of 0 PRIMARY, got 7"),
        ("[SCI]", "extension must be one of 0 PRIMARY, got SCI"),
        ("[0,2]", "plane must be one of 0 to 1, got 2"),
        ("[0,x]", "plane must be one of 0 to 1, got x"),
    ],
)
def test_an_extension_or_plane_that_is_not_there_is_refused(tmp_path, part, message):
    path = written(tmp_path, np.stack([pixels(), pixels()]), PIXELSCL=0.03)
    with pytest.raises(InputError) as error:
        psf_from_name(path + part)
    assert message in str(error.value)


def test_files_that_are_no_images_are_refused(tmp_path):
    table = str(tmp_path / "table.fits")
    fits.BinTableHDU.from_columns([fits.Column("a", "D", array=np.ones(3))]).writeto(table)
    text = tmp_path / "text.fits"
    text.write_text("not FITS")
    for name, message in (
        (table, "holds no image"),
        (f"{table}[1]", "must be an image"),
        (str(text), "cannot be read as FITS"),
        (str(tmp_path / "absent.fits"), "no such file"),
        (f"{written(tmp_path, pixels(), PIXELSCL=0.03)}[0,1]", "must be a cube to take a plane of it"),
    ):
        with pytest.raises(InputError, match=message):
            psf_from_name(name)


@pytest.mark.parametrize(
    ("file", "part", "scale", "fwhm"),
    [
        ("euclid_vis_like_1x.fits", "[1]", 0.1, 0.16),
        ("euclid_vis_like_3x.fits", "", 0.1 / 3, 0.15),
        ("hst_acs_f814w.fits", "", 0.03, 0.11),
        ("euclid_like_field_100.fits", "[0,99]", 0.1, 0.21),
    ],
)
def test_real_psfs_are_read_and_measured(file, part, scale, fwhm):
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", PSFWarning)
        psf = psf_from_name(f"{data_file(f'psf/{file}')}{part}", pixel_scale=scale)
    assert psf.fwhm == pytest.approx(fwhm, rel=0.05)
    assert np.all(np.isfinite(measured(psf)))


def stanza(tmp_path, text, name="psf.yaml"):
    (tmp_path / name).write_text(text)
    return str(tmp_path / name)


def test_a_stanza_is_built_by_galsim(tmp_path):
    name = stanza(
        tmp_path, "psf: {type: Moffat, beta: 4, fwhm: 0.16, ellip: {type: E1E2, e1: 0.04, e2: -0.02}}"
    )
    np.testing.assert_allclose(measured(psf_from_name(name)), EXPECTED, rtol=1e-5, atol=1e-7)


def test_a_stanza_that_needs_an_fft_is_as_good(tmp_path):
    name = stanza(
        tmp_path,
        "psf:\n  type: Convolve\n  items:\n"
        "  - {type: Gaussian, sigma: 0.06}\n  - {type: Gaussian, sigma: 0.08, ellip: {type: E1E2, e1: 0.1, e2: 0}}\n",
    )
    e1, e2, r2 = measured(psf_from_name(name))
    expected = 2 * 0.06**2 + 2 * 0.08**2 / np.sqrt(1 - 0.01)
    assert r2 == pytest.approx(expected, rel=1e-6)
    assert (e1, e2) == pytest.approx((0.1 * 2 * 0.08**2 / np.sqrt(0.99) / expected, 0), abs=1e-6)


def test_a_stanza_may_use_other_keys_of_the_file(tmp_path):
    name = stanza(tmp_path, "eval_variables: {fwidth: 0.2}\npsf: {type: Gaussian, fwhm: $0.5 * width}")
    assert psf_from_name(name).fwhm == pytest.approx(0.1, rel=2e-3)


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("psf: {type: Gausian, fwhm: 0.1}", "psf: Unrecognised gsobject type Value Gausian"),
        ("psf: {type: Gaussian}", "psf: "),
        ("psf: {type: Gaussian, fwhm: wide}", "psf: "),
        ("psf: {type: Gaussian, fwhm: 0.1, colour: red}", "psf: "),
        ("psf: {fwhm: 0.1}", "psf: "),
        ("psf: psf0", "psf: must have a GalSim stanza"),
        ("gal: {type: Gaussian, fwhm: 0.1}", "psf: must have a GalSim stanza"),
        ("[1, 2", "must be YAML"),
        ("", "psf: must have a GalSim stanza"),
    ],
)
def test_a_stanza_that_galsim_refuses_is_one_line_with_its_file(tmp_path, text, message):
    name = stanza(tmp_path, text)
    with pytest.raises(InputError) as error:
        psf_from_name(name)
    assert str(error.value).startswith(name)
    assert message in str(error.value)
    assert "\n" not in str(error.value)


def test_a_stanza_that_is_not_there_is_refused(tmp_path):
    with pytest.raises(InputError, match="cannot be read: No such file"):
        psf_from_name(str(tmp_path / "absent.yaml"))


def test_a_chromatic_stanza_needs_light(tmp_path):
    name = stanza(
        tmp_path,
        "psf: {type: ChromaticAtmosphere, base_profile: {type: Gaussian, sigma: 0.1}, base_wavelength: 700,\n"
        "      zenith_angle: 0 deg}\n",
    )
    with pytest.raises(InputError, match="is chromatic: light must be given"):
        psf_from_name(name)
    blue, red = (measured(psf_from_name(name, light=Light.of(w)))[2] for w in (500.0, 900.0))
    assert blue / red == pytest.approx((500 / 900) ** -0.4, rel=1e-3)


class Model:
    """A stand-in for what Piff reads: one chip, turned by 90 deg and of 0.2 arcsec per pixel."""

    wcs = {3: galsim.JacobianWCS(0, -0.2, 0.2, 0)}  # noqa: RUF012  (Piff has it so)

    def get_profile(self, x, y, chipnum=None):
        if chipnum != 3:
            raise ValueError(f"no chip {chipnum}")
        return galsim.Gaussian(fwhm=0.8).shear(e1=0.1 + 1e-4 * (x - y), e2=0), "no_pixel"


@pytest.fixture
def stand_in(monkeypatch, tmp_path):
    monkeypatch.setitem(sys.modules, "piff", types.SimpleNamespace(read=lambda path: Model()))
    (tmp_path / "model.piff").write_bytes(b"")
    return str(tmp_path / "model.piff")


def test_a_piff_model_is_taken_at_a_place_and_turned_to_the_axes_of_the_image(stand_in):
    for name in (f"{stand_in}[300,100]", f"{stand_in}[3,300,100]"):
        e1, e2, r2 = measured(psf_from_name(name))
        assert (e1, e2) == pytest.approx((-0.12, 0), abs=1e-6)
        assert r2 == pytest.approx(2 * (0.8 / 2.354820045030949) ** 2 / np.sqrt(1 - 0.12**2), rel=1e-6)


@pytest.mark.parametrize(
    ("part", "message"),
    [
        ("", "must name a place"),
        ("[3]", "must name a place"),
        ("[a,b]", "must name a place"),
        ("[1,2,3,4]", "must name a place"),
        ("[5,300,100]", "cannot be used by Piff: no chip 5"),
    ],
)
def test_a_piff_model_without_such_a_place_is_refused(stand_in, part, message):
    with pytest.raises(InputError, match=message):
        psf_from_name(stand_in + part)


def test_without_piff_the_error_says_what_to_install(monkeypatch, tmp_path):
    monkeypatch.setitem(sys.modules, "piff", None)
    (tmp_path / "model.piff").write_bytes(b"")
    with pytest.raises(InputError, match=r"needs Piff: pip install 'porrima\[piff\]'"):
        psf_from_name(str(tmp_path / "model.piff[1,2]"))


@pytest.mark.filterwarnings("ignore")
def test_a_file_that_piff_wrote_gives_the_profile_that_was_fitted(tmp_path):
    piff = pytest.importorskip("piff", reason="Piff, an extra, is not installed")
    wcs = galsim.PixelScale(0.26)
    stars = []
    for x, y in [(100, 100), (900, 200), (500, 800), (200, 700)]:
        star = piff.Star.makeTarget(x=x, y=y, scale=0.26, stamp_size=32)
        galsim.Gaussian(sigma=0.5).shear(g1=0.03, g2=-0.02).drawImage(star.data.image, method="auto")
        stars.append(star)
    model = piff.SimplePSF(piff.Gaussian(fastfit=False), piff.Mean())
    model.fit(stars, {0: wcs}, None)
    path = str(tmp_path / "model.piff")
    model.write(path)
    e1, e2, r2 = measured(psf_from_name(f"{path}[321,456]"))
    shear = galsim.Shear(g1=0.03, g2=-0.02)
    assert (e1, e2) == pytest.approx((shear.e1, shear.e2), abs=1e-3)
    assert r2 == pytest.approx(2 * 0.5**2 / np.sqrt(1 - shear.e**2), rel=1e-3)
