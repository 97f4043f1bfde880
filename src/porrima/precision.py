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

__all__ = [
    "MAGNITUDES", "ShapeNoise", "covariance_at", "fitted_covariance", "fitted_noise", "influence",
    "measured_covariance", "measured_noise",
]  # fmt: skip

STARS = 8
"""Places in the pixel over which variances are averaged (count)."""

WEIGHT_SIGMAS = 5.0
"""Half width of a stamp in sigmas of a fixed weight: 1e-5 of the weight lies beyond (dimensionless)."""

STEP = 1e-4
"""Step of the differences that stand for derivatives, over the size (dimensionless)."""

MAGNITUDES = np.linspace(12.0, 28.0, 65)
"""Where variances are tabulated, in mag: the logarithm is good to 1e-3 between."""


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class ShapeNoise:
    """Standard deviation of the shape of a single star against magnitude, all exposures together.

    Parameters
    ----------
    name : str
        What measures, and on what.
    variance_e, variance_r2 : (n,) float array
        At `MAGNITUDES`: mean of the variances of e1 and e2, and that of R²/R0², dimensionless.
    """

    name: str
    variance_e: FloatArray
    variance_r2: FloatArray

    def sigma_e(self, magnitude: FloatArray) -> FloatArray:
        """Standard deviation of one component of the ellipticity.

        Parameters
        ----------
        magnitude : (n,) float array
            Of the star, in mag.

        Returns
        -------
        sigma_e : (n,) float array
            Dimensionless.
        """
        return np.asarray(np.exp(0.5 * np.interp(magnitude, MAGNITUDES, np.log(self.variance_e))))

    def sigma_r2(self, magnitude: FloatArray) -> FloatArray:
        """Standard deviation of R² over that of the PSF.

        Parameters
        ----------
        magnitude : (n,) float array
            Of the star, in mag.

        Returns
        -------
        sigma_r2 : (n,) float array
            Dimensionless.
        """
        return np.asarray(np.exp(0.5 * np.interp(magnitude, MAGNITUDES, np.log(self.variance_r2))))


def influence(
    image: FloatArray, pixel: float, estimator: Estimator, guess_sigma: float | None = None
) -> FloatArray:
    r"""First-order change of a measured shape by a change of each pixel.

    Parameters
    ----------
    image : (ny, nx) float array
        A star without noise, of unit flux or nearly so, dimensionless.
    pixel : float
        Side of a pixel, in arcsec.
    estimator : Estimator
        `Adaptive`, `GaussianWeight` or `Plain`.
    guess_sigma : float, optional
        Sigma from which adaptive weights start, in arcsec; see `measure_stamps`.

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
    found = measure_stamps(image[None], pixel, estimator, guess_sigma)
    if found.shape.flag[0]:
        raise ValueError(f"image must be one that {estimator.name} measures, got flag {found.shape.flag[0]}")
    solution = np.array([found.x[0], found.y[0], *found.shape.covariance()[0]])
    size = solution[2] + solution[4]
    steps = STEP * np.array([size**0.5, size**0.5, size, size, size])
    slopes = [
        (_terms(image, pixel, estimator, solution + d) - _terms(image, pixel, estimator, solution - d))
        @ image.ravel()
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
    x, y = np.meshgrid(
        (np.arange(nx) - (nx - 1) / 2) * pixel - x0, (np.arange(ny) - (ny - 1) / 2) * pixel - y0
    )
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


def measured_noise(psf: PSF, exposures: Exposures, estimator: Estimator) -> ShapeNoise:
    r"""Noise of shapes that an estimator measures on the pixels of every exposure, their mean taken.

    Parameters
    ----------
    psf : PSF
        Effective: convolved with the pixel.
    exposures : Exposures
        Flux and noise.
    estimator : Estimator
        On survey pixels: HSM's adaptive weight collapses on stars as undersampled as Euclid's and Roman's.

    Returns
    -------
    noise : ShapeNoise
        Averaged over the place of a star in its pixel.

    Raises
    ------
    ValueError
        If the estimator cannot measure a star on such pixels.

    Notes
    -----
    The diagonal of `measured_covariance`.
    """
    return _noise(f"{estimator.name}, {exposures.name}", measured_covariance(psf, exposures, estimator))


def measured_covariance(psf: PSF, exposures: Exposures, estimator: Estimator) -> FloatArray:
    r"""Covariance of the noise of shapes that an estimator measures on the pixels of every exposure, their mean taken.

    Parameters
    ----------
    psf, exposures, estimator
        As for `measured_noise`.

    Returns
    -------
    covariance : (n, 3, 3) float array
        Of e1, e2 and R² over R0² at `MAGNITUDES`, dimensionless.

    Raises
    ------
    ValueError
        If the estimator cannot measure a star on such pixels.

    Notes
    -----
    With the influence :math:`\psi` of a pixel on the shape of a star P of unit flux and the variance B of a pixel
    without a star, :math:`\sigma^2 = [\sum P \psi^2 / F + B \sum \psi^2 / F^2] / n` for n exposures of F electrons.
    First order in the noise: for stars whose flux is measured to 5 % or better.
    """
    wide = WEIGHT_SIGMAS * estimator.sigma if isinstance(estimator, GaussianWeight) else estimator.reach
    star = pointings(psf, exposures.pixel, dither_pattern(1), half_width=max(HALF_WIDTH, wide))
    from_star, from_background = np.zeros((3, 3)), np.zeros((3, 3))
    for phase in range(STARS):
        here = replace(star, place=dither_pattern(1, phase))
        image = here.images(np.zeros(1), np.zeros(1)).reshape(star.side, star.side)
        each = influence(image, exposures.pixel, estimator, psf.fwhm / 2).reshape(3, -1)
        from_star += (each * np.maximum(image, 0.0).ravel()) @ each.T / STARS
        from_background += each @ each.T / STARS
    flux = exposures.electrons(MAGNITUDES)[:, None, None]
    return np.asarray(
        (from_star / flux + from_background * exposures.background / flux**2) / exposures.n_exposures
    )


def fitted_noise(psf: PSF, exposures: Exposures, r2: float) -> ShapeNoise:
    r"""Noise of the best that can be done: a fit of the known PSF widened by three small second moments.

    Parameters
    ----------
    psf : PSF
        Effective: convolved with the pixel.
    exposures : Exposures
        Flux and noise; all are fitted at once.
    r2 : float
        R² by which the fitted moments are divided, in arcsec².

    Returns
    -------
    noise : ShapeNoise
        Averaged over the place of a star in its pixel.

    Notes
    -----
    The model is :math:`F (P + x \cdot \nabla P + \frac12 q_{ij} \partial_i \partial_j P)`, its six parameters free;
    the inverse of the Fisher matrix holds the variances of :math:`\delta R^2 = q_{xx} + q_{yy}`,
    :math:`\delta e_1 R^2 = q_{xx} - q_{yy}` and :math:`\delta e_2 R^2 = 2 q_{xy}`, which are those of plain moments:
    multiply with the response of an estimator for its change.  It is the noise behind the statistic of `Detection`.
    """
    to_shape = np.array([[1.0, 0.0, -1.0], [0.0, 2.0, 0.0], [1.0, 0.0, 1.0]]) / r2
    return _noise(f"fit, {exposures.name}", to_shape @ fitted_covariance(psf, exposures) @ to_shape.T)


def fitted_covariance(psf: PSF, exposures: Exposures) -> FloatArray:
    """Covariance of the noise of the three second moments of `fitted_noise`.

    Parameters
    ----------
    psf, exposures
        As for `fitted_noise`.

    Returns
    -------
    covariance : (n, 3, 3) float array
        Of qxx, qxy and qyy at `MAGNITUDES`, in arcsec⁴, averaged over the place of a star in its pixel.
    """
    half = np.array([1.0, 1.0, 1.0, 0.5, 1.0, 0.5])[:, None]  # xy and yx are one
    star = pointings(psf, exposures.pixel, dither_pattern(exposures.n_exposures))
    flux = exposures.electrons(MAGNITUDES)
    covariance = np.zeros((flux.size, 3, 3))
    for phase in range(STARS):
        templates = replace(star, place=dither_pattern(exposures.n_exposures, phase)).derivatives() * half
        for k, f in enumerate(flux.tolist()):
            weight = f / (exposures.background / f + np.maximum(templates[0], 0.0))
            covariance[k] += np.linalg.inv((templates * weight) @ templates.T)[3:, 3:] / STARS
    return covariance


def covariance_at(covariance: FloatArray, magnitude: FloatArray) -> FloatArray:
    """Covariances of some magnitudes: the logarithm of each variance is linear between `MAGNITUDES`.

    Parameters
    ----------
    covariance : (n, 3, 3) float array
        At `MAGNITUDES`.
    magnitude : (m,) float array
        In mag.

    Returns
    -------
    covariance : (m, 3, 3) float array
        In the same unit of the first; correlations are linear, too.
    """
    sigma = np.sqrt(np.einsum("nqq->nq", covariance))
    correlation = (covariance / sigma[:, :, None] / sigma[:, None, :]).reshape(-1, 9)
    here = np.exp(np.stack([np.interp(magnitude, MAGNITUDES, np.log(s)) for s in sigma.T], axis=1))
    between = np.stack([np.interp(magnitude, MAGNITUDES, c) for c in correlation.T], axis=1)
    return np.asarray(between.reshape(-1, 3, 3) * here[:, :, None] * here[:, None, :])


def _noise(name: str, covariance: FloatArray) -> ShapeNoise:
    """Of covariances (n, 3, 3) of e1, e2 and R²/R0²."""
    variance = np.einsum("nqq->nq", covariance)
    return ShapeNoise(name=name, variance_e=variance[:, :2].mean(axis=1), variance_r2=variance[:, 2])
