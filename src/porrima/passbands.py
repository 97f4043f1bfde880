r"""Bands as cameras have them, and the photons of main-sequence stars behind them."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cache
from typing import TYPE_CHECKING, Any, Literal

import numpy as np

from porrima.errors import InputError
from porrima.photometry import MainSequence
from porrima.roman import BANDS

if TYPE_CHECKING:
    from numpy.typing import NDArray

    FloatArray = NDArray[np.float64]

__all__ = ["PASSBANDS", "Passband", "Spectrum", "black_body", "passband", "photon_averages"]

Spectrum = Literal["broad-band", "black-body"]
"""Whether a star shines as its magnitudes in neighbouring bands say, or as a black body of its temperature."""

N_WAVELENGTHS = 301
"""Wavelengths on which a band is integrated (count)."""

EDGE = 0.01
"""Throughput, over the largest, below which a band is left out at its ends (dimensionless)."""

_EUCLID_VIS = {  # nm: throughput
    540: 0.122, 544: 0.686, 548: 0.701, 552: 0.708, 556: 0.713, 560: 0.718, 570: 0.728, 590: 0.744, 610: 0.754,
    640: 0.760, 670: 0.756, 700: 0.756, 730: 0.752, 760: 0.737, 790: 0.713, 820: 0.666, 845: 0.610, 870: 0.534,
    895: 0.443, 910: 0.385, 914: 0.367, 918: 0.339, 922: 0.267, 926: 0.123, 930: 0.019,
}  # fmt: skip
"""Throughput of telescope, mirrors and detectors as GalSim-Euclid-Like has it, thinned out: mean wavelengths of stars
agree with those of the full curve to 1 nm."""

_LSST = ("r", "i", "z")
_ROMAN = ("roman_F062", "roman_F087", "roman_F106", "roman_F129", "roman_F158")
PASSBANDS = ("euclid_VIS", *_LSST, *_ROMAN)
"""Bands whose throughput is known.  r, i and z are Rubin's as GalSim has them, close to those of the photometry."""

NODES = {  # band of the photometry: pivot wavelength [nm], AB magnitude of Vega
    "g": (475.0, 0.0),
    "r": (622.0, 0.0),
    "i": (763.0, 0.0),
    "roman_F087": (872.0, 0.497),
    "z": (905.0, 0.0),
    "roman_F106": (1060.0, 0.659),
    "roman_F129": (1294.0, 0.963),
    "roman_F158": (1579.0, 1.293),
    "roman_F184": (1842.0, 1.558),
}
"""Magnitudes that make a spectrum.  The table's are AB in g, r, i and z and those of Vega in Roman's bands; the
difference is that of GalSim's spectrum of Vega."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Passband:
    """Throughput of a camera in one band.

    Parameters
    ----------
    name : str
        One of `PASSBANDS`.
    wavelength : tuple of float
        `N_WAVELENGTHS` of them, evenly spaced, in nm.
    throughput : tuple of float
        Detected photons over photons, in any unit, not negative, dimensionless.
    """

    name: str
    wavelength: tuple[float, ...]
    throughput: tuple[float, ...]


@cache
def passband(name: str) -> Passband:
    """Band of a name.

    Parameters
    ----------
    name : str
        One of `PASSBANDS`.

    Returns
    -------
    passband : Passband
        Without ends that let less than `EDGE` of the largest throughput pass, in nm.

    Raises
    ------
    InputError
        If no band with a known throughput has that name.
    """
    if name not in PASSBANDS:
        raise InputError(f"must be one of {', '.join(PASSBANDS)}", key="colour", value=name)
    if name == "euclid_VIS":
        x, y = np.array(list(_EUCLID_VIS), dtype=float), np.array(list(_EUCLID_VIS.values()))
    else:
        curve = _galsim_bandpass(name)
        x = np.linspace(curve.blue_limit, curve.red_limit, 4 * N_WAVELENGTHS)
        y = curve(x)
    good = x[y >= EDGE * y.max()]
    grid = np.linspace(good[0], good[-1], N_WAVELENGTHS)
    return Passband(
        name=name, wavelength=tuple(grid.tolist()), throughput=tuple(np.interp(grid, x, y).tolist())
    )


def _galsim_bandpass(name: str) -> Any:
    """Band of GalSim that belongs to a column of the photometry."""
    import galsim.roman  # noqa: PLC0415  (its bandpasses, where used)

    if name in _LSST:
        return galsim.Bandpass(f"LSST_{name}.dat", "nm")
    return galsim.roman.getBandpasses(AB_zeropoint=True)[BANDS[name.removeprefix("roman_")]]


def black_body(wavelength: FloatArray, temperature: float) -> FloatArray:
    r"""Photons per nm of a black body, over those at the first wavelength.

    Parameters
    ----------
    wavelength : (k,) float array
        In nm.
    temperature : float
        In K.

    Returns
    -------
    photons : (k,) float array
        :math:`\lambda^{-4}/(e^{hc/\lambda k T} - 1)`, dimensionless.
    """
    per_kelvin = 1.438776877e7 / wavelength  # hc/k in nm K
    photons = wavelength**-4.0 / np.expm1(per_kelvin / temperature)
    relative: FloatArray = photons / photons[0]
    return relative


def photon_averages(band: Passband, values: FloatArray, spectrum: Spectrum = "broad-band") -> FloatArray:
    r"""Means of functions of wavelength over the detected photons of every star of the main-sequence tracks.

    Parameters
    ----------
    band : Passband
        What the stars are seen through.
    values : (m, n_wavelength) float array
        The functions at the band's wavelengths, any unit of the caller's (dimensionless here).
    spectrum : {"broad-band", "black-body"}
        Of the stars.

    Returns
    -------
    averages : (m, n_grid, n_track) float array
        On the grid of `photometry.Tracks`, in the unit of the values.

    Notes
    -----
    ``broad-band``: the AB magnitudes of a star in nine bands from g to F184, at their pivot wavelengths, linear
    between them in the logarithm of wavelength; the spectrum is :math:`f_\nu/\lambda` photons per nm.  In a band that
    was not used, F062, the magnitudes of the table follow to 0.05 mag.  Molecular bands that are narrower are smoothed.
    ``black-body``: from the temperature alone; in VIS as good down to 4000 K, but M dwarfs are 15 to 40 nm redder
    than that, and in F158, where their opacity has its minimum, hardly redder than K dwarfs.

    References
    ----------
    Bressan2012
    """
    relation, one = MainSequence(), (np.array([0.5]), np.zeros(1), np.full(1, 9.8))
    wavelength = np.array(band.wavelength)
    if spectrum == "black-body":
        temperature = 10 ** relation.temperature_tracks(*one).magnitude
        photons = np.stack([black_body(wavelength, t) for t in temperature.ravel()])
        shape = temperature.shape
    else:
        nodes = np.log([place for place, _ in NODES.values()])
        grids = [relation.tracks(*one, name).magnitude + vega for name, (_, vega) in NODES.items()]
        magnitude = np.stack([grid - grids[2] for grid in grids])
        shape = magnitude.shape[1:]
        between = _linear(nodes, np.log(wavelength)) @ magnitude.reshape(len(nodes), -1)
        photons = (10 ** (-0.4 * between) / wavelength[:, None]).T
    photons = photons * np.array(band.throughput)
    averages: FloatArray = (values @ photons.T / photons.sum(axis=1)).reshape(-1, *shape)
    return averages


def _linear(nodes: FloatArray, at: FloatArray) -> FloatArray:
    """Weights (n_at, n_node) of linear interpolation; beyond the nodes the last value holds."""
    return np.stack([np.interp(at, nodes, one) for one in np.eye(nodes.size)], axis=1)
