import numpy as np
import pytest

from data_files import data_file
from porrima.optics import EUCLID_LIKE, optical_image
from porrima.psf import psf_from_name
from porrima.shapes import Adaptive
from porrima.spectra import Light


def size(light):
    return float(Adaptive().measure(optical_image(EUCLID_LIKE, light, 0, 0, 0.005, half_width=0.6)).r2)


def test_a_flat_band_has_evenly_spaced_wavelengths():
    light = Light.through(np.array([500.0, 900.0]), np.ones(2), n=4)
    assert light.wavelength == pytest.approx((550, 650, 750, 850), abs=0.05)
    assert light.share == (0.25,) * 4


def test_mean_wavelength_is_that_of_the_photons_whatever_their_number():
    wavelength = np.linspace(500, 900, 401)
    spectrum = (wavelength, wavelength**2)
    means = [Light.through(wavelength, np.ones(401), spectrum, n).mean for n in (1, 7, 32)]
    exact = np.trapezoid(wavelength**3, wavelength) / np.trapezoid(wavelength**2, wavelength)
    assert means == pytest.approx([exact] * 3, rel=1e-4)


def test_a_spectrum_that_ends_inside_the_band_gives_no_light_beyond():
    light = Light.through(np.array([500.0, 900.0]), np.ones(2), (np.array([600.0, 700.0]), np.ones(2)))
    assert 600 <= min(light.wavelength) <= max(light.wavelength) <= 700


def test_sixteen_wavelengths_do_for_vis():
    curve = np.loadtxt(data_file("psf/euclid_vis_throughput.dat"))
    wavelength, throughput = curve[:, 0] / 10, np.maximum(curve[:, 1], 0)
    sizes = [size(Light.through(wavelength, throughput, n=n)) for n in (4, 16, 64)]
    assert abs(sizes[1] / sizes[2] - 1) < 3e-4
    assert abs(sizes[0] / sizes[2] - 1) > 4 * abs(sizes[1] / sizes[2] - 1)


def test_psf_takes_light():
    light = Light(wavelength=(650.0, 850.0), share=(0.5, 0.5))
    found = float(Adaptive().measure(psf_from_name("optical0", light=light).draw()).r2)
    assert found == pytest.approx(size(light), rel=1e-6)
    assert size(Light.of(650)) < found < size(Light.of(850))


def test_a_redder_star_has_a_larger_psf():
    wavelength = np.linspace(550, 900, 36)
    sizes = []
    for slope in (-3, 0, 3):
        light = Light.through(wavelength, np.ones(36), (wavelength, wavelength**slope), n=8)
        sizes.append(size(light))
    assert sizes == sorted(sizes)


@pytest.mark.parametrize(
    ("wavelength", "share", "message"),
    [((0.0,), (1.0,), "wavelength"), ((700.0,), (0.9,), "sum to 1"), ((700.0, 800.0), (1.0,), "one value")],
)
def test_light_that_is_none_is_refused(wavelength, share, message):
    with pytest.raises(ValueError, match=message):
        Light(wavelength=wavelength, share=share)


def test_no_photon_through_the_band_is_refused():
    with pytest.raises(ValueError, match="positive somewhere"):
        Light.through(np.array([500.0, 600.0]), np.ones(2), (np.array([700.0, 800.0]), np.ones(2)))
    with pytest.raises(ValueError, match="rise"):
        Light.through(np.array([600.0, 500.0]), np.ones(2))
