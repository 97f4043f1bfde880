"""The internal unit of each kind of quantity, and the constants that join them."""

from __future__ import annotations

import math
from typing import Any

__all__ = ["SIGMA_PER_FWHM", "UNITS", "to_internal"]

UNITS = {  # kind of quantity: the unit of every bare float of that kind inside Porrima
    "angle": "arcsec",
    "angular_area": "arcsec2",
    "sky_area": "deg2",
    "mass": "solMass",
    "distance": "pc",
    "separation": "au",
    "time": "day",
    "age": "yr",
    "magnitude": "mag",
    "metallicity": "dex",
}

SIGMA_PER_FWHM = 1.0 / (2.0 * math.sqrt(2.0 * math.log(2.0)))
"""Standard deviation of a Gaussian over its full width at half maximum (dimensionless)."""


def to_internal(value: Any, kind: str) -> Any:
    """Number or array of numbers in the internal unit of its kind.

    Parameters
    ----------
    value : float, array or Quantity
        A bare number is taken to be in the internal unit already.
    kind : str
        A key of `UNITS`.

    Returns
    -------
    value : float or array
        In the unit `UNITS[kind]`, dimensionless numbers unchanged.

    Raises
    ------
    ValueError
        If the unit of a Quantity cannot be converted to that of its kind.

    Notes
    -----
    Separations need no constant: by the definition of the parsec, an orbit of a au
    at d pc is seen at a/d arcsec.
    """
    if not hasattr(value, "unit") or value.unit is None:
        return value
    from astropy import units as u  # noqa: PLC0415  (half a second, for Quantities only)

    unit = u.Unit(UNITS[kind])
    try:
        return u.Quantity(value).to_value(unit)
    except u.UnitConversionError:
        raise ValueError(f"{kind} must be in a unit convertible to {unit}, got {value.unit}") from None
