r"""Measured shape of a stack from its kernel moments, without an image: derivatives and exact solution.

A stack is the PSF convolved with its mean kernel D.  Against a Gaussian weight W of centre
:math:`x_0` and covariance M, n-th derivatives of W integrate, by parts, to

.. math:: T_\alpha = \int (\mathrm{PSF} * D)\, \partial^\alpha W
          = \sum_{ab} \frac{m_{ab}}{a!\, b!} J_{\alpha + (a, b)}, \qquad
          J_\alpha = \int \mathrm{PSF}\, \partial^\alpha W ,

where :math:`m_{ab}` are the kernel moments.  Weighted centroid and second moments are ratios of such T,
and since :math:`\partial J_\alpha / \partial x_{0,i} = -J_{\alpha + e_i}` and
:math:`\partial J_\alpha / \partial M_{ij} = \frac12 J_{\alpha + e_i + e_j}` (heat equation), all
derivatives of the measurement are sums of J as well.  The J of one PSF are computed once.
"""

from __future__ import annotations

import math
import sys
from dataclasses import asdict, dataclass
from functools import cache, lru_cache
from pathlib import Path
from typing import TYPE_CHECKING, Any, cast

import numpy as np
from numba import njit, prange

from porrima import __version__, aperture, moments, shapes, stamps, weighted
from porrima.aperture import AperturePSF, aperture_covariance
from porrima.cache import content_key, load, save
from porrima.moments import INDICES, N_MOMENTS, ORDER
from porrima.reach import settled, stamp_reach
from porrima.shapes import Adaptive, Failure, GaussianWeight, Plain, Shape
from porrima.weighted import Derivatives, WeightedPSF, exact_covariance

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from porrima.moments import KernelMoments
    from porrima.psf import PSF
    from porrima.shapes import Estimator

    FloatArray = NDArray[np.float64]
    IntArray = NDArray[np.int64]

__all__ = ["Response", "response"]

EXACT_THRESHOLD = 0.005
"""Change of shape above which second order is left for the exact solution (dimensionless)."""

SERIES_LIMIT = 0.01
"""Largest share of moments of the highest order in a size change; what they leave out is about a third of
theirs (dimensionless)."""

GROWTH_LIMIT = 0.3
"""Largest relative change of R² for which an adaptive weight is followed: 5e-4 of that change is lost there,
and ten times more for every tenth beyond (dimensionless)."""

CHUNK = 1 << 16
"""Stacks evaluated at once, so that the memory needed does not grow with their number (count)."""

_XX, _XY, _YY = (INDICES.index(powers) for powers in ((2, 0), (1, 1), (0, 2)))


PRODUCT_ORDER = ORDER + 4
"""Largest sum of orders of two moments whose product is taken: what is left out is below 1e-7 of the change."""

_ORDERS = np.sum(INDICES, axis=1)
_LAST = np.array([int(np.sum(_ORDERS + n <= PRODUCT_ORDER)) for n in _ORDERS if 2 * n <= PRODUCT_ORDER])
_I, _J = np.array([(i, j) for i, last in enumerate(_LAST) for j in range(i, last)]).T
_HIGHEST = N_MOMENTS - ORDER - 1
_NOT_FINITE, _SERIES = int(Failure.NOT_FINITE), int(Failure.SERIES)


@njit(cache=True, parallel=True, fastmath={"contract"})
def _second_order(values, first, products, last, most, change, flag):  # type: ignore[no-untyped-def]
    """Change of (e1, e2, r2) of each stack, (n, 3): first order and `products` of pairs of moments; failures.

    `last` says for each moment that comes first in a product how far the second goes; `most` is the largest
    change of r2 that is followed.  Not a product of matrices: BLAS may round a row by how many rows there are, and
    the same stack must give the same bits in any chunk.
    """
    for s in prange(values.shape[0]):
        moments, row, e1, e2, r2, tail = values[s], 0, 0.0, 0.0, 0.0, 0.0
        for i in range(moments.size):
            slope1, slope2, slope3 = first[0, i], first[1, i], first[2, i]
            if i < last.size:
                for j in range(i, last[i]):
                    slope1 += products[0, row] * moments[j]
                    slope2 += products[1, row] * moments[j]
                    slope3 += products[2, row] * moments[j]
                    row += 1
            if i >= _HIGHEST:
                tail += slope3 * moments[i]
            e1, e2, r2 = e1 + slope1 * moments[i], e2 + slope2 * moments[i], r2 + slope3 * moments[i]
        change[s, 0], change[s, 1], change[s, 2] = e1, e2, r2
        if not math.isfinite(e1 + e2 + r2):
            flag[s] = _NOT_FINITE
        elif abs(r2) > most or abs(tail) > SERIES_LIMIT * abs(moments[_XX] + moments[_YY]):
            flag[s] = _SERIES


@dataclass(frozen=True, slots=True, kw_only=True)
class Response:
    r"""What an estimator makes of small kernels behind one PSF.

    Parameters
    ----------
    psf, estimator : str
        Their names.
    shape0 : Shape
        Shape of the PSF without companions; r2 in arcsec².
    first : (3, n_moment) float array
        :math:`\partial s / \partial m_{ab}` of s = (e1, e2, r2) in the order of `moments.INDICES`, in
        arcsec^-(a+b), times arcsec² for r2.
    second : (3, n_moment, n_moment) float array
        :math:`\partial^2 s / \partial m_{ab} \partial m_{cd}`, symmetric, in arcsec^-(a+b+c+d), times
        arcsec² for r2.
    weighted : WeightedPSF, AperturePSF or None
        For the exact solution; None where the measurement has no weight.

    References
    ----------
    KCM16, Hirata2003
    """

    psf: str
    estimator: str
    shape0: Shape
    first: FloatArray
    second: FloatArray
    weighted: WeightedPSF | AperturePSF | None

    @property
    def kappa_r2(self) -> float:
        r""":math:`\delta R^2 / (R_0^2 \eta)` for an isotropic population, r → 0 (dimensionless)."""
        return float(self._isotropic()[2] / self.shape0.r2)

    @property
    def de1_deta(self) -> float:
        r""":math:`\delta e_1 / \eta` for an isotropic population, r → 0 (dimensionless)."""
        return float(self._isotropic()[0])

    @property
    def de2_deta(self) -> float:
        r""":math:`\delta e_2 / \eta` for an isotropic population, r → 0 (dimensionless)."""
        return float(self._isotropic()[1])

    def _isotropic(self) -> FloatArray:
        """Change of (e1, e2, r2) per eta: m20 = m02 = eta R0² / 2, and nothing else at first order."""
        change: FloatArray = (self.first[:, _XX] + self.first[:, _YY]) * self.shape0.r2 / 2
        return change

    def shapes(self, moments: KernelMoments, threshold: float = EXACT_THRESHOLD) -> Shape:
        r"""Measured shapes of stacks.

        Parameters
        ----------
        moments : KernelMoments
            Mean kernel moments of n stacks.
        threshold : float
            Relative change of R², or change of e1 or e2, above which the measurement is solved exactly;
            0 solves all (dimensionless).

        Returns
        -------
        shape : Shape
            (n,) arrays; NaN and flagged where there is no solution, or where the series cannot be
            trusted: moments of order `ORDER` have more than `SERIES_LIMIT` of the size change, or an
            adaptive weight changes by more than `GROWTH_LIMIT`.

        Notes
        -----
        .. math:: s = s_0 + \frac{\partial s}{\partial m} m
                  + \frac12 m^T \frac{\partial^2 s}{\partial m^2} m .

        Its error is third order in the change, 1e-4 of it where it is 0.5 %.  Products of moments are taken
        to a sum of orders of `PRODUCT_ORDER`.  Without a weight the result is :math:`Q_0 + m_2`, exact.  The
        kernels themselves are known to order `ORDER`: 1e-6 of the change for separations of 0.05 arcsec behind
        a FWHM of 0.137 arcsec.
        """
        pieces = [
            self._shapes(moments.values[start : start + CHUNK], threshold)
            for start in range(0, max(1, len(moments)), CHUNK)
        ]
        return Shape(**{k: np.concatenate([getattr(p, k) for p in pieces]) for k in Shape.__slots__})

    def _shapes(self, values: FloatArray, threshold: float) -> Shape:
        """Shapes of one chunk of stacks."""
        flag = np.zeros(len(values), dtype=np.int64)
        if self.weighted is None:
            flag[~np.all(np.isfinite(values), axis=1)] = _NOT_FINITE
            return Shape.from_covariance(self.shape0.covariance() + values[:, [_XX, _XY, _YY]], flag)
        adapts = isinstance(self.weighted, WeightedPSF) and self.weighted.fixed == 0
        most = GROWTH_LIMIT * float(self.shape0.r2) if adapts else np.inf
        products = self.second[:, _I, _J] * np.where(_I == _J, 0.5, 1.0)
        change = np.empty((len(values), 3))
        _second_order(np.ascontiguousarray(values), self.first, products, _LAST, most, change, flag)
        shape = self._shape_of(change, flag)
        r2_0 = float(self.shape0.r2)
        e1, e2, r2 = np.abs(change.T)
        large = ((e1 > threshold) | (e2 > threshold) | (r2 > threshold * r2_0)) & (flag == 0)
        if large.any():
            guess = self._shape_of(change[large], flag[large]).covariance()
            covariance = self._exact(values[large], guess)
            failed = np.where(np.isfinite(covariance[:, 0]), 0, int(Failure.NOT_CONVERGED))
            solved = Shape.from_covariance(covariance, failed)
            for name in Shape.__slots__:
                getattr(shape, name)[large] = getattr(solved, name)
        return shape

    def _shape_of(self, change: FloatArray, flag: IntArray) -> Shape:
        """Shape from its change (n, 3); NaN where flagged."""
        e1, e2, r2 = (
            np.where(flag == 0, change[:, k] + getattr(self.shape0, name), np.nan)
            for k, name in enumerate(("e1", "e2", "r2"))
        )
        return Shape(e1=e1, e2=e2, r2=r2, flag=flag)

    def _exact(self, values: FloatArray, guess: FloatArray) -> FloatArray:
        """Measured second moments of stacks from the equations of the measurement themselves."""
        if isinstance(self.weighted, AperturePSF):
            return aperture_covariance(self.weighted, values)
        return exact_covariance(cast("WeightedPSF", self.weighted), values, guess)


def _shape_derivatives(covariance: FloatArray) -> Derivatives:
    """Gradient (3, 3) and Hessian (3, 3, 3) of (e1, e2, r2) by (Q11, Q12, Q22)."""
    trace = covariance[0] + covariance[2]
    of_trace = np.array([1.0, 0.0, 1.0])
    first, second = np.zeros((3, 3)), np.zeros((3, 3, 3))
    first[2] = of_trace
    for k, of_part in enumerate(np.array([[1.0, 0.0, -1.0], [0.0, 2.0, 0.0]])):
        e = of_part @ covariance / trace
        first[k] = (of_part - e * of_trace) / trace
        mixed = np.outer(of_trace, first[k])
        second[k] = -(mixed + mixed.T) / trace
    return Derivatives(first=first, second=second)


def response(psf: PSF, estimator: Estimator) -> Response:
    """Response of an estimator behind a PSF.

    Parameters
    ----------
    psf : PSF
        Any PSF: only its image, drawn once, enters.
    estimator : Estimator
        `Plain`, `Adaptive` or `GaussianWeight`; plain moments that diverge are taken within an aperture
        (`shapes.settled`).

    Returns
    -------
    response : Response
        Kept, so that the same question is answered at once, in memory and on disk.

    Raises
    ------
    TypeError
        If the estimator is none of the three.
    ValueError
        If the PSF has no fixed point under the weight.

    Notes
    -----
    On disk (`cache`) the name of a response is a hash of the PSF's pixels, the estimator and the code that
    made it.
    """
    return _response(psf, estimator)


@lru_cache(maxsize=128)
def _response(psf: PSF, estimator: Estimator) -> Response:
    """What `response` keeps."""
    if not isinstance(estimator, Plain | Adaptive | GaussianWeight):
        raise TypeError(
            f"estimator must be Plain, Adaptive or GaussianWeight, got {type(estimator).__name__}"
        )
    estimator = settled(estimator, psf)
    image = psf.draw(reach=stamp_reach(estimator, psf))
    key = content_key(image.array, float(image.scale), estimator.name, _code_version())
    known = load(key)
    if known is None:
        try:
            known = _arrays(image, estimator)
        except ValueError as error:
            raise ValueError(f"{psf.name}: {error}") from None
        save(key, known)
    shape0 = Shape.from_covariance(known.pop("covariance0"), int(known.pop("flag0")))
    first, second = known.pop("first"), known.pop("second")
    kind: type[WeightedPSF | AperturePSF] = WeightedPSF if "fixed" in known else AperturePSF
    fields: dict[str, Any] = {k: float(v) if k in ("unit", "fixed") else v for k, v in known.items()}
    return Response(
        psf=psf.name,
        estimator=estimator.name,
        shape0=shape0,
        first=first,
        second=second,
        weighted=kind(**fields) if fields else None,
    )


@cache
def _code_version() -> str:
    """Hash of the modules that a response is made with."""
    modules = aperture, moments, shapes, stamps, weighted, sys.modules[__name__]
    return content_key(__version__, *(Path(str(module.__file__)).read_bytes() for module in modules))


def _arrays(image: Any, estimator: Any) -> dict[str, Any]:
    """A response as arrays: shape without companions, derivatives, and the fields of its `weighted`."""
    if isinstance(estimator, Plain) and estimator.aperture is None:
        found = estimator.measure(image)
        inner = Derivatives(first=np.zeros((3, N_MOMENTS)), second=np.zeros((3, N_MOMENTS, N_MOMENTS)))
        inner.first[[0, 1, 2], [_XX, _XY, _YY]] = 1.0  # Q = Q0 + m2
        parts: dict[str, Any] = {}
        covariance, unit, flag = found.covariance(), 1.0, int(found.flag)
    else:
        about: WeightedPSF | AperturePSF
        if isinstance(estimator, Plain):
            about = aperture.aperture_psf(image, estimator)
            inner = aperture.aperture_derivatives(about)
        else:
            about = weighted.weighted_psf(image, estimator)
            inner = weighted.covariance_derivatives(about)
        parts = asdict(about)
        covariance, unit, flag = about.covariance, about.unit, 0
    outer = _shape_derivatives(covariance)
    second = np.einsum("kij,im,jn->kmn", outer.second, inner.first, inner.first, optimize=True)
    second += np.einsum("ki,imn->kmn", outer.first, inner.second)
    arcsec = unit ** -np.sum(INDICES, axis=1, dtype=float)  # from powers of unit to powers of arcsec
    size = np.array([1.0, 1.0, unit**2])
    return parts | {
        "covariance0": covariance * unit**2,
        "flag0": flag,
        "first": outer.first @ inner.first * arcsec * size[:, None],
        "second": second * np.outer(arcsec, arcsec) * size[:, None, None],
    }
