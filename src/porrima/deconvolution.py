r"""What a forward fit of galaxies makes of a PSF that is a little wrong, without drawing or fitting one.

The fit finds the Sersic profile (flux, size, g1, g2) whose convolution with the stacked PSF is nearest to the
observed image, in unweighted least squares over pixels.  With the true PSF it is exact; with PSF * D it is off by

.. math:: \delta p = (J^T J)^{-1} J^T r, \qquad J = \hat P\, \partial \hat G/\partial p, \quad
          r = (1 - \hat D)\, \hat P \hat G,

to first order in D, inner products being integrals over the plane of wave numbers (Parseval).  The wider the galaxy
against the PSF, the more the fit weighs the cusp in the middle, which a wrong PSF smears most.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import lru_cache
from typing import TYPE_CHECKING, Any

import galsim
import numpy as np
from scipy.interpolate import CubicSpline, RectBivariateSpline

from porrima.moments import INDICES, N_MOMENTS, ORDER
from porrima.shear import ShearResponse

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from porrima.galaxies import Galaxies
    from porrima.psf import PSF

    FloatArray = NDArray[np.float64]

__all__ = ["fit_response"]

_EVEN = np.array([(a + b) % 2 == 0 for a, b in INDICES])
_POWER = 1e-13  # of the PSF over its maximum, below which a wave number is left out
_RADII, _ANGLES = 200, 32  # of the quadrature over wave numbers, the angles over half a turn
_LOWEST = 1e-3  # wave number from which it starts, over the half-light radius
_PROFILE = (1e-5, 1e5, 1000)  # wave numbers of a profile's table, over 1/half-light radius: finer sees noise
_RING = 4  # orientations of the intrinsic ellipticity
_SHEAR = 0.01  # step of the derivative by shear: its square is what is left out
_SIZES = 9  # nodes in log size, where there are more galaxies than that


def fit_response(psf: PSF, galaxies: Galaxies) -> ShearResponse:
    r"""Response of the mean fitted g of a sample of Sersic galaxies to the kernel moments of the PSF's stars.

    Parameters
    ----------
    psf : PSF
        Drawn once.
    galaxies : Galaxies
        Sizes, Sersic index and ellipticity; :math:`|e|` is the root of `mean_e2` for all.

    Returns
    -------
    response : ShearResponse
        For `shear.deconvolution_bias`, in arcsec^-(a+b).

    Notes
    -----
    Galaxies at orientations all round are sheared by :math:`\pm\gamma` along x and along the diagonal; the shear is the
    mean of g.  `kappa_m` is 1 for Gaussian galaxies behind any PSF, and tends to 1 for galaxies much smaller than the
    PSF and, for much larger ones, to

    .. math:: \kappa_\infty = R_{gal}^2 \frac{\int r\, I'^2\, dr}{\int r^3 I'^2\, dr}
              = \frac{4^n\, \Gamma(4n)}{\Gamma(2n)\, \Gamma(2n+2)} ,

    4 for an exponential, 183 040 for a de Vaucouleurs profile; behind a PSF of FWHM 0.137 arcsec and for a half-light
    radius of 0.3 arcsec they are 2.5 and 87.  Where the PSF is not round, the fit of a profile other than a Gaussian
    also has a small c along it, for its weight on wave numbers is not round.  First order in the kernel, with its
    moments to order 8; on drawn images the fitted bias follows it to 1e-3.  The quadrature is good to 3e-4.

    References
    ----------
    Voigt2010
    """
    power, largest = _power(psf)
    log_size = np.log(galaxies.half_light_radius)
    unique = np.unique(log_size)
    nodes = unique if unique.size <= _SIZES else np.linspace(unique[0], unique[-1], _SIZES)
    per_size = np.array([_mean_response(power, largest, galaxies, math.exp(node)) for node in nodes])
    if unique.size > _SIZES:  # times the size squared, they change slowly
        scaled = per_size * np.exp(2 * nodes)[:, None, None]
        at = CubicSpline(nodes, scaled)(log_size) * np.exp(-2 * log_size)[:, None, None]
    else:
        at = per_size[np.searchsorted(nodes, log_size)]
    return ShearResponse(first=np.tensordot(galaxies.weight, at, axes=1), inverse_r2=galaxies.inverse_r2)


def _power(psf: PSF) -> tuple[Any, float]:
    """Squared modulus of the PSF's transform, as a function, and the wave number where it has faded [1/arcsec]."""
    image = psf.draw()
    side = galsim.Image.good_fft_size(2 * image.array.shape[0])
    transform = np.fft.fftshift(np.abs(np.fft.fft2(image.array, (side, side))) ** 2)
    k = np.fft.fftshift(np.fft.fftfreq(side, image.scale)) * 2 * math.pi
    transform /= transform.max()
    seen = np.hypot(k[:, None], k)[transform > _POWER]
    return RectBivariateSpline(k, k, transform), float(min(seen.max(), -k[0]))


@lru_cache(maxsize=16)
def _transform(index: float) -> tuple[CubicSpline, CubicSpline]:
    """Transform of a round Sersic profile of unit half-light radius against ln k, and its derivative."""
    accuracy = galsim.GSParams(folding_threshold=1e-4, maxk_threshold=1e-5, kvalue_accuracy=1e-9)
    profile = galsim.Sersic(index, half_light_radius=1.0, gsparams=accuracy)
    low, high, n = _PROFILE
    log_k = np.linspace(math.log(low), math.log(high), n)
    values = CubicSpline(log_k, [profile.kValue(k, 0.0).real for k in np.exp(log_k)])
    return values, values.derivative()


@dataclass(frozen=True, slots=True, kw_only=True)
class _Waves:
    """Nodes of the plane of wave numbers, uniform in ln k and over half a turn, all (node,) but the monomials.

    The monomials are what each kernel moment of even order takes from a transform, (n_even, node); those of odd
    order move a galaxy and nothing else.
    """

    kx: FloatArray
    ky: FloatArray
    weight: FloatArray
    monomials: FloatArray

    @classmethod
    def of(cls, power: Any, largest: float, radius: float) -> _Waves:
        k = np.geomspace(_LOWEST / radius, largest, _RADII)[:, None]
        angle = np.arange(_ANGLES) * math.pi / _ANGLES
        kx, ky = (k * np.cos(angle)).ravel(), (k * np.sin(angle)).ravel()
        x, y = (k ** np.arange(ORDER + 1)[:, None] for k in (kx, ky))
        terms = [
            -((-1.0) ** ((a + b) // 2)) / (math.factorial(a) * math.factorial(b)) * x[a] * y[b]
            for a, b in np.array(INDICES)[_EVEN].tolist()
        ]
        weight = power.ev(ky, kx) * (kx**2 + ky**2)  # k dk = k² dln k
        return cls(kx=kx, ky=ky, weight=weight, monomials=np.array(terms))


def _mean_response(power: Any, largest: float, galaxies: Galaxies, radius: float) -> FloatArray:
    """Derivatives of (m, c1, c2) by kernel moments of galaxies of one half-light radius, (3, n_moment)."""
    g = math.sqrt(galaxies.mean_e2) / (1 + math.sqrt(1 - galaxies.mean_e2))
    ring = g * np.exp(2j * math.pi * np.arange(_RING) / _RING) if g > 0 else np.zeros(1, complex)
    waves = _Waves.of(power, largest, radius)

    def mean(shear: complex) -> FloatArray:
        lensed = (ring + shear) / (1 + np.conj(shear) * ring)
        each = [_fitted(waves, galaxies.index, radius, complex(one)) for one in lensed]
        return np.asarray(np.mean(each, axis=0))

    along, across = (
        (mean(step)[i] - mean(-step)[i]) / (2 * _SHEAR) for i, step in enumerate((_SHEAR, 1j * _SHEAR))
    )
    return np.vstack([0.5 * (along + across), mean(0.0)])


def _fitted(waves: _Waves, index: float, radius: float, g: complex) -> FloatArray:
    """Derivatives of the fitted g1, g2 of one galaxy by kernel moments, (2, n_moment)."""
    values, slope = _transform(index)
    kx, ky, scale = waves.kx, waves.ky, 1 / math.sqrt(1 - abs(g) ** 2)
    vx, vy = scale * ((1 + g.real) * kx + g.imag * ky), scale * (g.imag * kx + (1 - g.real) * ky)
    v2 = vx**2 + vy**2
    log_k = 0.5 * np.log(v2) + math.log(radius)
    profile, gradient = values(log_k), slope(log_k)
    by_g = [
        gradient * ((vx * sx + vy * sy) * scale / v2 + part * scale**2)
        for sx, sy, part in ((kx, -ky, g.real), (ky, kx, g.imag))
    ]
    jacobian = np.stack([profile, gradient, *by_g])
    weighted = jacobian * waves.weight
    first = np.zeros((2, N_MOMENTS))
    first[:, _EVEN] = np.linalg.solve(weighted @ jacobian.T, (weighted * profile) @ waves.monomials.T)[2:]
    return first
