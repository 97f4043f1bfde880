r"""The PSF within a round aperture: integrals, and the plain moments of a stack in closed form.

The functions :math:`\phi = w\,(1, u, v, u^2, uv, v^2)` of `shapes.Plain`, with u and v from the centre of
the aperture, take the place of the Gaussian weight of `response`:
:math:`J_{k,\alpha} = \int \mathrm{PSF}\, \partial^\alpha \phi_k`.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np

from porrima.moments import INDICES, ORDER
from porrima.weighted import Derivatives, half_light_radius, implicit_derivatives

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from porrima.shapes import Plain

    FloatArray = NDArray[np.float64]

__all__ = ["AperturePSF", "aperture_covariance", "aperture_derivatives", "aperture_psf"]

_POWERS = ((0, 0), (1, 0), (0, 1), (2, 0), (1, 1), (0, 2))
_FACTORIALS = np.array([float(math.factorial(a) * math.factorial(b)) for a, b in INDICES])
_STEPS = 50


@dataclass(frozen=True, slots=True, kw_only=True)
class AperturePSF:
    """The PSF within an aperture: all that the measurement of a stack needs to know of the image.

    Parameters
    ----------
    unit : float
        Length in whose powers the rest is given, in arcsec.
    covariance : (3,) float array
        Measured second moments Q11, Q12, Q22 of the PSF, in unit².
    integrals : (6, n, n) float array
        J[k, a, b] over J[0, 0, 0], a + b < n, in powers of the unit.
    """

    unit: float
    covariance: FloatArray
    integrals: FloatArray


def aperture_psf(image: Any, estimator: Plain) -> AperturePSF:
    r"""Fixed point of a PSF in an aperture, and the integrals that belong to it.

    Parameters
    ----------
    image : galsim.Image
        Of the PSF; the aperture must lie inside the stamp.
    estimator : Plain
        With an aperture.

    Returns
    -------
    aperture : AperturePSF
        In units of half the radius of the disc that is brighter than half the maximum.

    Raises
    ------
    ValueError
        If there is no fixed point.

    Notes
    -----
    The derivatives of the smooth and compact :math:`\phi_k` are taken in Fourier space, where the sum over
    pixels becomes :math:`\sum_q (iq)^\alpha\, \overline{\mathrm{PSF}_q}\, \phi_{k,q}` (Parseval).
    """
    unit = half_light_radius(image)
    pixels = _within(image, estimator.reach + 2 * unit)
    ny, nx = pixels.shape
    x, y = ((np.arange(n) - (n - 1) / 2) * image.scale / unit for n in (nx, ny))
    centre = np.zeros(2)
    for _ in range(_STEPS):
        functions = _functions(estimator, x - centre[0], y - centre[1], unit)
        flux, *rest = np.einsum("yx,kyx->k", pixels, functions)
        move = np.array(rest[:2]) / flux
        centre = centre + move
        if not np.abs(centre).max() < 0.5 * np.abs(x).max():
            break
        if np.abs(move).max() < 1e-13:
            integrals = _integrals(pixels, functions, x[1] - x[0])
            return AperturePSF(
                unit=unit, covariance=np.array(rest[2:]) / flux, integrals=integrals / integrals[0, 0, 0]
            )
    raise ValueError(f"psf must have a centroid within its aperture, got none for {estimator.name}")


def _within(image: Any, half: float) -> FloatArray:
    """Pixels of the middle of a stamp, whose half width is in arcsec."""
    rows, columns = (max(0, n // 2 - math.ceil(half / image.scale)) for n in image.array.shape)
    ny, nx = image.array.shape
    return np.ascontiguousarray(image.array[rows : ny - rows, columns : nx - columns])


def _functions(estimator: Plain, u: FloatArray, v: FloatArray, unit: float) -> FloatArray:
    """The six functions phi on the grid, (6, ny, nx)."""
    weight = estimator.weight(u * unit, v * unit)
    return np.stack([weight * u**a * (v**b)[:, None] for a, b in _POWERS])


def _integrals(pixels: FloatArray, functions: FloatArray, step: float) -> FloatArray:
    """J[k, a, b] for a + b <= ORDER + 2, by Parseval's theorem."""
    order = ORDER + 2
    ny, nx = pixels.shape
    product = np.conj(np.fft.fft2(pixels)) * np.fft.fft2(functions) / (nx * ny)
    powers = np.arange(order + 1)[:, None]
    qx, qy = (((2j * np.pi / step) * np.fft.fftfreq(n)) ** powers for n in (nx, ny))
    found: FloatArray = np.real(np.einsum("ax,kyx,by->kab", qx, product, qy, optimize=True))
    found[:, np.add.outer(np.arange(order + 1), np.arange(order + 1)) > order] = 0.0
    return found


def _equations(t: FloatArray, covariance: FloatArray) -> FloatArray:
    """The five equations T_u = T_v = 0, T_ij - Q_ij T_0 = 0 of sums t (6, ...)."""
    shape = (3,) + (1,) * (t.ndim - 1)
    return np.concatenate([t[1:3], t[3:] - covariance.reshape(shape) * t[:1]])


def aperture_derivatives(aperture: AperturePSF) -> Derivatives:
    """Derivatives of the measured second moments with respect to kernel moments, at no kernel.

    Parameters
    ----------
    aperture : AperturePSF
        The PSF.

    Returns
    -------
    derivatives : Derivatives
        Of (Q11, Q12, Q22) by the moments in the order of `moments.INDICES`, in powers of the unit.

    Notes
    -----
    Exact: the equations are linear in the kernel moments, and the centre of the aperture moves.
    """
    j, q = aperture.integrals, aperture.covariance

    def gradient(a: int, b: int) -> FloatArray:
        """By the centre (2) and by Q (3), (5, 5)."""
        found = np.zeros((5, 5))
        found[:, 0], found[:, 1] = -_equations(j[:, a + 1, b], q), -_equations(j[:, a, b + 1], q)
        found[[2, 3, 4], [2, 3, 4]] = -j[0, a, b]
        return found

    scaled = list(zip(INDICES, _FACTORIALS, strict=True))
    by_moment = np.stack([_equations(j[:, a, b], q) / f for (a, b), f in scaled], axis=1)
    cross = np.stack([gradient(a, b) / f for (a, b), f in scaled], axis=1)
    hessian = np.zeros((5, 5, 5))
    for i, (a, b) in enumerate(((1, 0), (0, 1))):
        hessian[:, :2, i] = np.stack([_equations(j[:, a + 1, b], q), _equations(j[:, a, b + 1], q)], axis=1)
        for k in range(3):
            hessian[2 + k, 2 + k, i] = hessian[2 + k, i, 2 + k] = j[0, a, b]
    return implicit_derivatives(gradient(0, 0), hessian, by_moment, cross)


def aperture_covariance(aperture: AperturePSF, values: FloatArray) -> FloatArray:
    """Measured second moments of stacks within the aperture, centred on their own centroids.

    Parameters
    ----------
    aperture : AperturePSF
        The PSF.
    values : (n, n_moment) float array
        Kernel moments in the order of `moments.INDICES`, in arcsec^(a+b).

    Returns
    -------
    covariance : (n, 3) float array
        Q11, Q12, Q22, in arcsec²; NaN where there is no flux.

    Notes
    -----
    Sums are polynomials of second degree in the shift of the centre, which is of third order in the
    separations and far smaller than the edge of the aperture is wide.
    """
    j = aperture.integrals
    indices = np.array([(0, 0), *INDICES])
    a, b = indices.T
    kernel = np.ones((len(values), len(indices)))
    kernel[:, 1:] = values / (_FACTORIALS * aperture.unit ** (a + b)[1:])

    def sums(da: int, db: int) -> FloatArray:
        """(n, 6), one stack at a time: BLAS would round by how many there are."""
        found: FloatArray = np.einsum("ni,ki->nk", kernel, np.ascontiguousarray(j[:, a + da, b + db]))
        return found

    t, tx, ty = sums(0, 0), sums(1, 0), sums(0, 1)
    txx, txy, tyy = 0.5 * sums(2, 0), sums(1, 1), 0.5 * sums(0, 2)
    x, y = np.zeros((2, len(values), 1))
    for _ in range(4):
        moved = t - x * tx - y * ty + x * x * txx + x * y * txy + y * y * tyy
        by_x, by_y = -tx + 2 * x * txx + y * txy, -ty + 2 * y * tyy + x * txy
        slope = np.stack([by_x[:, 1:3], by_y[:, 1:3]], axis=-1)
        det = slope[:, 0, 0] * slope[:, 1, 1] - slope[:, 0, 1] * slope[:, 1, 0]
        gx, gy = moved[:, 1], moved[:, 2]
        x = x - ((slope[:, 1, 1] * gx - slope[:, 0, 1] * gy) / det)[:, None]
        y = y - ((slope[:, 0, 0] * gy - slope[:, 1, 0] * gx) / det)[:, None]
    moved = t - x * tx - y * ty + x * x * txx + x * y * txy + y * y * tyy
    with np.errstate(invalid="ignore", divide="ignore"):
        covariance = np.where(moved[:, :1] > 0, moved[:, 3:] / moved[:, :1], np.nan)
    return covariance * aperture.unit**2
