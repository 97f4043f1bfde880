r"""Multiplicative and additive bias of shear, m and c, that the companions of the PSF's stars make.

The stacked PSF is the true one convolved with the mean kernel D of its stars.  Its mean is round and a little wide:
a method that removes the stacked PSF removes too much, sees galaxies more elliptical than they are, and m > 0, while
c has no direction to point to.  What is left of c is the random part, for a patch of N stars is not quite round.
Two kinds of method, and the naive propagation beside them:

- `deconvolution_bias`: deconvolves, or fits a galaxy, with the stacked PSF; adaptive shapes of the PSF do not enter;
- `moments_bias`: subtracts measured shapes of the PSF, as REGAUSS does;
- `naive_bias`: the errors of the PSF's size and ellipticity taken for independent of each other.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import TYPE_CHECKING, Literal

import numpy as np

from porrima.errors import InputError
from porrima.moments import INDICES, N_MOMENTS

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from porrima.galaxies import Galaxies
    from porrima.prediction import PopulationMoments
    from porrima.shapes import Shape

    FloatArray = NDArray[np.float64]

__all__ = [
    "Responsivity",
    "ShearBias",
    "ShearResponse",
    "deconvolution_bias",
    "gaussian_response",
    "moments_bias",
    "naive_bias",
]  # fmt: skip

Responsivity = Literal["measured", "fixed", "g"]
r"""How ellipticities become a shear: the mean distortion over :math:`P_\gamma = 2 - \langle e^2 \rangle` of the same
galaxies (``measured``) or over a :math:`P_\gamma` known from elsewhere (``fixed``), or the mean of g (``g``)."""

_XX, _XY, _YY = (INDICES.index(powers) for powers in ((2, 0), (1, 1), (0, 2)))


@dataclass(frozen=True, slots=True, kw_only=True)
class ShearBias:
    r"""Bias of a shear estimate, :math:`\hat\gamma_i = (1 + m) \gamma_i + c_i`, for k binary fractions.

    Parameters
    ----------
    m : (k,) float array
        Mean multiplicative bias, dimensionless; positive where the PSF is taken for too large.
    c1, c2 : (k,) float array
        Mean additive bias, dimensionless, in shear (not distortion), along the axes of the PSF's image.
    covariance : (k, 3, 3) float array
        Of (m, c1, c2) between patches whose PSF rests on N stars each, dimensionless.

    References
    ----------
    Heymans2006
    """

    m: FloatArray
    c1: FloatArray
    c2: FloatArray
    covariance: FloatArray

    @property
    def sd_m(self) -> FloatArray:
        """Standard deviation of m between patches, (k,), dimensionless."""
        return self._sd(0)

    @property
    def sd_c1(self) -> FloatArray:
        """Standard deviation of c1 between patches, (k,), dimensionless."""
        return self._sd(1)

    @property
    def sd_c2(self) -> FloatArray:
        """Standard deviation of c2 between patches, (k,), dimensionless."""
        return self._sd(2)

    def _sd(self, i: int) -> FloatArray:
        return np.sqrt(np.maximum(self.covariance[:, i, i], 0.0))


@dataclass(frozen=True, slots=True, kw_only=True)
class ShearResponse:
    r"""First derivatives of (m, c1, c2) by the mean kernel moments of the stars that made the PSF.

    Parameters
    ----------
    first : (3, n_moment) float array
        In the order of `moments.INDICES`, in arcsec^-(a+b).
    inverse_r2 : float
        :math:`\langle 1/R_{gal}^2 \rangle` of the galaxies, in arcsec^-2.
    """

    first: FloatArray
    inverse_r2: float

    @property
    def kappa_m(self) -> float:
        r""":math:`\kappa_{gal} = m / (\langle x \rangle \langle 1/R_{gal}^2 \rangle)` for r → 0, dimensionless."""
        return float(self.first[0, _XX] + self.first[0, _YY]) / (2 * self.inverse_r2)

    @property
    def kappa_c(self) -> float:
        """Response of c to a kernel that is not round, over that of plain moments; dimensionless."""
        along = self.first[1, _YY] - self.first[1, _XX]
        return float(0.5 * (along - self.first[2, _XY])) / self.inverse_r2


def ellipticity_factors(mean_e2: float, responsivity: Responsivity) -> tuple[float, float]:
    r"""Factors on m and on c that the galaxies' own ellipticity makes.

    Parameters
    ----------
    mean_e2 : float
        :math:`\langle e^2 \rangle`, in [0, 1).
    responsivity : {"measured", "fixed", "g"}
        How ellipticities become a shear.

    Returns
    -------
    factors : tuple of float
        On :math:`\langle x \rangle/R_{gal}^2` and on :math:`\delta e_P R_P^2/R_{gal}^2`, dimensionless.

    Raises
    ------
    ValueError
        If the responsivity has no such name.

    Notes
    -----
    An isotropic change of Q by -x/2 makes :math:`\delta e = e\,x/T` with :math:`T = R_{gal}^2/\sqrt{1-e^2}`, and a
    traceless change t makes :math:`\delta e = t/T`.  Lensing changes e by :math:`2\gamma - 2e(e\cdot\gamma)` and keeps
    :math:`R_{gal}^2`.  Over all orientations, with :math:`P = 2 - e^2` and :math:`s^2 = 1 - e^2`,

    - fixed P: :math:`m = (x/R_{gal}^2)\, 2 s^3/P`; P from the measured e adds :math:`2 \delta\ln e\, e^2/P`, and
      :math:`m = (x/R_{gal}^2)\, 2 s/P = (x/R_{gal}^2)(1 - e^4/8 + …)`; mean of g: exactly 1;
    - :math:`c = (t/R_{gal}^2)\, s/P`, for g exactly 1/2.  This is :math:`t/(P_\gamma T)`.

    Exact for one modulus of e, and first order in x.  With :math:`\langle e^2\rangle = 0.16` a fixed P lowers m by
    16 %, and the other two differ by 0.4 %.

    References
    ----------
    Bernstein2002, Seitz1997
    """
    p, s = 2.0 - mean_e2, math.sqrt(1.0 - mean_e2)
    factors = {"measured": (2 * s / p, s / p), "fixed": (2 * s**3 / p, s / p), "g": (1.0, 0.5)}
    if responsivity not in factors:
        raise ValueError(f"responsivity must be one of {', '.join(factors)}, got {responsivity}")
    return factors[responsivity]


def gaussian_response(galaxies: Galaxies, responsivity: Responsivity = "measured") -> ShearResponse:
    r"""Response of a method that is exact in second moments: unweighted ones, or Gaussian galaxies.

    Parameters
    ----------
    galaxies : Galaxies
        Their sizes and ellipticities; the profile does not enter.
    responsivity : {"measured", "fixed", "g"}
        How ellipticities become a shear.

    Returns
    -------
    response : ShearResponse
        :math:`m = \langle x \rangle/R_{gal}^2` and :math:`c_i = -t_i/(2 R_{gal}^2)` with t = (m20 - m02, 2 m11), times
        the factors of `ellipticity_factors`; no other moment enters.

    Raises
    ------
    ValueError
        If the responsivity has no such name.
    """
    for_m, for_c = ellipticity_factors(galaxies.mean_e2, responsivity)
    first = np.zeros((3, N_MOMENTS))
    first[0, [_XX, _YY]] = for_m * galaxies.inverse_r2
    first[1, [_XX, _YY]] = np.array([-1.0, 1.0]) * for_c * galaxies.inverse_r2
    first[2, _XY] = -2 * for_c * galaxies.inverse_r2
    return ShearResponse(first=first, inverse_r2=galaxies.inverse_r2)


def deconvolution_bias(
    moments: PopulationMoments, response: ShearResponse, n_stars: int | None = None
) -> ShearBias:
    r"""Bias of a method that deconvolves or forward-fits with the stacked PSF.

    Parameters
    ----------
    moments : PopulationMoments
        Of one star, at k binary fractions, in arcsec^(a+b).
    response : ShearResponse
        From `gaussian_response`, or `deconvolution.fit_response` for a fit of other profiles.
    n_stars : int, optional
        Stars that the PSF of a patch rests on, at least 1 (count); None for infinitely many.

    Returns
    -------
    bias : ShearBias
        Dimensionless, (k,) arrays.

    Raises
    ------
    InputError
        If `n_stars` is less than 1.

    Notes
    -----
    With the mean and covariance of the moments of a stack and the response A, the bias is A m and its covariance
    A C Aᵀ/N.  For Gaussian galaxies

    .. math:: m = \frac{\langle x\rangle}{R_{gal}^2}, \quad
              \mathrm{sd}(m) = \frac{1}{R_{gal}^2}
              \sqrt{\frac{\langle x^2\rangle - \langle x\rangle^2}{N_\star}}, \quad
              c_i = 0, \quad \mathrm{sd}(c_i) = \frac{1}{2 R_{gal}^2}\sqrt{\frac{\langle x^2\rangle}{2 N_\star}},

    and m and c are not correlated.  First order in :math:`\langle x\rangle/R_{gal}^2`.
    """
    _check_n_stars(n_stars)
    per_stack = 0.0 if n_stars is None else 1.0 / n_stars
    mean = response.first @ (moments.mean + moments.shift * per_stack).T
    covariance = np.einsum("qi,kij,pj->kqp", response.first, moments.covariance, response.first) * per_stack
    return ShearBias(m=mean[0], c1=mean[1], c2=mean[2], covariance=covariance)


def moments_bias(
    bias: FloatArray,
    covariance: FloatArray,
    psf: Shape,
    galaxies: Galaxies,
    responsivity: Responsivity = "measured",
) -> ShearBias:
    r"""Bias of a method that subtracts the measured moments of the stacked PSF, as REGAUSS does.

    Parameters
    ----------
    bias : (3, k) float array
        Mean change of e1, e2 and R²/R0² of the stacked PSF, as `Prediction` has them, dimensionless.
    covariance : (k, 3, 3) float array
        Of (e1, e2, ln R²), dimensionless; zeros for infinitely many stars.
    psf : Shape
        Of the PSF without companions by the same estimator; r2 in arcsec².
    galaxies : Galaxies
        Sizes as the method sees them: `galaxies.regauss_r2` for REGAUSS, Qxx + Qyy for unweighted moments.
    responsivity : {"measured", "fixed", "g"}
        How ellipticities become a shear.

    Returns
    -------
    bias : ShearBias
        Dimensionless, (k,) arrays.

    Raises
    ------
    ValueError
        If an array has another shape, or the responsivity no such name.

    Notes
    -----
    From :math:`\delta e_{gal} = [(e_{gal} - e_P)\, \delta R_P^2 - R_P^2\, \delta e_P]/R_{gal}^2`
    (Paulin-Henriksson et al. 2008),

    .. math:: m = \frac{R_P^2}{R_{gal}^2} \frac{\delta R_P^2}{R_P^2}, \qquad
              c_i = -\frac{1}{P_\gamma} \frac{R_P^2}{R_{gal}^2}
              \left(\delta e_{P,i} + e_{P,i} \frac{\delta R_P^2}{R_P^2}\right) ,

    times the factors of `ellipticity_factors`.  For Gaussian PSFs :math:`\delta e_P = -e_P\, \delta R_P^2/R_P^2` and
    the two terms of c cancel.  REGAUSS follows it to 2 % behind Gaussian PSFs for Gaussian and exponential galaxies, to
    9 % for de Vaucouleurs galaxies of e = 0.4, and behind a diffraction-limited PSF to 6 % for half-light radii of 0.1
    arcsec or more.

    References
    ----------
    PaulinHenriksson2008, Hirata2003
    """
    bias, covariance = _checked(bias, (3, -1), "bias"), _checked(covariance, (-1, 3, 3), "covariance")
    jacobian = _jacobian(psf, galaxies, responsivity)
    mean = jacobian @ bias
    return ShearBias(m=mean[0], c1=mean[1], c2=mean[2], covariance=jacobian @ covariance @ jacobian.T)


def naive_bias(
    bias: FloatArray,
    covariance: FloatArray,
    psf: Shape,
    galaxies: Galaxies,
    responsivity: Responsivity = "measured",
) -> ShearBias:
    r"""Bias as it follows when the errors of the PSF's size and ellipticity are taken for independent.

    Parameters
    ----------
    bias : (3, k) float array
        As for `moments_bias`.
    covariance : (k, 3, 3) float array
        As for `moments_bias`; all but the diagonal is left out.
    psf : Shape
        Of the PSF without companions, r2 in arcsec².
    galaxies : Galaxies
        Their sizes.
    responsivity : {"measured", "fixed", "g"}
        How ellipticities become a shear.

    Returns
    -------
    bias : ShearBias
        For comparison: the sizes of the terms added, so that c1 and c2 are not negative; dimensionless.

    Raises
    ------
    ValueError
        As `moments_bias`.

    Notes
    -----
    :math:`c_i = (R_P^2/R_{gal}^2)(|\delta e_i| + |e_i|\, |\delta R^2/R^2|)/P_\gamma`: 10 to 100 times too large, as
    the two terms cancel.
    """
    bias, covariance = _checked(bias, (3, -1), "bias"), _checked(covariance, (-1, 3, 3), "covariance")
    jacobian = np.abs(_jacobian(psf, galaxies, responsivity))
    mean = jacobian @ np.abs(bias)
    alone = covariance * np.eye(3)
    return ShearBias(m=mean[0], c1=mean[1], c2=mean[2], covariance=jacobian @ alone @ jacobian.T)


def _jacobian(psf: Shape, galaxies: Galaxies, responsivity: Responsivity) -> FloatArray:
    """Derivatives of (m, c1, c2) by (e1, e2, ln R²) of the PSF, (3, 3)."""
    for_m, for_c = ellipticity_factors(galaxies.mean_e2, responsivity)
    ratio = float(psf.r2) * galaxies.inverse_r2
    e1, e2 = float(psf.e1), float(psf.e2)
    return ratio * np.array([[0.0, 0.0, for_m], [-for_c, 0.0, -for_c * e1], [0.0, -for_c, -for_c * e2]])


def _checked(values: FloatArray, shape: tuple[int, ...], name: str) -> FloatArray:
    array = np.asarray(values, dtype=float)
    if array.ndim != len(shape) or any(n not in (-1, m) for n, m in zip(shape, array.shape, strict=True)):
        text = ", ".join("k" if n == -1 else str(n) for n in shape)
        raise ValueError(f"{name} must have the shape ({text}), got {array.shape}")
    return array


def _check_n_stars(n_stars: int | None) -> None:
    if n_stars is not None and n_stars < 1:
        raise InputError("must be at least 1", key="n_stars", value=n_stars)
