"""The PSF under its own Gaussian weight: integrals, fixed point, and the exact measurement of a stack.

`response` says which integrals J and sums T these are.  Here everything is in powers of one unit of length.
"""

from __future__ import annotations

from dataclasses import dataclass
from math import factorial
from typing import TYPE_CHECKING, Any

import numpy as np
from numba import njit, prange

from porrima.moments import INDICES, ORDER
from porrima.shapes import GaussianWeight
from porrima.stamps import measure_stamps

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from porrima.shapes import Adaptive

    FloatArray = NDArray[np.float64]

__all__ = [
    "Derivatives",
    "WeightedPSF",
    "covariance_derivatives",
    "exact_covariance",
    "half_light_radius",
    "implicit_derivatives",
    "weighted_psf",
]

EXACT_ORDER = 20
"""Degree at which the exact solution cuts the effective kernel: 3e-8 of the size change of a worst pair."""

FIXED_ORDER = ORDER + 4
"""The same for a fixed weight, which does not grow: only the small shift of its centre adds to the kernel."""

FARTHEST = 80.0
"""Exponent of the weight beyond which pixels do not count: 12.6 sigmas, 1e-9 of the integrals of order 24."""

MAX_STEPS = 100
"""Newton steps in search of the fixed point of a PSF (count)."""

_A, _B = np.array(INDICES).T.copy()
_FACTORIALS = np.array([float(factorial(a) * factorial(b)) for a, b in INDICES])


@njit(cache=True)
def _row_integrals(pixels, y, x0, step, precision, norm, order, integrals, h):  # type: ignore[no-untyped-def]
    """Add a row's share of the integrals: its pixels times H_ab W, a + b <= order.

    (d/dx)^a (d/dy)^b W = (-1)^(a+b) H_ab W, with H_{a+1,b} = y1 H_ab - a P11 H_{a-1,b} - b P12 H_{a,b-1}
    for P = M^-1 and y = P (x - x0).
    """
    p11, p12, p22 = precision
    for column in range(pixels.shape[0]):
        x = (column - 0.5 * (pixels.shape[0] - 1)) * step - x0
        y1, y2 = p11 * x + p12 * y, p12 * x + p22 * y
        exponent = 0.5 * (x * y1 + y * y2)
        if exponent > FARTHEST or pixels[column] == 0.0:
            continue
        h[0, 0] = norm * np.exp(-exponent) * pixels[column]
        for b in range(order + 1):
            if b > 0:
                h[0, b] = y2 * h[0, b - 1] - ((b - 1) * p22 * h[0, b - 2] if b > 1 else 0.0)
            for a in range(order - b):
                value = y1 * h[a, b]
                if a > 0:
                    value -= a * p11 * h[a - 1, b]
                if b > 0:
                    value -= b * p12 * h[a, b - 1]
                h[a + 1, b] = value
            for a in range(order + 1 - b):
                integrals[a, b] += h[a, b]


@njit(cache=True, parallel=True)
def _weight_integrals(pixels, step, centre, covariance, order):  # type: ignore[no-untyped-def]
    """Integrals J[a, b], a + b <= order, as sums over pixels of side `step` from the middle of the stamp."""
    det = covariance[0] * covariance[2] - covariance[1] ** 2
    precision = (covariance[2] / det, -covariance[1] / det, covariance[0] / det)
    norm = step * step / (2 * np.pi * np.sqrt(det))
    rows = np.zeros((pixels.shape[0], order + 1, order + 1))  # added in their order, whatever the threads
    for row in prange(pixels.shape[0]):
        y = (row - 0.5 * (pixels.shape[0] - 1)) * step - centre[1]
        if 0.5 * y * y / covariance[2] < FARTHEST:
            h = np.zeros((order + 1, order + 1))
            _row_integrals(pixels[row], y, centre[0], step, precision, norm, order, rows[row], h)
    integrals = np.zeros((order + 1, order + 1))
    for row in range(pixels.shape[0]):
        integrals += rows[row]
    for a in range(order + 1):
        for b in range(order + 1 - a):
            integrals[a, b] *= (-1.0) ** (a + b)
    return integrals


@njit(cache=True)
def _equations(t, q, fixed, out):  # type: ignore[no-untyped-def]
    """Write the five equations of the measurement (column 0) and their gradient (columns 1 to 5) to `out`.

    Unknowns: centre of the weight (2), measured covariance Q = (Q11, Q12, Q22).  Linear in T.
    T_i = 0 and T_ij + B_ij T_0 = 0, with B = Q^-1 / 2 where the weight adapts (M = Q), and
    B = P - P Q P where it is fixed with P = `fixed` times the unit matrix.
    """
    b = np.empty(3)
    db = np.zeros((3, 3))  # of each B by each Q
    if fixed > 0.0:
        b[0], b[1], b[2] = fixed - fixed**2 * q[0], -(fixed**2) * q[1], fixed - fixed**2 * q[2]
        db[0, 0] = db[1, 1] = db[2, 2] = -(fixed**2)
    else:
        det = q[0] * q[2] - q[1] ** 2
        p11, p12, p22 = q[2] / det, -q[1] / det, q[0] / det
        b[0], b[1], b[2] = 0.5 * p11, 0.5 * p12, 0.5 * p22
        db[0, 0], db[0, 1], db[0, 2] = -0.5 * p11**2, -p11 * p12, -0.5 * p12**2
        db[1, 0], db[1, 1], db[1, 2] = -0.5 * p11 * p12, -0.5 * (p11 * p22 + p12**2), -0.5 * p12 * p22
        db[2, 0], db[2, 1], db[2, 2] = -0.5 * p12**2, -p12 * p22, -0.5 * p22**2
    adapt = 0.0 if fixed > 0.0 else 1.0
    for k in range(5):
        i = (1, 0, 2, 1, 0)[k]
        j = (0, 1, 0, 1, 2)[k]
        scalar = b[k - 2] if k > 1 else 0.0
        out[k, 0] = t[i, j] + scalar * t[0, 0]
        out[k, 1] = -t[i + 1, j] - scalar * t[1, 0]
        out[k, 2] = -t[i, j + 1] - scalar * t[0, 1]
        out[k, 3] = adapt * 0.5 * (t[i + 2, j] + scalar * t[2, 0])
        out[k, 4] = adapt * (t[i + 1, j + 1] + scalar * t[1, 1])
        out[k, 5] = adapt * 0.5 * (t[i, j + 2] + scalar * t[0, 2])
        if k > 1:
            for n in range(3):
                out[k, 3 + n] += db[k - 2, n] * t[0, 0]


@njit(cache=True)
def _newton_step(system):  # type: ignore[no-untyped-def]
    """Solve gradient . step = -value in place by elimination with pivots; return False if singular."""
    for k in range(5):
        pivot = k
        for row in range(k + 1, 5):
            if abs(system[row, 1 + k]) > abs(system[pivot, 1 + k]):
                pivot = row
        if not abs(system[pivot, 1 + k]) > 1e-300:
            return False
        for column in range(6):
            swap = system[k, column]
            system[k, column] = system[pivot, column]
            system[pivot, column] = swap
        for row in range(5):
            if row != k:
                factor = system[row, 1 + k] / system[k, 1 + k]
                for column in range(6):
                    system[row, column] -= factor * system[k, column]
    for k in range(5):
        system[k, 0] = -system[k, 0] / system[k, 1 + k]
    return True


@njit(cache=True)
def _linearised(t, q, fixed):  # type: ignore[no-untyped-def]
    """Value and gradient of the five equations, as an array (5, 6)."""
    out = np.empty((5, 6))
    _equations(t, q, fixed, out)
    return out


@njit(cache=True)
def _effective_kernel(kernel, shift, growth, order, exponential, out):  # type: ignore[no-untyped-def]
    """Coefficients of kernel(k) exp(-k . shift + k^T growth k / 2) up to degree `order`.

    That is the kernel seen from a weight that has moved by `shift` and grown by `growth`: a growth that
    is not positive is no kernel at all, but its polynomial is as good.
    """
    for total in range(order + 1):
        for b in range(total + 1):
            a = total - b
            out[a, b] = 0.0
            if total == 0:
                value = 1.0
            elif a > 0:
                value = -shift[0] * exponential[a - 1, b]
                value += growth[0] * exponential[a - 2, b] if a > 1 else 0.0
                value += growth[1] * exponential[a - 1, b - 1] if b > 0 else 0.0
                value /= a
            else:
                value = -shift[1] * exponential[0, b - 1]
                value += growth[2] * exponential[0, b - 2] if b > 1 else 0.0
                value /= b
            exponential[a, b] = value
    for a in range(kernel.shape[0]):
        for b in range(kernel.shape[1] - a):
            if kernel[a, b] != 0.0:
                for c in range(order + 1 - a - b):
                    for d in range(order + 1 - a - b - c):
                        out[a + c, b + d] += kernel[a, b] * exponential[c, d]


@njit(cache=True)
def _solve_one(kernel, q, base, fixed, integrals, order):  # type: ignore[no-untyped-def]
    """Improve the guess q of one stack's measured covariance by Newton's method; return False if it fails."""
    exponential, effective = np.zeros((order + 1, order + 1)), np.zeros((order + 1, order + 1))
    t, system = np.zeros((5, 5)), np.empty((5, 6))
    shift, growth = np.zeros(2), np.zeros(3)
    for _ in range(30):
        if not (q[0] + q[2] > 0.0 and q[0] * q[2] > q[1] ** 2):
            return False
        if fixed == 0.0:
            for k in range(3):
                growth[k] = q[k] - base[k]
        _effective_kernel(kernel, shift, growth, order, exponential, effective)
        for a in range(5):
            for b in range(5 - a):
                total = 0.0
                for c in range(order + 1):
                    for d in range(order + 1 - c):
                        total += effective[c, d] * integrals[a + c, b + d]
                t[a, b] = total
        _equations(t, q, fixed, system)
        if not _newton_step(system):
            return False
        longest = 0.0
        for k in range(5):
            longest = max(longest, abs(system[k, 0]))
        shift[0] += system[0, 0]
        shift[1] += system[1, 0]
        for k in range(3):
            q[k] += system[2 + k, 0]
        # Newton squares the error: after a step of 1e-8 nothing is left in float64.
        if longest < 1e-8 * (q[0] + q[2]):
            return True
    return False


@njit(cache=True, parallel=True)
def _solve(kernels, start, base, fixed, integrals, order):  # type: ignore[no-untyped-def]
    """Measured covariance of each stack by Newton's method on the integrals of the PSF; NaN where it fails.

    kernels (n, 9, 9): kernel moments over a! b!; start (n, 3): first guess; base (3): covariance of the
    weight to which the integrals belong, in whose frame the effective kernel is built.
    """
    found = start.copy()
    for i in prange(kernels.shape[0]):
        if not _solve_one(kernels[i], found[i], base, fixed, integrals, order):
            for k in range(3):
                found[i, k] = np.nan
    return found


@dataclass(frozen=True, slots=True, kw_only=True)
class WeightedPSF:
    """The PSF under its own weight: all that the measurement of a stack needs to know of the image.

    Parameters
    ----------
    unit : float
        Length in whose powers the rest is given, in arcsec.
    covariance : (3,) float array
        Measured second moments Q11, Q12, Q22 of the PSF, in unit².
    fixed : float
        Inverse variance of a fixed weight in unit^-2; 0 where the weight adapts.
    integrals : (n, n) float array
        J[a, b] of the weight that belongs to the PSF, a + b < n, over J[0, 0], in unit^-(a+b).
    """

    unit: float
    covariance: FloatArray
    fixed: float
    integrals: FloatArray


@dataclass(frozen=True, slots=True, kw_only=True)
class Derivatives:
    """First and second derivatives of k results by n arguments.

    Parameters
    ----------
    first : (k, n) float array
        Dimensionless, or in the powers of the unit that the maker names.
    second : (k, n, n) float array
        Symmetric in the last two.
    """

    first: FloatArray
    second: FloatArray


def half_light_radius(image: Any) -> float:
    """Radius of the disc with as many pixels as are brighter than half the maximum.

    Parameters
    ----------
    image : galsim.Image
        With its scale in arcsec.

    Returns
    -------
    radius : float
        Half the FWHM of a round PSF, in arcsec.
    """
    pixels = image.array
    return float(np.sqrt((pixels >= 0.5 * pixels.max()).sum() / np.pi) * image.scale)


def weighted_psf(image: Any, estimator: Adaptive | GaussianWeight) -> WeightedPSF:
    """Fixed point of a PSF under a Gaussian weight, and the integrals that belong to it.

    Parameters
    ----------
    image : galsim.Image
        Of the PSF, with its scale in arcsec.
    estimator : Adaptive or GaussianWeight
        A fixed weight need only find its centre.

    Returns
    -------
    weighted : WeightedPSF
        Where `stamps` measures the image, found to 1e-14 by Newton steps on sums over pixels.

    Raises
    ------
    ValueError
        If there is no stable fixed point.

    Notes
    -----
    Sums over pixels are integrals to the float64 limit when PSF times weight is band-limited by the grid
    and ends inside the stamp.

    References
    ----------
    Hirata2003
    """
    unit = half_light_radius(image)
    found = measure_stamps(image.array[None], image.scale, estimator)
    if found.shape.flag[0]:
        raise ValueError(f"psf must have a stable fixed point under its weight, got none by {estimator.name}")
    pixels, step = np.ascontiguousarray(image.array), image.scale / unit
    fixed = (unit / estimator.sigma) ** 2 if isinstance(estimator, GaussianWeight) else 0.0
    centre, q = np.array([found.x[0], found.y[0]]) / unit, found.shape.covariance()[0] / unit**2
    for _ in range(MAX_STEPS):
        weight = np.array([1.0, 0.0, 1.0]) / fixed if fixed > 0 else q
        integrals = _weight_integrals(pixels, step, centre, weight, 4)
        system = _linearised(integrals / integrals[0, 0], q, fixed)
        move = -np.linalg.solve(system[:, 1:], system[:, 0])
        centre, q = centre + move[:2], q + move[2:]
        if np.abs(move).max() < 1e-9 * (q[0] + q[2]):  # Newton squares the error
            break
    else:
        raise ValueError(f"psf must have a stable fixed point under its weight, got none by {estimator.name}")
    weight = np.array([1.0, 0.0, 1.0]) / fixed if fixed > 0 else q
    order = FIXED_ORDER if fixed > 0 else EXACT_ORDER
    integrals = _weight_integrals(pixels, step, centre, weight, order + 4)
    return WeightedPSF(unit=unit, covariance=q, fixed=fixed, integrals=integrals / integrals[0, 0])


def exact_covariance(
    weighted: WeightedPSF, values: FloatArray, guess: FloatArray, order: int | None = None
) -> FloatArray:
    r"""Measured second moments of stacks: the equations of the measurement solved, not expanded.

    Parameters
    ----------
    weighted : WeightedPSF
        The PSF.
    values : (n, n_moment) float array
        Kernel moments in the order of `moments.INDICES`, in arcsec^(a+b).
    guess : (n, 3) float array
        Q11, Q12, Q22 from which Newton's method starts, in arcsec².
    order : int, optional
        Degree at which the effective kernel is cut; by default as high as the integrals reach.

    Returns
    -------
    covariance : (n, 3) float array
        Q11, Q12, Q22, in arcsec²; NaN where there is no solution.

    Notes
    -----
    A weight that has moved by s and grown by G sees, in place of the kernel,

    .. math:: \frac{\mu_{ab}}{a!\, b!} = [k_1^a k_2^b]\; \hat m(k)\, e^{-k \cdot s + \frac12 k^T G k},
              \qquad \hat m(k) = \sum_{ab} \frac{m_{ab}}{a!\, b!} k_1^a k_2^b ,

    so the integrals of the PSF under its own weight serve for all weights, and Newton's method needs no
    pixels.  Each stack is solved alone: the same bits in any chunk.
    """
    kernels = np.zeros((values.shape[0], ORDER + 1, ORDER + 1))
    kernels[:, 0, 0] = 1.0
    kernels[:, _A, _B] = values / (_FACTORIALS * weighted.unit ** (_A + _B))
    # Where second order has lost its way altogether, the PSF itself is the better guess.
    bad = ~((guess[:, 0] + guess[:, 2] > 0) & (guess[:, 0] * guess[:, 2] > guess[:, 1] ** 2))
    start = np.where(bad[:, None], weighted.covariance, guess / weighted.unit**2)
    integrals = weighted.integrals
    order = len(integrals) - 5 if order is None else order
    solved: FloatArray = _solve(kernels, start, weighted.covariance, weighted.fixed, integrals, order)
    return solved * weighted.unit**2


def covariance_derivatives(weighted: WeightedPSF) -> Derivatives:
    r"""Derivatives of the measured second moments with respect to kernel moments, at no kernel.

    Parameters
    ----------
    weighted : WeightedPSF
        The PSF.

    Returns
    -------
    derivatives : Derivatives
        Of (Q11, Q12, Q22) by the moments in the order of `moments.INDICES`, in powers of the unit.

    Notes
    -----
    Implicit differentiation of :math:`G(\theta, m) = 0`, which is linear in m:

    .. math:: \theta' = -G_\theta^{-1} G_m, \qquad
              \theta'' = -G_\theta^{-1} (G_{\theta\theta} \theta' \theta'
                         + G_{\theta m} \theta' + \theta' G_{m \theta}) .

    Exact.
    """
    j, q, fixed = weighted.integrals, weighted.covariance, weighted.fixed

    def linearised(a: int, b: int) -> Any:
        return _linearised(np.ascontiguousarray(j[a : a + 5, b : b + 5]), q, fixed)

    by_moment = np.stack([linearised(a, b) / f for (a, b), f in zip(INDICES, _FACTORIALS, strict=True)])
    hessian = np.stack([c * linearised(a, b)[:, 1:] for c, a, b in _operators(fixed)], axis=2)
    hessian += _constraint_curvature(j, q, fixed)
    cross = by_moment[:, :, 1:].transpose(1, 0, 2)
    return implicit_derivatives(linearised(0, 0)[:, 1:], hessian, by_moment[:, :, 0].T, cross)


def implicit_derivatives(
    gradient: FloatArray, hessian: FloatArray, by_moment: FloatArray, cross: FloatArray
) -> Derivatives:
    """Derivatives of (Q11, Q12, Q22) from those of the five equations that define them.

    Parameters
    ----------
    gradient : (5, 5) float array
        Of the equations by the unknowns: the centre (2) and Q (3), dimensionless.
    hessian : (5, 5, 5) float array
        Of the equations by the unknowns twice.
    by_moment : (5, n) float array
        Of the equations, which are linear in the moments, by each of n moments.
    cross : (5, n, 5) float array
        Of these by the unknowns.

    Returns
    -------
    derivatives : Derivatives
        Of Q by the moments.
    """
    inverse = np.linalg.inv(gradient)
    first = -inverse @ by_moment
    mixed = np.einsum("kni,im->kmn", cross, first)
    curved = np.einsum("kij,im,jn->kmn", hessian, first, first, optimize=True)
    second = -np.einsum("lk,kmn->lmn", inverse, curved + mixed + mixed.transpose(0, 2, 1))
    return Derivatives(first=first[2:], second=second[2:])


def _operators(fixed: float) -> tuple[tuple[float, int, int], ...]:
    """Each unknown's derivative of any T, as factor and orders in x and y."""
    adapt = 0.0 if fixed > 0 else 1.0
    return (-1.0, 1, 0), (-1.0, 0, 1), (adapt / 2, 2, 0), (adapt, 1, 1), (adapt / 2, 0, 2)


def _constraint_curvature(j: FloatArray, q: FloatArray, fixed: float) -> FloatArray:
    """Terms of the equations' Hessian (5, 5, 5) in which the second derivative falls on B(Q)."""
    by_unknown = np.array([c * j[a, b] for c, a, b in _operators(fixed)])
    only_t0 = np.zeros((5, 5))
    only_t0[0, 0] = 1.0
    slopes = _linearised(only_t0, q, fixed)[2:, 3:]  # without the other T nothing is left but dB / dQ
    hessian = np.zeros((5, 5, 5))
    hessian[2:, :, 2:] = by_unknown[None, :, None] * slopes[:, None, :]
    if fixed == 0:  # B = P / 2, and the derivative of P = Q^-1 is -P dQ P
        p = np.linalg.inv(q[[0, 1, 1, 2]].reshape(2, 2))
        basis = np.array([[[1, 0], [0, 0]], [[0, 1], [1, 0]], [[0, 0], [0, 1]]], dtype=float)
        bent = 0.5 * np.einsum("ab,ibc,cd,jde,ef->ijaf", p, basis, p, basis, p)
        bent = bent + bent.transpose(1, 0, 2, 3)
        for k, (a, b) in enumerate(((0, 0), (0, 1), (1, 1))):
            hessian[2 + k, 2:, 2:] += bent[:, :, a, b] * j[0, 0]
    return hessian
