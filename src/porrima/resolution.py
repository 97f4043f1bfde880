"""Galaxies as a method sees them that subtracts the moments of the PSF, as REGAUSS does."""

from __future__ import annotations

import math
from dataclasses import replace
from typing import TYPE_CHECKING, Any

import galsim
import numpy as np
from scipy.interpolate import CubicSpline

from porrima.galaxies import SERSIC, regauss_r2

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from porrima.galaxies import Galaxies
    from porrima.psf import PSF

    FloatArray = NDArray[np.float64]

__all__ = ["seen_by_regauss"]

_SIZES = 7  # nodes in log size, where there are more galaxies than that
_PIXELS_PER_FWHM = 5.0  # of the images that are measured
_REACH = 6.0  # FWHM of the PSF and half-light radii of the galaxy in half a stamp
_HSM = galsim.hsm.HSMParams(nsig_rg=10, nsig_rg2=10, max_mom2_iter=2000)  # no pixel of the wings left out
_ACCURACY = galsim.GSParams(folding_threshold=1e-3, maxk_threshold=1e-4, maximum_fft_size=16384)


def seen_by_regauss(galaxies: Galaxies, psf: PSF) -> Galaxies | None:
    r"""Galaxies with the sizes that re-Gaussianization divides by.

    Parameters
    ----------
    galaxies : Galaxies
        Sizes in arcsec² and profile before the PSF.
    psf : PSF
        With its pixel, if any.

    Returns
    -------
    seen : Galaxies or None
        For `shear.moments_bias`, the weights as they were; None where REGAUSS does not resolve one of them.

    Notes
    -----
    Round galaxies are drawn behind the PSF and re-Gaussianized: the residual of the PSF from its adaptive Gaussian,
    convolved with a Gaussian of the galaxy's width, is taken off.  The adaptive moments of what is left go into
    `galaxies.regauss_r2`.  Gaussian galaxies keep their size.

    References
    ----------
    Hirata2003, Rowe2015
    """
    if galaxies.index == SERSIC["gaussian"]:
        return galaxies
    log_size = np.log(galaxies.half_light_radius)
    unique = np.unique(log_size)
    nodes = unique if unique.size <= _SIZES else np.linspace(unique[0], unique[-1], _SIZES)
    seen = np.array([_seen_r2(psf, galaxies.index, float(np.exp(node))) for node in nodes])
    if not np.all(seen > 0):
        return None
    if nodes.size == unique.size:
        return replace(galaxies, r2=seen[np.searchsorted(unique, log_size)])
    return replace(galaxies, r2=np.exp(CubicSpline(nodes, np.log(seen))(log_size)))


def _seen_r2(psf: PSF, index: float, radius: float) -> float:
    """Size of one round galaxy in arcsec², NaN where it cannot be measured."""
    narrow = psf.profile.withGSParams(_ACCURACY)
    scale = psf.fwhm / _PIXELS_PER_FWHM
    size = 2 * round(_REACH * (psf.fwhm + radius) / scale) + 1

    def drawn(profile: Any) -> Any:
        return profile.drawImage(nx=size, ny=size, scale=scale, method="no_pixel", dtype=float)

    image = drawn(galsim.Convolve(galsim.Sersic(index, half_light_radius=radius), narrow))
    star, galaxy = _moments(drawn(narrow)), _moments(image)
    if star is None or galaxy is None or galaxy.moments_sigma <= star.moments_sigma:
        return math.nan
    width = math.sqrt(galaxy.moments_sigma**2 - star.moments_sigma**2) * scale
    core = galsim.Gaussian(sigma=width, flux=galaxy.moments_amp * galaxy.moments_rho4 / 2)
    e1, e2 = star.observed_shape.e1, star.observed_shape.e2
    fitted = galsim.Gaussian(sigma=star.moments_sigma * scale).shear(e1=e1, e2=e2)
    image += drawn(galsim.Convolve(core, fitted)) - drawn(galsim.Convolve(core, narrow))
    again = _moments(image)
    if again is None:
        return math.nan
    observed, behind = (2 * (one.moments_sigma * scale) ** 2 for one in (again, star))
    return float(regauss_r2(np.array(observed), behind, np.array(again.moments_rho4 / 2 - 1)))


def _moments(image: Any) -> Any:
    """Adaptive moments of an image, None where there are none."""
    found = galsim.hsm.FindAdaptiveMom(image, hsmparams=_HSM, strict=False)
    return None if found.error_message else found
