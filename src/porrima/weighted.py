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

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from porrima.psf import PSF

    FloatArray = NDArray[np.float64]

__all__ = ["Derivatives", "WeightedPSF", "covariance_derivatives", "exact_covariance", "weighted_psf"]

EXACT_ORDER = 20
"""Degree at which the exact solution cuts the effective kernel: 3e-8 of the size change of a worst pair."""

MAX_STEPS = 100
"""Newton steps in search of the fixed point of a PSF (count)."""

_A, _B = np.array(INDICES).T.copy()
_FACTORIALS = np.array([float(factorial(a) * factorial(b)) for a, b in INDICES])


@njit(cache=True)
def _weight_integrals(pixels, step, centre, covariance, order):  # type: ignore[no-untyped-def]
    """Integrals J[a, b], a + b <= order, as sums over pixels of side `step` from the middle of the stamp.

    (d/dx)^a (d/dy)^b W = (-1)^(a+b) H_ab W, with H_{a+1,b} = y1 H_ab - a P11 H_{a-1,b} - b P12 H_{a,b-1}
    for P = M^-1 and y = P (x - x0).
    """
    det = covariance[0] * covariance[2] - covariance[1] ** 2
    p11, p12, p22 = covariance[2] / det, -covariance[1] / det, covariance[0] / det
    norm = step * step / (2 * np.pi * np.sqrt(det))
    integrals = np.zeros((order + 1, order + 1))
    h = np.zeros((order + 1, order + 1))
    for row in range(pixels.shape[0]):
        dy = (row - 0.5 * (pixels.shape[0] - 1)) * step - centre[1]
        for column in range(pixels.shape[1]):
            dx = (column - 0.5 * (pixels.shape[1] - 1)) * step - centre[0]
            y1, y2 = p11 * dx + p12 * dy, p12 * dx + p22 * dy
            exponent = 0.5 * (dx * y1 + dy * y2)
            if exponent > 300.0 or pixels[row, column] == 0.0:
                continue
            h[0, 0] = norm * np.exp(-exponent) * pixels[row, column]
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


def weighted_psf(psf: PSF, fixed_sigma: float = 0.0) -> WeightedPSF:
    """Fixed point of a PSF under a Gaussian weight, and the integrals that belong to it.

    Parameters
    ----------
    psf : PSF
        Drawn once.
    fixed_sigma : float
        Sigma of a fixed weight, which only its centre must fit, in arcsec; 0 for the adaptive weight.

    Returns
    -------
    weighted : WeightedPSF
        Found by damped Newton steps on sums over pixels, to 1e-13.

    Raises
    ------
    ValueError
        If there is no fixed point.

    Notes
    -----
    Sums over pixels are integrals to the float64 limit when PSF times weight is band-limited by the grid
    and ends inside the stamp.

    References
    ----------
    Hirata2003
    """
    image = psf.draw()
    unit = psf.fwhm / 2
    pixels, step = np.ascontiguousarray(image.array), image.scale / unit
    fixed = (unit / fixed_sigma) ** 2 if fixed_sigma > 0 else 0.0
    centre, q = np.zeros(2), np.array([0.72, 0.0, 0.72])  # a Gaussian of that FWHM, in units of (FWHM/2)²
    for _ in range(MAX_STEPS):
        weight = np.array([1.0, 0.0, 1.0]) / fixed if fixed > 0 else q
        integrals = _weight_integrals(pixels, step, centre, weight, 4)
        system = _linearised(integrals / integrals[0, 0], q, fixed)
        move = -np.linalg.solve(system[:, 1:], system[:, 0])
        size2 = q[0] + q[2]
        # As in HSM, no step may be longer than a quarter of the size; the equations of a fixed weight are
        # linear in Q, so there only the centre can go astray.
        longest = np.abs(move[:2]).max() / np.sqrt(size2)
        if fixed == 0:
            longest = max(longest, np.abs(move[2:]).max() / size2)
        move *= min(1.0, 0.25 / longest) if longest > 0 else 1.0
        centre, q = centre + move[:2], q + move[2:]
        if longest < 1e-13:
            break
    # Between two sources a fixed weight of 1/`fixed` is in balance, but the balance is not stable.
    slope = np.eye(2) - fixed * q[[0, 1, 1, 2]].reshape(2, 2)
    if not (longest < 1e-13 and np.trace(slope) > 0 and np.linalg.det(slope) > 0):
        raise ValueError(f"psf must have a stable fixed point under its weight, got {psf.name}")
    weight = np.array([1.0, 0.0, 1.0]) / fixed if fixed > 0 else q
    integrals = _weight_integrals(pixels, step, centre, weight, EXACT_ORDER + 4)
    return WeightedPSF(unit=unit, covariance=q, fixed=fixed, integrals=integrals / integrals[0, 0])


def exact_covariance(
    weighted: WeightedPSF, values: FloatArray, guess: FloatArray, order: int = EXACT_ORDER
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
    order : int
        Degree at which the effective kernel is cut, at most `EXACT_ORDER`.

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
    inverse = np.linalg.inv(linearised(0, 0)[:, 1:])
    first = -inverse @ by_moment[:, :, 0].T
    hessian = np.stack([c * linearised(a, b)[:, 1:] for c, a, b in _operators(fixed)], axis=2)
    hessian += _constraint_curvature(j, q, fixed)
    cross = np.einsum("nki,im->kmn", by_moment[:, :, 1:], first)
    curved = np.einsum("kij,im,jn->kmn", hessian, first, first, optimize=True)
    second = -np.einsum("lk,kmn->lmn", inverse, curved + cross + cross.transpose(0, 2, 1))
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
