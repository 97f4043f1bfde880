import galsim
import galsim.roman
import numpy as np
import pytest

from porrima.errors import InputError
from porrima.psf import psf_from_name
from porrima.roman import BANDS, N_DETECTORS, RomanName, roman_profile
from porrima.shapes import Adaptive
from porrima.spectra import Light


def shape_of(profile, scale=0.0025):
    n = 2 * round(0.7 / scale) + 1
    found = Adaptive().measure(profile.drawImage(nx=n, ny=n, scale=scale, method="no_pixel", dtype=float))
    return np.array([found.e1, found.e2, found.r2])


def test_it_is_galsims_psf_at_the_effective_wavelength_of_the_band():
    band = galsim.roman.getBandpasses()["J129"]
    given = galsim.roman.getPSF(7, "J129", pupil_bin=4, wavelength=band)
    assert roman_profile(RomanName("roman:J129:SCA07")) == given
    found = Adaptive().measure(psf_from_name("roman:J129:SCA07").draw())
    np.testing.assert_allclose([found.e1, found.e2], shape_of(given)[:2], atol=1e-6)
    assert float(found.r2) == pytest.approx(shape_of(given)[2], rel=1e-5)


@pytest.mark.parametrize("name", ["roman:Y106:SCA03:100,3800.5", "roman:F184:SCA18:0,4088"])
def test_a_place_on_the_detector_is_heeded(name):
    parsed = RomanName(name)
    band = galsim.roman.getBandpasses()[parsed.band]
    given = galsim.roman.getPSF(
        parsed.detector, parsed.band, galsim.PositionD(*parsed.place), wavelength=band
    )
    assert roman_profile(parsed) == given
    middle = roman_profile(RomanName(name.rsplit(":", 1)[0]))
    assert np.abs(shape_of(middle)[:2] - shape_of(given)[:2]).max() > 1e-4


def test_names_cover_all_bands_and_detectors():
    parsed = {RomanName(f"roman:{band}:SCA{n:02d}").detector for band in BANDS for n in range(1, 19)}
    assert parsed == set(range(1, N_DETECTORS + 1)) == set(range(1, galsim.roman.n_sca + 1))
    assert set(BANDS.values()) == set(galsim.roman.getBandpasses())
    assert RomanName("roman:F158:SCA1").band == "H158"


def test_pupil_bin_is_fine_enough():
    """Against a pupil of twice the resolution."""
    band = galsim.roman.getBandpasses()["H158"]
    coarse, fine = (
        shape_of(galsim.roman.getPSF(1, "H158", pupil_bin=n, wavelength=band), 0.005) for n in (4, 2)
    )
    assert np.abs(coarse - fine)[:2].max() < 2e-4
    assert coarse[2] == pytest.approx(fine[2], rel=5e-3)


def test_the_exact_pattern_goes_through_the_samples_of_galsims():
    name = RomanName("roman:H158:SCA05")
    theirs, exact = roman_profile(name), roman_profile(RomanName("roman-exact:H158:SCA05"))
    native = theirs._psf._ii.image.scale
    ratio = [
        exact.xValue(i * native, j * native) / theirs.xValue(i * native, j * native)
        for i, j in [(0, 0), (1, 0), (0, -1), (2, 1)]
    ]
    assert np.ptp(ratio) < 1e-6 * ratio[0]


def test_the_exact_pattern_is_that_of_an_oversampled_optical_psf():
    """The same pupil with zeros around it, which makes GalSim's own samples four times finer."""
    name = RomanName("roman:H158:SCA05")
    theirs = roman_profile(name)
    pupil = galsim.Image(theirs._aper.illuminated.astype(float))
    wide = galsim.ImageD(4 * pupil.array.shape[0], 4 * pupil.array.shape[0])
    low = (wide.array.shape[0] - pupil.array.shape[0]) // 2
    wide.array[low : low + pupil.array.shape[0], low : low + pupil.array.shape[0]] = pupil.array
    wavelength = galsim.roman.getBandpasses()["H158"].effective_wavelength
    private = galsim.roman.roman_psfs
    aberrations = private._interp_aberrations_bilinear(
        *private._read_aberrations(5), galsim.PositionD(galsim.roman.n_pix / 2, galsim.roman.n_pix / 2)
    )
    aberrations[:4] = 0
    aberrations *= private.zemax_wavelength / wavelength
    aper = galsim.Aperture(
        diam=galsim.roman.diameter, pupil_plane_im=wide, pupil_plane_scale=theirs._aper.pupil_plane_scale
    )
    fine = galsim.OpticalPSF(lam=wavelength, diam=galsim.roman.diameter, aberrations=aberrations, aper=aper)
    expected = shape_of(fine, 0.005)
    found = shape_of(roman_profile(RomanName("roman-exact:H158:SCA05")), 0.005)
    np.testing.assert_allclose(found[:2], expected[:2], atol=2e-5)
    assert found[2] == pytest.approx(expected[2], rel=2e-4)


def test_light_of_many_wavelengths_is_a_sum():
    light = Light(wavelength=(1000.0, 1100.0), share=(0.5, 0.5))
    both = roman_profile(RomanName("roman:Y106:SCA02"), light)
    each = [roman_profile(RomanName("roman:Y106:SCA02"), Light.of(w)) for w in light.wavelength]
    assert both.xValue(0.05, 0.02) == pytest.approx(np.mean([p.xValue(0.05, 0.02) for p in each]), rel=1e-12)


@pytest.mark.parametrize(
    ("name", "message"),
    [
        ("roman:H158", "must be roman:BAND:SCAnn or roman:BAND:SCAnn:x,y"),
        ("roman:H159:SCA01", "band must be one of R062, Z087, Y106"),
        ("roman:H158:SCA19", "detector must be one of SCA01 to SCA18"),
        ("roman:H158:SCA00", "detector must be one of SCA01 to SCA18"),
        ("roman:H158:SCA01:5000,3", "x,y must be in [0, 4088] pixels"),
        ("roman:H158:SCA01:a,3", "x,y must be two numbers"),
        ("roman:H158:SCA01:3", "must be roman:BAND:SCAnn"),
    ],
)
def test_other_names_are_refused_in_one_line(name, message):
    with pytest.raises(InputError) as error:
        psf_from_name(name)
    assert message in str(error.value)
    assert str(error.value).startswith("psf: ")
    assert str(error.value).endswith(f"got {name}")
