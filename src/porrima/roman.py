"""PSFs of the Roman Space Telescope's camera from ``galsim.roman``: 18 detectors, all bands."""

from __future__ import annotations

import re
from functools import lru_cache
from typing import TYPE_CHECKING, Any

import galsim
import galsim.roman

from porrima.errors import InputError
from porrima.sampling import interpolated, upsampled

if TYPE_CHECKING:
    from porrima.spectra import Light

__all__ = ["BANDS", "N_DETECTORS", "RomanName", "roman_profile"]

BANDS = {  # name of the band: what galsim.roman calls it
    **{name: name for name in ("R062", "Z087", "Y106", "J129", "H158", "F184", "K213", "W146")},
    "F062": "R062",
    "F087": "Z087",
    "F106": "Y106",
    "F129": "J129",
    "F158": "H158",
    "F213": "K213",
    "F146": "W146",
}
"""Bands, by the names of ``galsim.roman`` and by those of the filters."""

N_DETECTORS = 18

PUPIL_BIN = 4
"""GalSim's own default: against the full pupil, kappa is right to 1e-3, R² to 0.5 %, e to 2e-4."""

UPSAMPLING = 16
"""Factor by which the pattern of ``roman-exact`` is refined (count): 4 mas per pixel."""

CROP = 192
"""Native pixels of the pattern that is refined (count): 13 arcsec in H158."""

NAME = re.compile(r"(roman|roman-exact):(\w+):SCA(\d\d?)(?::([^:,]+),([^:,]+))?")


class RomanName:
    """What a name such as ``roman:H158:SCA01`` or ``roman:H158:SCA01:100,2000`` says.

    Parameters
    ----------
    name : str
        ``roman:BAND:SCAnn`` or ``roman-exact:BAND:SCAnn``, with ``:x,y`` for a place on the detector in pixels.

    Raises
    ------
    InputError
        If the name says nothing else than that, or names an unknown band, detector or place.
    """

    __slots__ = ("band", "detector", "exact", "place")

    def __init__(self, name: str) -> None:
        def wrong(rule: str) -> InputError:
            return InputError(rule, key="psf", value=name)

        match = NAME.fullmatch(name)
        if not match:
            raise wrong("must be roman:BAND:SCAnn or roman:BAND:SCAnn:x,y")
        kind, band, detector, *place = match.groups()
        if band not in BANDS:
            raise wrong(f"band must be one of {', '.join(BANDS)}")
        if not 1 <= int(detector) <= N_DETECTORS:
            raise wrong(f"detector must be one of SCA01 to SCA{N_DETECTORS}")
        self.exact, self.band, self.detector = kind == "roman-exact", BANDS[band], int(detector)
        self.place: tuple[float, float] | None = None
        if place[0] is not None:
            try:
                x, y = float(place[0]), float(place[1])
            except ValueError:
                raise wrong("x,y must be two numbers of pixels") from None
            if not (0 <= x <= galsim.roman.n_pix and 0 <= y <= galsim.roman.n_pix):
                raise wrong(f"x,y must be in [0, {galsim.roman.n_pix}] pixels")
            self.place = x, y


@lru_cache(maxsize=1)
def _bandpasses() -> Any:
    """Bandpasses of all bands, in 0.2 s."""
    return galsim.roman.getBandpasses(AB_zeropoint=False)


def roman_profile(name: RomanName, light: Light | None = None) -> Any:
    """PSF of Roman at one place of one detector, along the axes of the image, without pixel.

    Parameters
    ----------
    name : RomanName
        Band, detector and, where not its middle is meant, the place.
    light : Light, optional
        The effective wavelength of the band where not given.

    Returns
    -------
    profile : galsim.GSObject
        Of unit flux, in arcsec; a sum over wavelengths where the light has many.

    Notes
    -----
    ``galsim.roman.getPSF(SCA, band, SCA_pos, pupil_bin=4, wavelength=...)`` as it stands.  GalSim samples
    that pattern at half of lambda/D, no finer than its frequencies need, and puts a quintic through the samples:
    drawn without a pixel the PSF comes out 4 to 5 % too large in R², and kappa 7 to 10 % too large (H158: 0.944,
    and 0.880 for the pattern itself).  ``roman-exact`` refines the pattern by its Fourier transform first.
    Behind a pixel of 0.11 arcsec R² differs by 2 to 5 % still, kappa by 0.1 % (H158) to 2.4 % (F184).

    References
    ----------
    Rowe2015
    """
    band = _bandpasses()[name.band]
    place = None if name.place is None else galsim.PositionD(*name.place)
    lines = (
        [(band.effective_wavelength, 1.0)]
        if light is None
        else zip(light.wavelength, light.share, strict=True)
    )
    parts = []
    for wavelength, share in lines:
        psf = galsim.roman.getPSF(
            name.detector, name.band, SCA_pos=place, pupil_bin=PUPIL_BIN, wavelength=float(wavelength)
        )
        parts.append((_refined(psf, wavelength) if name.exact else psf) * share)
    return parts[0] if len(parts) == 1 else galsim.Sum(parts)


def _refined(psf: Any, wavelength: float) -> Any:
    """The pattern whose samples GalSim's profile goes through, on a grid that needs no interpolation."""
    native = wavelength * 1e-9 / psf._aper.pupil_plane_size * (galsim.radians / galsim.arcsec)
    # With an even number of pixels and the origin on one of them, GalSim's quintic returns its own samples.
    image = psf.drawImage(
        nx=CROP, ny=CROP, scale=native, method="no_pixel", use_true_center=False, dtype=float
    )
    return interpolated(upsampled(image.array, UPSAMPLING), native / UPSAMPLING)
