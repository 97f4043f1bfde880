"""Shapes measured on images: plain, Gaussian-weighted and adaptive moments, and how they fail."""

from __future__ import annotations

import math
from dataclasses import dataclass
from enum import IntFlag
from typing import TYPE_CHECKING, Any, Protocol

import galsim
import numpy as np

from porrima.errors import InputError

if TYPE_CHECKING:
    from numpy.typing import NDArray

    FloatArray = NDArray[np.float64]
    IntArray = NDArray[np.int64]

__all__ = [
    "Adaptive",
    "Estimator",
    "Failure",
    "GaussianWeight",
    "Plain",
    "Shape",
    "estimator_from_name",
]

PRECISION = 1e-10
"""Tolerance of HSM's iteration, as a fraction of the size (dimensionless)."""

HSM_PARAMS = galsim.hsm.HSMParams(convergence_threshold=PRECISION, max_amoment=1e8, max_ashift=1e4)
"""HSM cuts its weight where it falls below a tenth of ``convergence_threshold``; its default limits on
size and shift are meant for survey pixels, not for a grid 12 times finer."""

POLISH_TOLERANCE = 1e-12
"""Change of the weight, as a fraction of its size, at which an iteration in float64 stops (dimensionless)."""

MAX_ITERATIONS = 200

APERTURE_EDGE = 0.025
"""Sigma by which the edge of an aperture is blurred, in arcsec: three pixels of the coarsest grid."""

APERTURE_MIN = 0.1
"""Smallest radius of an aperture, in arcsec: four times the blur of its edge."""

SIGMA_MIN = 0.02
"""Narrowest fixed weight, in arcsec: 2.4 pixels of the coarsest grid: pixel sums are still integrals."""


class Failure(IntFlag):
    """Why a shape could not be measured, one bit each."""

    NONE = 0
    NOT_FINITE = 1
    """A pixel or a kernel moment is infinite or NaN."""
    NO_FLUX = 2
    """The (weighted) flux is not positive."""
    NOT_CONVERGED = 4
    """The iteration did not find a fixed point."""
    NOT_POSITIVE = 8
    """The matrix of second moments is not positive definite."""
    SERIES = 16
    """Kernels too wide for moments of order 8 or lower: draw images instead."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Shape:
    r"""Shapes of stacks: distortion and size.

    Parameters
    ----------
    e1, e2 : (n,) or () float array
        Distortion :math:`(Q_{11} - Q_{22}) / R^2` and :math:`2 Q_{12} / R^2`, dimensionless.
    r2 : (n,) or () float array
        :math:`R^2 = Q_{11} + Q_{22}`, in arcsec².
    flag : (n,) or () int array
        Bits of `Failure`; where not 0 the shape is NaN.
    """

    e1: FloatArray
    e2: FloatArray
    r2: FloatArray
    flag: IntArray

    @classmethod
    def from_covariance(cls, covariance: FloatArray, flag: int | IntArray = 0) -> Shape:
        """Shapes of matrices of second moments.

        Parameters
        ----------
        covariance : (n, 3) or (3,) float array
            Q11, Q12, Q22, in arcsec².
        flag : int or (n,) int array
            Failures known before.

        Returns
        -------
        shape : Shape
            NaN, and a bit set, where the matrix is not finite and positive definite.
        """
        q11, q12, q22 = np.moveaxis(np.asarray(covariance, dtype=float), -1, 0)
        bits = np.broadcast_to(np.asarray(flag, dtype=np.int64), q11.shape).copy()
        with np.errstate(invalid="ignore", over="ignore"):
            positive = (q11 + q22 > 0) & (q11 * q22 > q12**2)
        bits[~positive & (bits == 0)] = Failure.NOT_POSITIVE
        r2 = np.where(bits == 0, q11 + q22, np.nan)
        with np.errstate(invalid="ignore", over="ignore"):
            return cls(e1=(q11 - q22) / r2, e2=2 * q12 / r2, r2=r2, flag=bits)

    def covariance(self) -> FloatArray:
        """Second moments of the shapes.

        Returns
        -------
        covariance : (n, 3) or (3,) float array
            Q11, Q12, Q22, in arcsec².
        """
        half = self.r2 / 2
        return np.stack([half * (1 + self.e1), half * self.e2, half * (1 - self.e1)], axis=-1)


class Estimator(Protocol):
    """A way to measure the shape of an image."""

    @property
    def name(self) -> str:
        """As the option ``--estimator`` takes it."""
        ...

    @property
    def reach(self) -> float:
        """Half width of the stamp beyond which nothing counts, in arcsec; 0: that of the PSF."""
        ...

    def measure(self, image: Any) -> Shape:
        """Shape of one image, as a `Shape` of 0-d arrays."""
        ...

    def __hash__(self) -> int: ...


@dataclass(frozen=True, slots=True)
class _Moments:
    """Weighted flux, centroid minus centre of the weight [arcsec], and second moments about that centre."""

    flux: float
    offset: FloatArray  # (2,)
    covariance: FloatArray  # (2, 2)


def _weighted_moments(image: Any, centre: FloatArray, weight: FloatArray | None) -> _Moments:
    """Moments under a Gaussian of covariance `weight`, or under none; from the image's true centre."""
    ny, nx = image.array.shape
    x = (np.arange(nx) - (nx - 1) / 2) * image.scale - centre[0]
    y = (np.arange(ny) - (ny - 1) / 2) * image.scale - centre[1]
    weighted = image.array
    if weight is not None:
        p = np.linalg.inv(weight)
        exponent = -0.5 * (p[1, 1] * y**2)[:, None] - 0.5 * p[0, 0] * x**2 - p[0, 1] * np.outer(y, x)
        weighted = weighted * np.exp(exponent)
    columns, rows = weighted.sum(axis=0), weighted.sum(axis=1)
    flux = columns.sum()
    if not flux > 0:
        return _Moments(flux, np.full(2, np.nan), np.full((2, 2), np.nan))
    xy = y @ weighted @ x
    second = np.array([[columns @ x**2, xy], [xy, rows @ y**2]])
    return _Moments(flux, np.array([columns @ x, rows @ y]) / flux, second / flux)


def _failed(flag: Failure) -> Shape:
    """One shape that could not be measured."""
    return Shape.from_covariance(np.full(3, np.nan), flag)


def _shape(covariance: FloatArray) -> Shape:
    """One shape from its 2 x 2 second moments, in arcsec²."""
    return Shape.from_covariance(covariance[[0, 0, 1], [0, 1, 1]])


def _pixels_failure(image: Any) -> Failure:
    """What can be said against an image before it is measured."""
    if not np.all(np.isfinite(image.array)):
        return Failure.NOT_FINITE
    return Failure.NONE if image.array.sum() > 0 else Failure.NO_FLUX


@dataclass(frozen=True, slots=True)
class Plain:
    r"""Unweighted moments, of the whole stamp or within a round aperture.

    Parameters
    ----------
    aperture : float, optional
        Radius of the aperture, at least `APERTURE_MIN`, in arcsec; the whole stamp where not given.

    Raises
    ------
    ValueError
        If the aperture is not finite or below `APERTURE_MIN`.

    Notes
    -----
    :math:`Q_{ij} = \sum w I y_i y_j / \sum w I` with :math:`y = x - x_0`, and :math:`x_0` where
    :math:`\sum w I y = 0`.  Without an aperture w = 1, exact for a profile whose wings end inside the stamp,
    as those of a Gaussian do.  The moments of other PSFs diverge: for them :math:`w = \frac12
    \mathrm{erfc}[(|y| - \mathrm{radius}) / (\sqrt2 s)]`, a step blurred by s = `APERTURE_EDGE`, so that sums
    over pixels are integrals.

    References
    ----------
    KCM16, Sect. 3
    """

    aperture: float | None = None

    def __post_init__(self) -> None:
        if self.aperture is not None and not (math.isfinite(self.aperture) and self.aperture >= APERTURE_MIN):
            raise ValueError(
                f"aperture must be finite and at least {APERTURE_MIN} arcsec, got {self.aperture}"
            )

    @property
    def name(self) -> str:
        """``plain``, with the radius of an aperture, such as ``plain:0.75``."""
        return "plain" if self.aperture is None else f"plain:{self.aperture!r}"

    @property
    def reach(self) -> float:
        """Half width of the stamp beyond which nothing counts, in arcsec; 0: that of the PSF."""
        return 0.0 if self.aperture is None else self.aperture + 8 * APERTURE_EDGE

    def weight(self, x: FloatArray, y: FloatArray) -> FloatArray:
        """Weight of pixels.

        Parameters
        ----------
        x : (nx,) float array
            Of the columns, from the centre of the aperture, in arcsec.
        y : (ny,) float array
            Of the rows, likewise.

        Returns
        -------
        weight : (ny, nx) float array
            In [0, 1].
        """
        from scipy.special import erfc  # noqa: PLC0415  (a tenth of a second, for apertures only)

        if self.aperture is None:
            return np.ones((len(y), len(x)))
        beyond = np.hypot(y[:, None], x) - self.aperture
        return np.asarray(0.5 * erfc(beyond / (math.sqrt(2) * APERTURE_EDGE)))

    def measure(self, image: Any) -> Shape:
        """Shape of one image from unweighted moments.

        Parameters
        ----------
        image : galsim.Image
            With its scale in arcsec.

        Returns
        -------
        shape : Shape
            Of 0-d arrays.
        """
        failure = _pixels_failure(image)
        if failure:
            return _failed(failure)
        moments = _weighted_moments(image, np.zeros(2), None)
        if self.aperture is None:
            return _shape(moments.covariance - np.outer(moments.offset, moments.offset))
        ny, nx = image.array.shape
        x, y = ((np.arange(n) - (n - 1) / 2) * image.scale for n in (nx, ny))
        centre, inside = np.zeros(2), image.copy()
        for _ in range(MAX_ITERATIONS):
            inside.array[:] = image.array * self.weight(x - centre[0], y - centre[1])
            moments = _weighted_moments(inside, centre, None)
            if not moments.flux > 0:
                return _failed(Failure.NO_FLUX)
            centre = centre + moments.offset
            if np.abs(moments.offset).max() < POLISH_TOLERANCE * self.aperture:
                return _shape(moments.covariance)
        return _failed(Failure.NOT_CONVERGED)


@dataclass(frozen=True, slots=True)
class Adaptive:
    r"""Adaptive moments: those of the best-fit elliptical Gaussian, by GalSim's HSM.

    Notes
    -----
    The weight :math:`\exp[-\frac12 (x - x_0)^T M^{-1} (x - x_0)]` is that for which the weighted centroid
    is :math:`x_0` and the weighted second moments are :math:`M / 2`; :math:`Q = M`.

    HSM iterates in float64 but returns float32 (a relative 6e-8, no smaller than what matters in a
    change of shape of 1e-4).  Its answer is therefore polished here: the same update,
    :math:`M \to 4C - M`, in float64 until nothing moves.  Polished and raw agree to float32 rounding.

    References
    ----------
    Hirata2003, Rowe2015
    """

    @property
    def name(self) -> str:
        """Always ``adaptive``."""
        return "adaptive"

    @property
    def reach(self) -> float:
        """Always 0: the weight is as narrow as the PSF."""
        return 0.0

    def measure(self, image: Any) -> Shape:
        """Shape of one image from adaptive moments.

        Parameters
        ----------
        image : galsim.Image
            With its scale in arcsec.

        Returns
        -------
        shape : Shape
            Of 0-d arrays.
        """
        failure = _pixels_failure(image)
        if failure:
            return _failed(failure)
        sigma = math.sqrt(
            image.array.sum() / (2 * math.pi * image.array.max())
        )  # of a Gaussian that peaks so
        found = galsim.hsm.FindAdaptiveMom(
            image, guess_sig=sigma, precision=PRECISION, hsmparams=HSM_PARAMS, strict=False
        )
        if found.error_message:
            return _failed(Failure.NOT_CONVERGED)
        e1, e2 = found.observed_shape.e1, found.observed_shape.e2
        half = (found.moments_sigma * image.scale) ** 2 / math.sqrt(1 - e1**2 - e2**2)
        centre = np.array([found.moments_centroid.x, found.moments_centroid.y])
        middle = np.array([image.true_center.x, image.true_center.y])
        return _polished(
            image, (centre - middle) * image.scale, half * np.array([[1 + e1, e2], [e2, 1 - e1]])
        )


def _polished(image: Any, centre: FloatArray, weight: FloatArray) -> Shape:
    """Adaptive shape in float64, from a fixed point that is known in float32."""
    for _ in range(MAX_ITERATIONS):
        moments = _weighted_moments(image, centre, weight)
        shift, growth = 2 * moments.offset, 4 * moments.covariance - 2 * weight
        centre, weight = centre + shift, weight + growth
        size2 = np.trace(weight)
        if not (size2 > 0 and np.linalg.det(weight) > 0):
            return _failed(Failure.NOT_POSITIVE)
        if max(np.abs(shift).max() / math.sqrt(size2), np.abs(growth).max() / size2) < POLISH_TOLERANCE:
            return _shape(weight)
    return _failed(Failure.NOT_CONVERGED)


@dataclass(frozen=True, slots=True)
class GaussianWeight:
    r"""Moments under a fixed round Gaussian weight, centred on its own weighted centroid, not deweighted.

    Parameters
    ----------
    sigma : float
        Standard deviation of the weight, at least `SIGMA_MIN`, in arcsec.

    Raises
    ------
    ValueError
        If sigma is not finite or below `SIGMA_MIN`.

    Notes
    -----
    :math:`Q_{ij} = \sum I W y_i y_j / \sum I W` with :math:`y = x - x_0`, and :math:`x_0` where
    :math:`\sum I W y = 0`, found by Newton's method:
    :math:`\mathrm{d}\bar x / \mathrm{d} x_0 = C / \sigma^2`.  Euclid states its requirements for
    sigma = 0.75 arcsec.
    """

    sigma: float

    def __post_init__(self) -> None:
        if not (math.isfinite(self.sigma) and self.sigma >= SIGMA_MIN):
            raise ValueError(f"sigma must be finite and at least {SIGMA_MIN} arcsec, got {self.sigma}")

    @property
    def name(self) -> str:
        """The name with the sigma, such as ``gaussian:0.75``."""
        return f"gaussian:{self.sigma!r}"

    @property
    def reach(self) -> float:
        """Seven sigmas, where the weight is 2e-11, in arcsec."""
        return 7 * self.sigma

    def measure(self, image: Any) -> Shape:
        """Shape of one image from moments under the fixed weight.

        Parameters
        ----------
        image : galsim.Image
            With its scale in arcsec.

        Returns
        -------
        shape : Shape
            Of 0-d arrays.
        """
        failure = _pixels_failure(image)
        if failure:
            return _failed(failure)
        weight = self.sigma**2 * np.eye(2)
        centre = _weighted_moments(image, np.zeros(2), None).offset
        for _ in range(MAX_ITERATIONS):
            moments = _weighted_moments(image, centre, weight)
            if not moments.flux > 0:
                return _failed(Failure.NO_FLUX)
            slope = np.eye(2) - moments.covariance / self.sigma**2
            stable = np.trace(slope) > 0 and np.linalg.det(slope) > 0
            if np.abs(moments.offset).max() < POLISH_TOLERANCE * self.sigma:
                return _shape(moments.covariance) if stable else _failed(Failure.NOT_CONVERGED)
            # Between two sources only the plain step, towards the brighter one, is to be trusted.
            centre = centre + (np.linalg.solve(slope, moments.offset) if stable else moments.offset)
        return _failed(Failure.NOT_CONVERGED)


ESTIMATORS: dict[str, Estimator] = {"adaptive": Adaptive(), "plain": Plain()}
"""Estimators without a parameter; ``gaussian:S`` has one."""


def estimator_from_name(name: str) -> Estimator:
    """Estimator of a given name.

    Parameters
    ----------
    name : str
        ``adaptive``, ``plain``, ``plain:R`` with R the radius of an aperture in arcsec, or ``gaussian:S`` with
        S the sigma of the weight in arcsec.

    Returns
    -------
    estimator : Estimator
        Equal names give equal estimators.

    Raises
    ------
    InputError
        If no estimator has that name, or R or S is no number or too small.
    """
    if name in ESTIMATORS:
        return ESTIMATORS[name]
    kind, colon, number = name.partition(":")
    if kind not in ("plain", "gaussian") or not colon:
        raise InputError("must be one of adaptive, plain, plain:R, gaussian:S", key="estimator", value=name)
    try:
        return GaussianWeight(float(number)) if kind == "gaussian" else Plain(float(number))
    except ValueError:
        letter, least = ("S", SIGMA_MIN) if kind == "gaussian" else ("R", APERTURE_MIN)
        rule = f"{letter} of {kind}:{letter} must be a number of arcsec, at least {least}"
        raise InputError(rule, key="estimator", value=name) from None
