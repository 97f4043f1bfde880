"""Interstellar extinction in each band, as a fraction of that in V."""

from __future__ import annotations

import numpy as np

__all__ = ["WAVELENGTHS", "extinction_ratio"]

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
"""Effective wavelength of each band, in micrometres: the instruments' own (SDSS, Gaia DR2, Euclid, Roman)."""

_R_V = 3.1
_OPTICAL_A = (0.32999, -0.77530, 0.01979, 0.72085, -0.02427, -0.50447, 0.17699, 1.0)
_OPTICAL_B = (-2.09002, 5.30260, -0.62251, -5.38434, 1.07233, 2.28305, 1.41338, 0.0)


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
    The mean law of Cardelli, Clayton & Mathis (1989, Eqs. 2 and 3), :math:`a(x) + b(x)/R_V`
    with x the inverse wavelength and :math:`R_V = 3.1`, at the band's effective wavelength.
    It gives :math:`A_i/A_V = 0.65`, and 0.60 and 0.11 at I and K, where the Besançon model has
    0.59 and 0.11.  Wide bands (Gaia G, Euclid VIS) redden less for red stars than it says, by
    up to a fifth of their extinction.

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
