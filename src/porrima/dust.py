"""Dust along a line of sight through the Galaxy, and its extinction in each band."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

if TYPE_CHECKING:
    from numpy.typing import NDArray

    FloatArray = NDArray[np.float64]

__all__ = ["WAVELENGTHS", "Place", "dust_extinction", "extinction_ratio"]

R_SUN, Z_SUN = 8.5, 0.015  # kpc

WAVELENGTHS: dict[str, float] = {
    "V": 0.551,
    "g": 0.477,
    "r": 0.623,
    "i": 0.763,
    "z": 0.913,
    "gaia_G": 0.622,
    "euclid_VIS": 0.715,
    "roman_F062": 0.620,
    "roman_F087": 0.869,
    "roman_F106": 1.060,
    "roman_F129": 1.293,
    "roman_F158": 1.577,
    "roman_F184": 1.842,
    "roman_F146": 1.464,
    "roman_F213": 2.125,
}
"""Effective wavelength of each band in micrometres, as SDSS, Gaia (DR2), Euclid and Roman state it."""

_R_V = 3.1
_OPTICAL_A = (0.32999, -0.77530, 0.01979, 0.72085, -0.02427, -0.50447, 0.17699, 1.0)
_OPTICAL_B = (-2.09002, 5.30260, -0.62251, -5.38434, 1.07233, 2.28305, 1.41338, 0.0)
_FLATTENING, _PLUS, _MINUS = 0.0140, 7.222, 5.777  # dimensionless, kpc, kpc


@dataclass(frozen=True, slots=True, kw_only=True)
class Place:
    """Places in the Galaxy, in cylindrical coordinates about its centre.

    Parameters
    ----------
    radius : (n,) float array
        Distance from the axis, in kpc.
    azimuth : (n,) float array
        Angle from the direction of the Sun towards that of rotation (l = 90°), in rad.
    height : (n,) float array
        Above the plane, in kpc.
    """

    radius: FloatArray
    azimuth: FloatArray
    height: FloatArray

    @classmethod
    def towards(cls, l: float, b: float, distance: FloatArray) -> Place:
        """Places at some distances from the Sun in one direction.

        Parameters
        ----------
        l, b : float
            Galactic longitude and latitude, in deg.
        distance : (n,) float array
            From the Sun, in pc.

        Returns
        -------
        place : Place
            With the Sun 8.5 kpc from the centre and 15 pc above the plane.
        """
        lon, lat = np.radians(l), np.radians(b)
        d = np.asarray(distance, dtype=float) / 1e3
        towards_sun = R_SUN - d * np.cos(lat) * np.cos(lon)
        sideways = d * np.cos(lat) * np.sin(lon)
        return cls(
            radius=np.hypot(towards_sun, sideways),
            azimuth=np.arctan2(sideways, towards_sun),
            height=Z_SUN + d * np.sin(lat),
        )

    def without_warp(self) -> FloatArray:
        r"""Height above the warped plane, in units of the flare.

        Returns
        -------
        height : (n,) float array
            In kpc.

        Notes
        -----
        The plane lies at :math:`0.18\,(R - 8.4)\cos(\theta - 90^\circ)` kpc beyond R = 8.4 kpc; heights
        beyond 9.5 kpc are divided by :math:`1 + 5.45\times10^{-4}(R - 9.5)`.

        References
        ----------
        Robin2003
        """
        plane = 0.18 * np.maximum(self.radius - 8.4, 0.0) * np.sin(self.azimuth)
        flare = 1.0 + 5.45e-4 * np.maximum(self.radius - 9.5, 0.0)
        height: FloatArray = (self.height - plane) / flare
        return height


def extinction_ratio(band: str) -> float:
    r"""Extinction in a band over that in V.

    Parameters
    ----------
    band : str
        A key of `WAVELENGTHS`.

    Returns
    -------
    ratio : float
        :math:`A_\mathrm{band} / A_V`, dimensionless.

    Raises
    ------
    ValueError
        If the band is not known.

    Notes
    -----
    The mean law of Cardelli, Clayton & Mathis (1989, Eqs. 2 and 3), :math:`a(x) + b(x)/R_V` with x the
    inverse wavelength and :math:`R_V = 3.1`, at the band's effective wavelength.  It gives
    :math:`A_i/A_V = 0.65`, and 0.60 and 0.11 in I and K, where the Besançon model has 0.59 and 0.11.
    For g, r, i, z it is 1.19, 0.87, 0.65, 0.47; Gaia G 0.87, Euclid VIS 0.73; Roman F106, F129, F158, F184
    0.37, 0.27, 0.19, 0.15.  Wide bands (Gaia G, Euclid VIS) lose less light of red stars than it says.

    References
    ----------
    Cardelli1989
    """
    if band not in WAVELENGTHS:
        raise ValueError(f"band must be one of {', '.join(WAVELENGTHS)}, got {band}")
    x = 1.0 / WAVELENGTHS[band]
    if x < 1.1:
        return float((0.574 - 0.527 / _R_V) * x**1.61)
    y = x - 1.82
    return float(np.polyval(_OPTICAL_A, y) + np.polyval(_OPTICAL_B, y) / _R_V)


def young_disc(
    radius: FloatArray, height: FloatArray, flattening: float, plus: float, minus: float
) -> FloatArray:
    r"""Einasto law of a young disc with a hole in its centre, not normalised.

    Parameters
    ----------
    radius, height : (n,) float array
        In kpc.
    flattening : float
        :math:`\epsilon`, dimensionless.
    plus, minus : float
        Scale lengths of disc and hole, in kpc.

    Returns
    -------
    density : (n,) float array
        :math:`e^{-(a/h_+)^2} - e^{-(a/h_-)^2}` with :math:`a^2 = R^2 + z^2/\epsilon^2`, dimensionless.

    References
    ----------
    Robin2003
    """
    a2 = radius**2 + (height / flattening) ** 2
    density: FloatArray = np.exp(-a2 / plus**2) - np.exp(-a2 / minus**2)
    return density


def dust_extinction(
    l: float,
    b: float,
    distance: FloatArray,
    per_kpc: float,
    warp: bool,
) -> FloatArray:
    r"""Extinction in V between the Sun and increasing distances.

    Parameters
    ----------
    l, b : float
        Galactic longitude and latitude, in deg.
    distance : (n,) float array
        In pc, increasing.
    per_kpc : float
        Extinction at the Sun, in mag per kpc.
    warp : bool
        Whether the dust follows the warp of the disc.

    Returns
    -------
    extinction : (n,) float array
        :math:`A_V`, in mag.

    Notes
    -----
    Dust follows the law of the youngest disc, :math:`\epsilon = 0.014`, with scale lengths of 7.222 and
    5.777 kpc, out to R = 14 kpc and without clouds.  Trapezoidal sums in steps of 2 % of the distance.

    References
    ----------
    Robin2003
    """
    nodes = np.concatenate([[0.0], np.geomspace(0.1, max(float(np.max(distance)), 1.0), 800)])
    place = Place.towards(l, b, nodes)
    height = place.without_warp() if warp else place.height
    here = young_disc(np.array(R_SUN), np.array(Z_SUN), _FLATTENING, _PLUS, _MINUS)
    relative = young_disc(place.radius, height, _FLATTENING, _PLUS, _MINUS) / here
    relative = np.where(place.radius < 14.0, relative, 0.0)
    steps = 0.5 * (relative[1:] + relative[:-1]) * np.diff(nodes) / 1e3
    total = np.concatenate([[0.0], per_kpc * np.cumsum(steps)])
    extinction: FloatArray = np.interp(distance, nodes, total)
    return extinction
