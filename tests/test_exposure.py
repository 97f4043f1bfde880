"""Exposures: their figures agree with each other and with the files that they come from."""

import galsim.roman
import numpy as np
import pytest

from data_files import data_file
from porrima.exposure import EUCLID_VIS_WIDE, EXPOSURES, roman_exposures
from porrima.instruments import SURVEYS
from porrima.pointings import pointings
from porrima.psf import psf_from_name


def test_a_magnitude_is_a_factor_of_electrons():
    electrons = EUCLID_VIS_WIDE.electrons(np.array([20.0, 22.5]))
    assert electrons[0] / electrons[1] == pytest.approx(10)
    assert EUCLID_VIS_WIDE.electrons(EUCLID_VIS_WIDE.zero_point) == pytest.approx(EUCLID_VIS_WIDE.time)


def test_the_zero_point_of_vis_follows_from_its_throughput():
    wavelength, throughput = np.loadtxt(data_file("psf/euclid_vis_throughput.dat"), unpack=True)
    photons = (
        3631e-26 / 6.62607015e-34 * np.trapezoid(throughput / wavelength, wavelength)
    )  # per s and m², AB = 0
    assert 2.5 * np.log10(0.9926 * photons) == pytest.approx(EUCLID_VIS_WIDE.zero_point, abs=0.005)


def test_a_roman_star_has_the_electrons_that_galsim_draws():
    exposures = roman_exposures("H158")
    bandpass = galsim.roman.getBandpasses(AB_zeropoint=True)["H158"]
    flat = galsim.SED(lambda wave: 1.0, "nm", "fnu").withMagnitude(20.0, bandpass)
    photons = flat.calculateFlux(bandpass) * galsim.roman.collecting_area * galsim.roman.exptime
    assert exposures.electrons(20.0) == pytest.approx(photons, rel=1e-3)
    sky = galsim.roman.getSkyLevel(bandpass) * 1.1 * 0.11**2 + (0.015 + 0.04) * galsim.roman.exptime
    assert exposures.background == pytest.approx(sky + 8.5**2)


@pytest.mark.parametrize(
    ("name", "full_well"), [("euclid-vis", (1.9e5, 2.1e5)), ("roman-h158", (5e4, 1.5e5))]
)
def test_the_brightest_pixel_of_a_star_at_saturation_is_full(name, full_well):
    exposures, survey = EXPOSURES[name](), SURVEYS[name]
    psf = psf_from_name(survey.psf, pixel=survey.pixel, jitter=survey.jitter)
    peak = pointings(psf, exposures.pixel, np.zeros((1, 2))).images(np.zeros(1), np.zeros(1)).max()
    assert (
        full_well[0] < exposures.electrons(exposures.saturation) * peak + exposures.background < full_well[1]
    )


@pytest.mark.parametrize("name", EXPOSURES)
def test_every_survey_with_exposures_has_the_pixel_of_its_camera_and_a_source(name):
    exposures = EXPOSURES[name]()
    assert exposures.pixel == SURVEYS[name].instrument.pixel
    assert exposures.source
    assert exposures.background > exposures.read_noise**2
