from dataclasses import replace

import galsim
import galsim.roman
import numpy as np
import pytest

from data_files import data_file
from porrima.errors import InputError
from porrima.passbands import NODES, PASSBANDS, black_body, passband, photon_averages
from porrima.photometry import MainSequence, magnitudes
from porrima.roman import BANDS

MASSES = np.array([0.15, 0.3, 0.5, 0.7, 1.0])


def of_masses(averages):
    """Values of solar stars of `MASSES`, from values on the grid of tracks."""
    n = MASSES.size
    tracks = MainSequence().tracks(MASSES, np.zeros(n), np.full(n, 9.8), "i")
    return magnitudes(replace(tracks, magnitude=np.ascontiguousarray(averages)), MASSES[:, None])[:, 0]


def mean_wavelength(name, spectrum="broad-band"):
    band = passband(name)
    return of_masses(photon_averages(band, np.array([band.wavelength]), spectrum)[0])


@pytest.mark.parametrize("name", PASSBANDS)
def test_every_band_has_positive_throughput_and_lies_between_the_nodes_of_the_spectra(name):
    band = passband(name)
    assert min(band.throughput) >= 0
    assert max(band.throughput) > 0
    places = [place for place, _ in NODES.values()]
    assert places[0] - 10 < band.wavelength[0] < band.wavelength[-1] < places[-1]


def test_an_unknown_band_is_refused():
    with pytest.raises(InputError, match=r"colour: must be one of euclid_VIS, .*, got gaia_G"):
        passband("gaia_G")


def test_the_band_of_euclid_has_the_mean_wavelengths_of_the_full_curve():
    table = np.loadtxt(data_file("psf/euclid_vis_throughput.dat"))
    full, throughput = 0.1 * table[:, 0], table[:, 1]
    band = passband("euclid_VIS")
    own = np.array(band.wavelength)
    for temperature in (2500.0, 4000.0, 6000.0):
        expected = np.average(
            full, weights=throughput * full**-4 / np.expm1(1.438777e7 / (full * temperature))
        )
        found = np.average(own, weights=np.array(band.throughput) * black_body(own, temperature))
        assert found == pytest.approx(expected, abs=1.0)


def test_a_black_body_peaks_in_photons_where_wien_says():
    wavelength = np.linspace(300.0, 2000.0, 100_001)
    peak = wavelength[np.argmax(black_body(wavelength, 5000.0))]
    assert peak * 5000.0 == pytest.approx(3.6697e6, rel=1e-4)  # nm K


def test_the_magnitudes_of_vega_are_those_of_galsims_vega():
    curves = galsim.roman.getBandpasses(AB_zeropoint=False)
    vega = galsim.SED(galsim.meta_data.share_dir + "/SEDs/vega.txt", "nm", "flambda")
    for name, (_, magnitude) in NODES.items():
        if name.startswith("roman_"):
            curve = curves[BANDS[name.removeprefix("roman_")]]
            star = vega.withMagnitude(0.0, curve.withZeropoint("Vega"))
            assert star.calculateMagnitude(curve.withZeropoint("AB")) == pytest.approx(magnitude, abs=1e-3)


def test_spectra_from_magnitudes_give_the_magnitude_of_a_band_they_were_not_made_from():
    band = passband("roman_F062")
    wavelength = np.array(band.wavelength)
    relation = MainSequence()
    n = MASSES.size
    stars = np.zeros(n), np.full(n, 9.8)  # solar
    nodes = np.log([place for place, _ in NODES.values()])
    mags = np.stack(
        [
            magnitudes(relation.tracks(MASSES, *stars, name), MASSES[:, None])[:, 0] + vega
            for name, (_, vega) in NODES.items()
        ]
    )
    flux = np.stack([10 ** (-0.4 * np.interp(np.log(wavelength), nodes, m)) for m in mags.T])
    weight = np.array(band.throughput) / wavelength
    synthetic = -2.5 * np.log10(flux @ weight / weight.sum()) - 0.157  # Vega in F062, AB
    table = magnitudes(relation.tracks(MASSES, *stars, "roman_F062"), MASSES[:, None])[:, 0]
    np.testing.assert_allclose(synthetic, table, atol=0.06)


def test_black_bodies_and_magnitudes_agree_for_stars_like_the_sun_in_vis():
    black, broad = mean_wavelength("euclid_VIS", "black-body"), mean_wavelength("euclid_VIS")
    np.testing.assert_allclose(black[-2:], broad[-2:], atol=3.0)
    assert np.all(broad[:3] - black[:3] > 10.0)  # M dwarfs are redder than black bodies


def test_redder_stars_have_longer_wavelengths():
    assert np.all(np.diff(mean_wavelength("euclid_VIS")) < 0)
    assert np.all(np.diff(mean_wavelength("roman_F158", "black-body")) < 0)


def test_a_constant_averages_to_itself():
    band = passband("i")
    for spectrum in ("broad-band", "black-body"):
        averages = photon_averages(band, np.full((1, len(band.wavelength)), 0.7), spectrum)
        np.testing.assert_allclose(averages, 0.7, rtol=1e-12)


def test_temperatures_are_those_of_the_sun_and_of_a_red_dwarf():
    tracks = MainSequence().temperature_tracks(np.array([1.0, 0.3]), np.zeros(2), np.full(2, np.log10(4.6e9)))
    hot, cool = 10 ** magnitudes(tracks, np.array([[1.0], [0.3]]))[:, 0]
    assert hot == pytest.approx(5772.0, rel=0.02)
    assert 3000 < cool < 3500
