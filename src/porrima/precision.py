"""How well the shape of one star is measured against its noise: what a clip by shape has to live with."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import numpy as np

from porrima.pointings import HALF_WIDTH, dither_pattern, pointings
from porrima.shapes import Adaptive, GaussianWeight, Plain
from porrima.stamps import measure_stamps

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from porrima.exposure import Exposures
    from porrima.psf import PSF
    from porrima.shapes import Estimator

    FloatArray = NDArray[np.float64]

__all__ = ["ShapeNoise", "influence", "shape_noise"]

STARS = 8
"""Places in the pixel over which the variance is averaged (count)."""

WEIGHT_SIGMAS = 5.0
"""Half width of a stamp in sigmas of a fixed weight: 1e-5 of the weight lies beyond (dimensionless)."""

STEP = 1e-4
"""Step of the differences that stand for derivatives, over the size (dimensionless)."""


@dataclass(frozen=True, slots=True, kw_only=True)
class ShapeNoise:
    r"""Standard deviation of the shape of a single star, the mean over its exposures.

    Parameters
    ----------
    exposures : Exposures
        Flux and noise.
    estimator : str
        Its name.
    from_star, from_background : (3,) float array
        Variances of e1, e2 and R²/R0² for one electron of star and of background: a and b in the formula,
        dimensionless.

    Notes
    -----
    :math:`\sigma^2 = (a / F + b B / F^2) / n` for n exposures of F electrons and the variance B of a pixel without a
    star.  First order in the noise: for stars of which the flux is measured to 5 % or better.
    """

    exposures: Exposures
    estimator: str
    from_star: FloatArray
    from_background: FloatArray

    def _sigma(self, magnitude: FloatArray, which: slice, n_exposures: int | None) -> FloatArray:
        flux = self.exposures.electrons(magnitude)
        n = self.exposures.n_exposures if n_exposures is None else n_exposures
        a, b = self.from_star[which].mean(), self.from_background[which].mean()
        return np.asarray(np.sqrt((a / flux + b * self.exposures.background / flux**2) / n))

    def sigma_e(self, magnitude: FloatArray, n_exposures: int | None = None) -> FloatArray:
        """Standard deviation of one component of the ellipticity.

        Parameters
        ----------
        magnitude : (n,) float array
            In mag.
        n_exposures : int, optional
            Of which the mean is taken (count); all where not given.

        Returns
        -------
        sigma_e : (n,) float array
            Rms over e1 and e2, dimensionless.
        """
        return self._sigma(magnitude, slice(0, 2), n_exposures)

    def sigma_r2(self, magnitude: FloatArray, n_exposures: int | None = None) -> FloatArray:
        """Standard deviation of R² over that of the PSF.

        Parameters
        ----------
        magnitude : (n,) float array
            In mag.
        n_exposures : int, optional
            Of which the mean is taken (count); all where not given.

        Returns
        -------
        sigma_r2 : (n,) float array
            Dimensionless.
        """
        return self._sigma(magnitude, slice(2, 3), n_exposures)


def influence(image: FloatArray, pixel: float, estimator: Estimator) -> FloatArray:
    r"""First-order change of a measured shape by a change of each pixel.

    Parameters
    ----------
    image : (ny, nx) float array
        A star without noise, of unit flux or nearly so, dimensionless.
    pixel : float
        Side of a pixel, in arcsec.
    estimator : Estimator
        `Adaptive`, `GaussianWeight` or `Plain`.

    Returns
    -------
    influence : (3, ny, nx) float array
        Of e1, e2 and R²/R0², dimensionless.

    Raises
    ------
    ValueError
        If the star cannot be measured.

    Notes
    -----
    The centroid and the second moments Q solve :math:`\sum I w (y, y y^\mathsf{T} - k Q) = 0`, with k = 1/2 and the
    weight w of covariance Q for adaptive moments, k = 1 and a weight of its own otherwise.  With :math:`\psi` a
    term of the sum and A its derivative with respect to (centroid, Q), a change :math:`\delta I` of a pixel moves
    these by :math:`-A^{-1} \psi\, \delta I`.
    """
    found = measure_stamps(image[None], pixel, estimator)
    if found.shape.flag[0]:
        raise ValueError(f"image must be one that {estimator.name} measures, got flag {found.shape.flag[0]}")
    solution = np.array([found.x[0], found.y[0], *found.shape.covariance()[0]])
    size = solution[2] + solution[4]
    steps = STEP * np.array([size**0.5, size**0.5, size, size, size])
    slopes = [
        (_terms(image, pixel, estimator, solution + d) - _terms(image, pixel, estimator, solution - d)) @ image.ravel()
        for d in np.diag(steps)
    ]
    jacobian = np.array(slopes).T / (2 * steps)
    moved = -np.linalg.solve(jacobian, _terms(image, pixel, estimator, solution))
    q11, q12, q22 = solution[2:]
    e1, e2 = (q11 - q22) / size, 2 * q12 / size
    to_shape = np.array([[1 - e1, 0, -1 - e1], [-e2, 2, -e2], [1, 0, 1]]) / size
    return np.asarray(to_shape @ moved[2:]).reshape(3, *image.shape)


def _terms(image: FloatArray, pixel: float, estimator: Estimator, solution: FloatArray) -> FloatArray:
    """What each pixel is multiplied with in the five equations of an estimator, (5, n_pixel)."""
    ny, nx = image.shape
    x0, y0, q11, q12, q22 = solution
    x, y = np.meshgrid((np.arange(nx) - (nx - 1) / 2) * pixel - x0, (np.arange(ny) - (ny - 1) / 2) * pixel - y0)
    k = 1.0
    if isinstance(estimator, Adaptive):
        k = 0.5
        weight = np.exp(-0.5 * (q22 * x**2 - 2 * q12 * x * y + q11 * y**2) / (q11 * q22 - q12**2))
    elif isinstance(estimator, GaussianWeight):
        weight = np.exp(-0.5 * (x**2 + y**2) / estimator.sigma**2)
    elif isinstance(estimator, Plain) and estimator.aperture is not None:
        weight = estimator.weight(x[0], y[:, 0])
    else:
        weight = np.ones_like(x)
    terms = [x, y, x * x - k * q11, x * y - k * q12, y * y - k * q22]
    return np.stack([(weight * term).ravel() for term in terms])


def shape_noise(psf: PSF, exposures: Exposures, estimator: Estimator) -> ShapeNoise:
    """Standard deviation of the shape of single stars against magnitude.

    Parameters
    ----------
    psf : PSF
        Effective: convolved with the pixel.
    exposures : Exposures
        Flux and noise.
    estimator : Estimator
        Measures every exposure; the mean is taken.

    Returns
    -------
    noise : ShapeNoise
        Averaged over the place of a star in its pixel.
    """
    wide = WEIGHT_SIGMAS * estimator.sigma if isinstance(estimator, GaussianWeight) else estimator.reach
    star = pointings(psf, exposures.pixel, dither_pattern(1), half_width=max(HALF_WIDTH, wide))
    from_star, from_background = np.zeros(3), np.zeros(3)
    for phase in range(STARS):
        here = replace(star, place=dither_pattern(1, phase))
        image = here.images(np.zeros(1), np.zeros(1)).reshape(star.side, star.side)
        square = influence(image, exposures.pixel, estimator) ** 2
        from_star += (square * np.maximum(image, 0.0)).sum(axis=(1, 2)) / STARS
        from_background += square.sum(axis=(1, 2)) / STARS
    return ShapeNoise(
        exposures=exposures, estimator=estimator.name, from_star=from_star, from_background=from_background
    )
