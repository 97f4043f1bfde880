"""Sources on the pixels of dithered and rolled exposures, behind an effective PSF known everywhere."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np
from numba import njit, prange
from scipy.ndimage import spline_filter

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from porrima.psf import PSF

    FloatArray = NDArray[np.float64]

__all__ = ["Pointings", "dither_pattern", "pointings"]

HALF_WIDTH = 0.75
"""Half width of a stamp, in arcsec: beyond it lies 0.7 % of the misfit of a close pair behind VIS."""

REACH = 0.4
"""Largest distance of a source from the reference star, in arcsec."""

STEP = 0.002
"""Step of the differences that stand for derivatives, in arcsec: good to 1e-3 of a second derivative."""

R2_SEQUENCE = (0.7548776662466927, 0.5698402909980532)
"""Steps of the two-dimensional sequence of Roberts: any number of its points covers a pixel evenly."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Pointings:
    """Places of one star in the pixels of its exposures, and the PSF there.

    Parameters
    ----------
    coefficients : (n, n, m, m) float array
        Of the quintic spline through the effective PSF times the area of a pixel, n samples per pixel a side: those
        one pixel apart lie together (dimensionless).
    pixel : float
        Side of a pixel, in arcsec.
    side : int
        Of a stamp, odd, in pixels.
    place : (n_exposure, 2) float array
        Of the star from the centre of the middle pixel in each exposure, along its columns and rows, in pixels.
    roll : (n_exposure,) float array
        Angle by which the detector, and the PSF with it, is turned from the first exposure's, in rad.
    """

    coefficients: FloatArray
    pixel: float
    side: int
    place: FloatArray
    roll: FloatArray

    def images(self, x: FloatArray, y: FloatArray) -> FloatArray:
        """Stamps of sources of unit flux.

        Parameters
        ----------
        x, y : (n,) float array
            Of each source from the star on the sky, within `REACH`, in arcsec.

        Returns
        -------
        images : (n, n_exposure * side²) float array
            Share of the flux in each pixel, dimensionless.
        """
        x, y = np.atleast_1d(x), np.atleast_1d(y)
        cosine, sine = np.cos(self.roll), np.sin(self.roll)
        column = self.place[:, 0] + (np.outer(x, cosine) + np.outer(y, sine)) / self.pixel
        row = self.place[:, 1] + (np.outer(y, cosine) - np.outer(x, sine)) / self.pixel
        out = np.empty((x.size, self.roll.size, self.side, self.side))
        _draw(self.coefficients, column, row, out)
        return out.reshape(x.size, -1)

    def derivatives(self) -> FloatArray:
        """Image of the star and its derivatives with respect to its place.

        Returns
        -------
        images : (6, n_exposure * side²) float array
            The star [dimensionless], x, y [arcsec^-1], xx, xy, yy [arcsec^-2].
        """
        h = STEP
        offsets = [(0, 0), (h, 0), (-h, 0), (0, h), (0, -h), (h, h), (h, -h), (-h, h), (-h, -h)]
        o, e, w, n, s, ne, se, nw, sw = self.images(*np.array(offsets).T)
        second = [(e - 2 * o + w) / h**2, (ne - se - nw + sw) / (4 * h**2), (n - 2 * o + s) / h**2]
        return np.stack([o, (e - w) / (2 * h), (n - s) / (2 * h), *second])


@njit(inline="always")
def _spline_weights(t, w):  # type: ignore[no-untyped-def]
    """Write the values of the quintic B-spline at the six samples about a point; t in [0, 1) from the third."""
    for k in range(6):
        x = abs(t - (k - 2))
        if x < 1.0:
            w[k] = 0.55 + x * x * (-0.5 + x * x * (0.25 - x / 12.0))
        elif x < 2.0:
            w[k] = 0.425 + x * (0.625 + x * (-1.75 + x * (1.25 + x * (-0.375 + x / 24.0))))
        else:
            v = 3.0 - x
            w[k] = v * v * v * v * v / 120.0


@njit(cache=True, parallel=True, error_model="numpy", fastmath={"contract", "reassoc"})
def _draw(coefficients, column, row, out):  # type: ignore[no-untyped-def]
    """Fill stamps (source, exposure, row, column): all pixels of a stamp share the weights of the spline."""
    n, side = coefficients.shape[0], out.shape[2]
    middle = 0.5 * (n * coefficients.shape[2] - 1)
    for i in prange(out.shape[0]):
        wx, wy = np.empty(6), np.empty(6)
        for e in range(out.shape[1]):
            start_x = middle - n * (side // 2 + column[i, e])
            start_y = middle - n * (side // 2 + row[i, e])
            jx, jy = math.floor(start_x), math.floor(start_y)
            _spline_weights(start_x - jx, wx)
            _spline_weights(start_y - jy, wy)
            stamp = out[i, e]
            stamp[:] = 0.0
            for ky in range(6):
                y = jy + ky - 2
                for kx in range(6):
                    x, weight = jx + kx - 2, wy[ky] * wx[kx]
                    for r in range(side):
                        line, samples = stamp[r], coefficients[y % n, x % n, y // n + r, x // n :]
                        for c in range(side):
                            line[c] += weight * samples[c]


def dither_pattern(n_exposures: int, phase: int = 0) -> FloatArray:
    """Places of a star in the pixels of dithered exposures.

    Parameters
    ----------
    n_exposures : int
        Exposures (count).
    phase : int
        Which of many stars, each somewhere else in its pixels.

    Returns
    -------
    place : (n_exposures, 2) float array
        From the centre of a pixel, in [-0.5, 0.5) pixels; points of one sequence that covers the pixel evenly.
    """
    number = np.arange(n_exposures) + phase * n_exposures
    return np.asarray((0.5 + np.outer(number, R2_SEQUENCE)) % 1.0 - 0.5)


def pointings(
    psf: PSF,
    pixel: float,
    place: FloatArray,
    roll: FloatArray | None = None,
    half_width: float = HALF_WIDTH,
) -> Pointings:
    """Pointings of one star.

    Parameters
    ----------
    psf : PSF
        Effective: convolved with the pixel.
    pixel : float
        Side of a pixel, in arcsec.
    place : (n_exposure, 2) float array
        Of the star from the centre of the middle pixel, in pixels.
    roll : (n_exposure,) float array, optional
        Turn of the detector, in rad; none where not given.
    half_width : float
        Least half width of a stamp, in arcsec.

    Returns
    -------
    pointings : Pointings
        With the spline of the PSF; `dataclasses.replace` gives another star its places.
    """
    half = math.ceil(half_width / pixel)
    return Pointings(
        coefficients=_spline(psf, pixel, half),
        pixel=pixel,
        side=2 * half + 1,
        place=np.asarray(place, dtype=float),
        roll=np.zeros(len(place)) if roll is None else np.asarray(roll, dtype=float),
    )


def _spline(psf: PSF, pixel: float, half: int) -> FloatArray:
    """Coefficients of the quintic spline through the effective PSF on a grid finer than pixels."""
    n, m = math.ceil(pixel / psf.scale), 2 * (half + math.ceil(REACH / pixel) + 3)
    image = psf.profile.drawImage(nx=n * m, ny=n * m, scale=pixel / n, method="no_pixel", dtype=float)
    fine: Any = spline_filter(image.array * n**2, order=5, mode="mirror")
    return np.ascontiguousarray(fine.reshape(m, n, m, n).transpose(1, 3, 0, 2))
