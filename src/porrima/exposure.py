"""What a survey collects of a star: electrons, sky and noise of its exposures, each figure with its source."""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import lru_cache
from typing import TYPE_CHECKING

import numpy as np

if TYPE_CHECKING:
    from collections.abc import Callable

    from numpy.typing import NDArray

    FloatArray = NDArray[np.float64]

__all__ = ["EUCLID_VIS_WIDE", "EXPOSURES", "Exposures", "roman_exposures"]


@dataclass(frozen=True, slots=True, kw_only=True)
class Exposures:
    """Equal exposures of one field.

    Parameters
    ----------
    name : str
        Of the survey and its band.
    zero_point : float
        AB magnitude, in the band of the exposures, of a star that gives one electron per second, in mag.
    time : float
        Of one exposure, in s.
    sky : float
        Electrons per second and arcsec² from the sky and stray light.
    dark : float
        Electrons per second and pixel from the detector and the warm telescope.
    read_noise : float
        Rms of one read-out of a pixel, in electrons.
    pixel : float
        Side of a pixel, in arcsec.
    n_exposures : int
        Dithered exposures of each star (count).
    saturation : float
        Magnitude above which no pixel of a star saturates, in mag.
    area : float
        Of the sky that falls on detectors in one exposure, in deg².
    band : str
        Of the photometry, in which stars and flux ratios of companions are taken.
    vega_ab : float
        AB magnitude of a star that has magnitude 0 in that band, in mag.
    source : str
        Where the figures come from; ``[?]`` marks one with a single weak source.
    """

    name: str
    zero_point: float
    time: float
    sky: float
    dark: float
    read_noise: float
    pixel: float
    n_exposures: int
    saturation: float
    area: float
    band: str
    vega_ab: float
    source: str

    def electrons(self, magnitude: FloatArray) -> FloatArray:
        """Electrons of a star in one exposure.

        Parameters
        ----------
        magnitude : (n,) float array
            AB, in the band of the exposures, in mag.

        Returns
        -------
        electrons : (n,) float array
            Mean number (count).
        """
        return np.asarray(self.time * 10 ** (0.4 * (self.zero_point - np.asarray(magnitude, dtype=float))))

    @property
    def background(self) -> float:
        """Variance of a pixel without a star in one exposure, in electrons²."""
        return self.time * (self.sky * self.pixel**2 + self.dark) + self.read_noise**2


EUCLID_VIS_WIDE = Exposures(
    name="Euclid VIS, wide survey",
    zero_point=25.76,
    time=560.5,
    sky=10 ** (0.4 * (25.76 - 22.35)),
    dark=5.6e-4,
    read_noise=4.4,
    pixel=0.1,
    n_exposures=4,
    saturation=17.8,
    area=36 * 4132 * 4096 * (0.1 / 3600) ** 2,
    band="euclid_VIS",
    vega_ab=0.0,
    source="zero point: the throughput of VIS (SVO, as in GalSim-Euclid-Like) and 0.9926 m²; time: 566 s nominal with "
    "560.5 s of open shutter, read noise, dithers: GalSim-Euclid-Like; sky: mean zodiacal light of 22.35 mag/arcsec², "
    "Laureijs et al. 2011, which Leinert et al. 1998 give at ecliptic latitude 30 deg; dark: less than 2 e-/h, "
    "Cropper et al. 2016; saturation: full well of 2e5 e- (GalSim-Euclid-Like) in the brightest pixel "
    "[?]; area: 36 detectors of 4132 x 4096 pixels, Cropper et al. 2016",
)
"""Four exposures of Euclid's wide survey."""

ROMAN_SATURATION = 18.3
"""Of Roman's imaging exposures in H158, in mag AB [?]: one source without a date."""


@lru_cache(maxsize=4)
def roman_exposures(band: str = "H158") -> Exposures:
    """Exposures of Roman's wide survey as ``galsim.roman`` has them.

    Parameters
    ----------
    band : str
        As ``galsim.roman`` calls it.

    Returns
    -------
    exposures : Exposures
        With `ROMAN_SATURATION` in every band.

    Notes
    -----
    ``getBandpasses`` gives the zero point for the collecting area, ``getSkyLevel`` the zodiacal light at its default
    place (ecliptic latitude 30 deg, 90 deg from the Sun), to which ``stray_light_fraction`` is added; the thermal
    background counts as dark current.  Time, read noise and the number of dithers are its constants.

    The zero point of Vega is that of GalSim's spectrum of it.

    References
    ----------
    Rowe2015
    """
    import galsim  # noqa: PLC0415  (half a second, where it is used only)
    import galsim.roman as roman  # noqa: PLC0415  (half a second, where it is used only)

    bandpass = roman.getBandpasses(AB_zeropoint=True)[band]
    vega = galsim.SED("vega.txt", wave_type="nm", flux_type="flambda").calculateMagnitude(bandpass)
    return Exposures(
        name=f"Roman WFI, {band}",
        zero_point=float(bandpass.zeropoint + 2.5 * math.log10(roman.collecting_area)),
        time=roman.exptime,
        sky=float(roman.getSkyLevel(bandpass, exptime=1.0) * (1 + roman.stray_light_fraction)),
        dark=roman.dark_current + roman.thermal_backgrounds[band],
        read_noise=roman.read_noise,
        pixel=roman.pixel_scale,
        n_exposures=roman.n_dithers,
        saturation=ROMAN_SATURATION,
        area=roman.n_sca * (roman.n_pix * roman.pixel_scale / 3600) ** 2,
        band=f"roman_F{band[1:].zfill(3)}",
        vega_ab=float(vega),
        source="galsim.roman (GalSim 2.8); saturation: one secondary source without a date [?]",
    )


EXPOSURES: dict[str, Callable[[], Exposures]] = {
    "euclid-vis": lambda: EUCLID_VIS_WIDE,
    "roman-h158": roman_exposures,
}
"""Every set of exposures that has a name, by the name of its survey, and how it is made."""
