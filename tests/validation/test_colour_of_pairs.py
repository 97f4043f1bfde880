"""The colour of a companion at no separation, drawn with GalSim's chromatic profiles, against the formula."""

import galsim
import galsim.roman
import numpy as np
import pytest

from data_files import data_file
from porrima.colour import chromatic
from porrima.optics import EUCLID_LIKE
from porrima.passbands import black_body
from porrima.shapes import Adaptive

HEADING = (
    "40 Colour of a companion at no separation: Two stars on one point, black bodies, drawn by GalSim through the band "
    "(`ChromaticOpticalPSF` of six struts, or `galsim.roman`) and measured with HSM; change of R² by the companion "
    "over R² of the primary.  The formula is f/(1+f) times the difference of the two stars' own sizes, to first order "
    "about the primary."
)
COLUMNS = ("band", "PSF", "primary [K]", "companion [K]", "f", "drawn", "formula", "ratio")
SCALE = 0.1 / 12
HOT, COOL = (5800.0, 3400.0, 0.1), (4500.0, 3000.0, 0.3)  # primary [K], companion [K], flux ratio


def euclid_band():
    table = np.loadtxt(data_file("psf/euclid_vis_throughput.dat"))
    inside = (table[:, 0] > 5380) & (table[:, 0] < 9320)
    curve = galsim.LookupTable(0.1 * table[inside][:, 0], table[inside][:, 1], interpolant="linear")
    return galsim.Bandpass(curve, "nm")


def euclid_psf(blur):
    """Six struts, at 21 wavelengths: with 41 the changes of size move by 3e-4 of themselves."""
    p, band = EUCLID_LIKE, euclid_band()
    each = galsim.ChromaticOpticalPSF(
        lam=800, diam=p.diameter, obscuration=p.obscuration, nstruts=6, strut_thick=p.strut_thickness
    )
    psf = each.interpolate(np.linspace(band.blue_limit, band.red_limit, 21), oversample_fac=3.0)
    return galsim.Convolve(psf, galsim.Gaussian(sigma=0.029), galsim.Pixel(0.1)) if blur else psf


def roman_band():
    return galsim.roman.getBandpasses(AB_zeropoint=False)["H158"]


def roman_psf(blur):
    psf = galsim.roman.getPSF(1, "H158", pupil_bin=8, n_waves=9)
    return galsim.Convolve(psf, galsim.Pixel(0.11)) if blur else psf


def star_of(temperature, flux, band):
    def photons(wavelength):
        return np.asarray(wavelength) ** -4.0 / np.expm1(
            1.438776877e7 / (np.asarray(wavelength) * temperature)
        )

    return galsim.DeltaFunction() * galsim.SED(photons, "nm", "fphotons").withFlux(flux, band)


def drawn(psf, temperature, flux, band):
    star = galsim.Convolve(star_of(temperature, flux, band), psf)
    return star.drawImage(band, nx=201, ny=201, scale=SCALE, method="no_pixel", dtype=float)


def r2_of(image):
    return float(Adaptive().measure(image).r2)


def size_of(waves, temperature):
    """Change of R² over that of the reference of a black body."""
    wavelength = np.array(waves.band.wavelength)
    photons = black_body(wavelength, temperature) * np.array(waves.band.throughput)
    return waves.influence[2] @ photons / photons.sum()


@pytest.mark.parametrize(
    ("name", "column", "options", "psf", "band", "pairs"),
    [
        ("optical0", "euclid_VIS", {}, euclid_psf, euclid_band, [COOL]),
        ("optical0", "euclid_VIS", {"pixel": 0.1, "jitter": 0.029}, euclid_psf, euclid_band, [HOT, COOL]),
        ("roman:H158:SCA01", "roman_F158", {"pixel": 0.11}, roman_psf, roman_band, [HOT, COOL]),
    ],
    ids=["optical", "optical, pixel and jitter", "roman, pixel"],
)
def test_a_redder_companion_widens_the_psf_as_drawn_with_galsim(
    name, column, options, psf, band, pairs, full_size, record
):
    through, profile = band(), psf(bool(options))
    for hot, cool, f in pairs if full_size else pairs[:1]:
        waves = chromatic(name, Adaptive(), column, reference=hot, **options)
        alone, companion = drawn(profile, hot, 1.0, through), drawn(profile, cool, f, through)
        found = r2_of(alone + companion) / r2_of(alone) - 1
        primary = size_of(waves, hot)
        expected = f / (1 + f) * (size_of(waves, cool) - primary) / (1 + primary)
        label = name + "".join(f", {k} {v:g}" for k, v in options.items())
        numbers = f"{found:.3e}", f"{expected:.3e}", f"{expected / found:.3f}"
        record(HEADING, COLUMNS, (column, label, f"{hot:.0f}", f"{cool:.0f}", f, *numbers))
        assert expected == pytest.approx(found, rel=0.03)
