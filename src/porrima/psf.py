"""PSFs of one name each: the single door through which any GalSim profile enters."""

from __future__ import annotations

from dataclasses import dataclass
from difflib import get_close_matches
from typing import TYPE_CHECKING, Any

import galsim

from porrima.errors import InputError

if TYPE_CHECKING:
    from collections.abc import Callable

__all__ = ["EXTENT_PER_FWHM", "GRID_SCALE", "GSPARAMS", "PSF", "PSFS", "psf_from_name", "sheared_gaussian"]

GRID_SCALE = 0.1 / 12
"""Coarsest grid on which a PSF is drawn, in arcsec: a VIS pixel sampled 12 times finer (KCM16)."""

GRID_PER_FWHM = 16
"""Fewest pixels across the full width at half maximum, so that sums over pixels are integrals (count)."""

EXTENT_PER_FWHM = 6.0
"""Half width of a stamp over the FWHM, where no extent is given: 14 sigma of a Gaussian (dimensionless)."""

GSPARAMS = galsim.GSParams(
    folding_threshold=1e-8, maxk_threshold=1e-8, xvalue_accuracy=1e-12, kvalue_accuracy=1e-12
)
"""GalSim's accuracy for the analytic presets."""

TABLE_2_FWHM = 0.137
"""FWHM of the three Gaussian PSFs of KCM16, in arcsec."""


@dataclass(frozen=True, slots=True, kw_only=True)
class PSF:
    """Point spread function: a name and an immutable GalSim profile, exact as given, no pixel added.

    Parameters
    ----------
    name : str
        As the option ``--psf`` takes it.
    profile : galsim.GSObject
        Surface brightness, x with the columns and y with the rows upwards, in arcsec.
    extent : float, optional
        Half width of the stamp on which it is drawn, in arcsec; `EXTENT_PER_FWHM` times the FWHM where
        not given, which leaves out less than 1e-20 of a Gaussian.  A profile with wings needs its own.
    """

    name: str
    profile: Any
    extent: float | None = None

    @property
    def fwhm(self) -> float:
        """Full width at half maximum as GalSim finds it, good to 1e-3, in arcsec."""
        return float(self.profile.calculateFWHM())

    @property
    def scale(self) -> float:
        """Side of a pixel of the grid on which the PSF is drawn, in arcsec."""
        return min(GRID_SCALE, self.fwhm / GRID_PER_FWHM)

    def draw(self, profile: Any = None, margin: float = 0.0) -> Any:
        """Image of the PSF, or of another profile on the grid of the PSF.

        Parameters
        ----------
        profile : galsim.GSObject, optional
            What to draw; the PSF itself where not given.
        margin : float
            Added to the half width of the stamp, in arcsec.

        Returns
        -------
        image : galsim.ImageD
            Odd number of pixels a side, the origin of the profile at ``true_center``, ``scale`` in arcsec.

        Notes
        -----
        Sampled at the centres of pixels (``no_pixel``) in float64; for the Gaussian presets to 1e-12.
        """
        fwhm = self.fwhm
        scale = min(GRID_SCALE, fwhm / GRID_PER_FWHM)
        extent = EXTENT_PER_FWHM * fwhm if self.extent is None else self.extent
        size = 2 * round((extent + margin) / scale) + 1
        drawn = self.profile if profile is None else profile
        return drawn.drawImage(nx=size, ny=size, scale=scale, method="no_pixel", dtype=float)


def sheared_gaussian(name: str, e1: float, e2: float, fwhm: float = TABLE_2_FWHM) -> PSF:
    r"""Gaussian PSF sheared at constant area.

    Parameters
    ----------
    name : str
        Its name.
    e1, e2 : float
        Distortion, dimensionless.
    fwhm : float
        FWHM before the shear, in arcsec.

    Returns
    -------
    psf : PSF
        With :math:`R_0^2 = 2 \sigma^2 / \sqrt{1 - e_1^2 - e_2^2}`.

    Notes
    -----
    GalSim's ``Shear(e1=, e2=)`` is the distortion :math:`(Q_{11} - Q_{22}) / (Q_{11} + Q_{22})`, its
    ``Shear(g1=, g2=)`` the reduced shear.

    References
    ----------
    KCM16, Table 2
    """
    round_psf = galsim.Gaussian(fwhm=fwhm, gsparams=GSPARAMS)
    return PSF(name=name, profile=round_psf.shear(galsim.Shear(e1=e1, e2=e2)))


PSFS: dict[str, Callable[[], PSF]] = {  # KCM16, Table 2
    "psf0": lambda: sheared_gaussian("psf0", 0.0, 0.0),
    "psf1": lambda: sheared_gaussian("psf1", 0.054, -0.003),
    "psf2": lambda: sheared_gaussian("psf2", -0.021, 0.045),
}
"""Every PSF that has a name, and how it is made."""


def psf_from_name(name: str) -> PSF:
    """PSF of a given name.

    Parameters
    ----------
    name : str
        A key of `PSFS`.

    Returns
    -------
    psf : PSF
        Made anew; equal names give equal PSFs.

    Raises
    ------
    InputError
        If no PSF has that name.
    """
    if name not in PSFS:
        near = get_close_matches(name, PSFS, n=1, cutoff=0.0)[0]
        raise InputError(f"must be one of {', '.join(PSFS)} (nearest: {near})", key="psf", value=name)
    return PSFS[name]()
