"""Stars on a detector's pixels: what sampling, the place in a pixel and the centring do to a change of shape."""

from __future__ import annotations

import dataclasses
from typing import TYPE_CHECKING, Any

import galsim
import numpy as np
import xarray as xr

from porrima.images import draw_stack
from porrima.stamps import measure_stamps

if TYPE_CHECKING:
    from porrima.psf import PSF
    from porrima.shapes import Estimator
    from porrima.systems import Systems

__all__ = ["on_pixels", "recentred"]

HALF_WIDTH = 2.0
"""Half width of a stamp of survey pixels, in arcsec."""


def on_pixels(
    psf: PSF,
    systems: Systems,
    estimator: Estimator,
    pixel_scale: float,
    *,
    phases: int = 4,
    half_width: float = HALF_WIDTH,
) -> xr.Dataset:
    """Change of shape of a stack that is drawn on survey pixels, for places of the star in its pixel.

    Parameters
    ----------
    psf : PSF
        Effective: with its pixel, where it is to have one.
    systems : Systems
        The stars of the stack, all at the same place in their pixel.
    estimator : Estimator
        How the pixels are measured.
    pixel_scale : float
        Side of a survey pixel, in arcsec.
    phases : int
        Places along x and along y, evenly over the pixel (count).
    half_width : float
        Of the stamp, in arcsec.

    Returns
    -------
    changes : Dataset
        ``de1``, ``de2``, ``dr2_rel`` and, of the PSF alone, ``e1_0``, ``e2_0``, ``r2_0`` [arcsec²] over
        ``x`` and ``y`` [pixels]; NaN where either cannot be measured.

    Notes
    -----
    Drawn with GalSim at the centres of the pixels and measured with `stamps`: sums over pixels that need
    not be integrals.
    """
    places = (np.arange(phases) + 0.5) / phases - 0.5
    alone = _only(psf, pixel_scale, half_width, places, [psf.profile])
    share = (systems.flux * (systems.weight / systems.weight.sum())[:, None]).ravel()
    sources = [
        psf.profile.shift(float(x), float(y)) * float(f)
        for x, y, f in zip(systems.x.ravel(), systems.y.ravel(), share, strict=True)
        if f > 0
    ]
    stack = _only(psf, pixel_scale, half_width, places, sources)
    shape, shape0 = (
        measure_stamps(pixels, pixel_scale, estimator, guess_sigma=psf.fwhm / 2).shape
        for pixels in (stack, alone)
    )
    grid = {"y": places, "x": places}

    def on_grid(values: Any) -> tuple[tuple[str, str], Any]:
        return ("y", "x"), np.reshape(values, (phases, phases))

    return xr.Dataset(
        {
            "de1": on_grid(shape.e1 - shape0.e1),
            "de2": on_grid(shape.e2 - shape0.e2),
            "dr2_rel": on_grid(shape.r2 / shape0.r2 - 1),
            "e1_0": on_grid(shape0.e1),
            "e2_0": on_grid(shape0.e2),
            "r2_0": on_grid(shape0.r2),
        },
        coords=grid,
        attrs={"psf": psf.name, "estimator": estimator.name, "pixel_scale": pixel_scale},
    )


def _only(psf: PSF, scale: float, half_width: float, places: Any, sources: list[Any]) -> Any:
    """Stamps of a sum of sources at each place of its centroid in the pixel, (phases², ny, nx)."""
    size = 2 * round(half_width / scale) + 1
    profile = galsim.Sum(sources)
    return np.stack(
        [
            profile.shift(x * scale, y * scale)
            .drawImage(nx=size, ny=size, scale=scale, method="no_pixel", dtype=float)
            .array
            for y in places.tolist()
            for x in places.tolist()
        ]
    )


def recentred(psf: PSF, systems: Systems, estimator: Estimator) -> Systems:
    """Systems centred on what an estimator takes for their centroids, as the paper stacks its stars.

    Parameters
    ----------
    psf : PSF
        Drawn once for every source.
    systems : Systems
        Each centred on its flux centroid.
    estimator : Estimator
        With its own weighted centroid; for plain moments without an aperture that is the flux centroid.

    Returns
    -------
    systems : Systems
        Moved, and all moved back by the stack's mean shift, which changes no shape.

    Notes
    -----
    The shift is of third order in the separation, so the second moments that it adds to the stack are of
    sixth order.
    """
    shift = np.zeros((len(systems), 2))
    origin = _centroid(psf, dataclasses.replace(systems, **_first(systems, 0, alone=True)), estimator)
    for i in np.flatnonzero((systems.flux > 0).sum(axis=1) > 1).tolist():
        shift[i] = _centroid(psf, dataclasses.replace(systems, **_first(systems, i)), estimator) - origin
    shift -= np.average(shift, axis=0, weights=systems.weight)
    return dataclasses.replace(systems, x=systems.x - shift[:, :1], y=systems.y - shift[:, 1:])


def _first(systems: Systems, i: int, *, alone: bool = False) -> dict[str, Any]:
    """Columns of one system, or of a star at the origin."""
    one = slice(i, i + 1)
    if alone:
        flux = np.zeros_like(systems.flux[one])
        flux[:, 0] = 1.0
        zero = np.zeros_like(flux)
        return {"flux": flux, "x": zero, "y": zero, "weight": np.ones(1)}
    return {
        "flux": systems.flux[one],
        "x": systems.x[one],
        "y": systems.y[one],
        "weight": np.ones(1),
    }


def _centroid(psf: PSF, system: Systems, estimator: Estimator) -> Any:
    """Measured centroid of one system, in arcsec from the origin of the profile."""
    image = draw_stack(psf, system)
    found = measure_stamps(image.array[None], image.scale, estimator)
    return np.array([found.x[0], found.y[0]])
