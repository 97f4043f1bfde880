"""Stacks drawn with GalSim and measured on their pixels: the check that shares nothing with `response`."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import galsim
import numpy as np

from porrima.reach import settled, stamp_reach

if TYPE_CHECKING:
    from porrima.psf import PSF
    from porrima.shapes import Estimator, Shape
    from porrima.systems import Systems

__all__ = ["draw_stack", "measure_stack"]


def draw_stack(psf: PSF, systems: Systems, reach: float = 0.0) -> Any:
    """Image of a stack of systems, each centred on its own flux centroid.

    Parameters
    ----------
    psf : PSF
        Drawn once for every source.
    systems : Systems
        The stars of the stack and their weights.
    reach : float
        Least half width of the stamp of the PSF alone, in arcsec.

    Returns
    -------
    image : galsim.ImageD
        Of total flux 1; its ``scale`` is in arcsec, the flux centroids are at ``true_center``.

    Notes
    -----
    One sum of shifted profiles, in float64.  Sources at one place, as all single stars are, are drawn once.
    The sources are not added with ``drawImage(add_to_image=True)``, for GalSim then goes through float32.
    """
    share = (systems.flux * (systems.weight / systems.weight.sum())[:, None]).ravel()
    places = np.column_stack([systems.x.ravel(), systems.y.ravel()])[share > 0]
    unique, which = np.unique(places, axis=0, return_inverse=True)
    flux = np.bincount(which.ravel(), weights=share[share > 0])
    sources = [psf.profile.shift(x, y) * f for (x, y), f in zip(unique.tolist(), flux.tolist(), strict=True)]
    return psf.draw(galsim.Sum(sources), margin=float(np.abs(unique).max()), reach=reach)


def measure_stack(psf: PSF, systems: Systems, estimator: Estimator) -> Shape:
    """Shape of a stack of systems, measured on its image.

    Parameters
    ----------
    psf : PSF
        Drawn once for every source.
    systems : Systems
        The stars of the stack and their weights.
    estimator : Estimator
        How it is measured: plain moments that diverge, as `settled` says.

    Returns
    -------
    shape : Shape
        Of 0-d arrays; r2 in arcsec².

    Notes
    -----
    Changes of shape are differences from `Estimator.measure` of the PSF's own image, measured alike.

    References
    ----------
    Rowe2015, Hirata2003
    """
    estimator = settled(estimator, psf)
    return estimator.measure(draw_stack(psf, systems, stamp_reach(estimator, psf)))
