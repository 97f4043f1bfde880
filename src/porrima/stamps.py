"""Shapes of many stamps at once: the three estimators compiled, in float64, on all threads."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
from numba import njit, prange

from porrima.shapes import APERTURE_EDGE, Adaptive, Failure, GaussianWeight, Plain, Shape

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from porrima.shapes import Estimator

    FloatArray = NDArray[np.float64]
    IntArray = NDArray[np.int64]

__all__ = ["Stamps", "measure_stamps"]

WEIGHT_RADIUS2 = 64.0
"""Squared radius, in sigmas of the weight, beyond which pixels are not looked at: the weight is 1e-14 there."""

LONGEST_STEP = 0.25
"""Longest step of the adaptive iteration, as a fraction of the (squared) size (Hirata & Seljak's code)."""

NEAR = 1e-3
"""Length of a step below which Newton's method takes over (dimensionless)."""

TOLERANCE = 1e-12
"""Length of a step at which the iteration has ended (dimensionless)."""

MAX_ITERATIONS = 400

COLLAPSED = 0.1
"""Squared minor axis, in pixels, below which an adaptive weight falls on a single row or pixel; no undersampled
star was found to have a stable fixed point below 0.19."""

_NOT_FINITE, _NO_FLUX = int(Failure.NOT_FINITE), int(Failure.NO_FLUX)
_NOT_CONVERGED, _NOT_POSITIVE = int(Failure.NOT_CONVERGED), int(Failure.NOT_POSITIVE)


@dataclass(frozen=True, slots=True, kw_only=True)
class Stamps:
    """What was measured on n stamps.

    Parameters
    ----------
    shape : Shape
        (n,) arrays; r2 in arcsec²; NaN and flagged where the measurement failed.
    x, y : (n,) float array
        Centroid under the estimator's own weight, from the middle of the stamp, in arcsec.
    """

    shape: Shape
    x: FloatArray
    y: FloatArray


@njit(cache=True, error_model="numpy", fastmath={"contract", "reassoc", "nsz"})
def _row(pixels, u, first, last, p11, top):  # type: ignore[no-untyped-def]
    """Sums of the pixels of a row under exp(-p11 u²/2) times `top`, times u^0 to u^4; u of pixel `first`.

    The weight is carried from pixel to pixel by two products, outwards from where it is largest, so that
    no error grows: 1e-13 at eight sigmas.
    """
    peak = min(max(first - round(u), first), last)
    u_peak = u + (peak - first)
    start = top * math.exp(-0.5 * p11 * u_peak * u_peak)
    curve = math.exp(-p11)
    s0 = s1 = s2 = s3 = s4 = 0.0
    for way in (1, -1):
        weight, v = start, u_peak
        ratio = math.exp(-p11 * (way * u_peak + 0.5))
        column = peak
        if way < 0:
            weight, v, column = weight * ratio, v - 1.0, column - 1
            ratio *= curve
        while first <= column <= last:
            value = weight * pixels[column]
            s0 += value
            value *= v
            s1 += value
            value *= v
            s2 += value
            value *= v
            s3 += value
            s4 += value * v
            weight *= ratio
            ratio *= curve
            v += way
            column += way
    return s0, s1, s2, s3, s4


@njit(cache=True, error_model="numpy")
def _weighted_sums(pixels, centre, m, sums):  # type: ignore[no-untyped-def]
    """Write sums[a, b] = sum of pixels W u^a v^b, a + b <= 4, about the centre of the weight of covariance m.

    Lengths in pixels from the middle of the stamp.
    """
    ny, nx = pixels.shape
    det = m[0] * m[2] - m[1] * m[1]
    p11, p12 = m[2] / det, -m[1] / det
    x0, y0 = centre[0] + 0.5 * (nx - 1), centre[1] + 0.5 * (ny - 1)
    reach = math.sqrt(WEIGHT_RADIUS2 * m[2])
    sums[:] = 0.0
    for row in range(max(0, math.ceil(y0 - reach)), min(ny - 1, math.floor(y0 + reach)) + 1):
        v = row - y0
        middle = x0 - p12 * v / p11
        half = math.sqrt(max(0.0, WEIGHT_RADIUS2 - v * v / m[2]) / p11)
        first, last = max(0, math.ceil(middle - half)), min(nx - 1, math.floor(middle + half))
        if first > last:
            continue
        s0, s1, s2, s3, s4 = _row(
            pixels[row], first - middle, first, last, p11, math.exp(-0.5 * v * v / m[2])
        )
        d = middle - x0  # from powers about the middle of the row's weight to powers about the centre
        t1 = s1 + d * s0
        t2 = s2 + d * (2 * s1 + d * s0)
        t3 = s3 + d * (3 * s2 + d * (3 * s1 + d * s0))
        t4 = s4 + d * (4 * s3 + d * (6 * s2 + d * (4 * s1 + d * s0)))
        power = 1.0
        for b in range(5):
            sums[0, b] += power * s0
            if b < 4:
                sums[1, b] += power * t1
            if b < 3:
                sums[2, b] += power * t2
            if b < 2:
                sums[3, b] += power * t3
            if b < 1:
                sums[4, b] += power * t4
            power *= v


@njit(cache=True, error_model="numpy")
def _solve_in_place(system):  # type: ignore[no-untyped-def]
    """Solve (n, n + 1), right-hand side last, by elimination with pivots; return False if singular."""
    n = system.shape[0]
    for k in range(n):
        pivot = k + np.argmax(np.abs(system[k:, k]))
        if not abs(system[pivot, k]) > 1e-300:
            return False
        for column in range(k, n + 1):
            swap = system[k, column]
            system[k, column] = system[pivot, column]
            system[pivot, column] = swap
        for row in range(n):
            if row != k:
                factor = system[row, k] / system[k, k]
                for column in range(k, n + 1):
                    system[row, column] -= factor * system[k, column]
    for k in range(n):
        system[k, n] /= system[k, k]
    return True


@njit(cache=True, error_model="numpy")
def _newton(t, m, step):  # type: ignore[no-untyped-def]
    """Write Newton's step of (x, y, M11, M12, M22) from normalised sums t[a, b]; return False if singular.

    Unknowns are s and N with shift = M s and growth = M N M, for which the weight changes by the factor
    1 + s.u + u.N.u / 2, so that every derivative is a moment.
    """
    system = np.zeros((5, 6))
    powers = ((1, 0), (0, 1), (2, 0), (1, 1), (0, 2))
    factors = (1.0, 1.0, 0.5, 1.0, 0.5)
    for i in range(5):
        a, b = powers[i]
        for j in range(5):
            c, d = powers[j]
            system[i, j] = factors[j] * (t[a + c, b + d] - t[a, b] * t[c, d])
        system[i, 5] = -t[a, b] + (0.5 * m[i - 2] if i > 1 else 0.0)
    for i, j, value in ((0, 0, m[0]), (0, 1, m[1]), (1, 0, m[1]), (1, 1, m[2])):
        system[i, j] -= value
    for j in range(2):  # the powers are about a centre that moves
        towards_x, towards_y = m[j], m[j + 1]
        system[2, j] -= 2 * t[1, 0] * towards_x
        system[3, j] -= t[1, 0] * towards_y + t[0, 1] * towards_x
        system[4, j] -= 2 * t[0, 1] * towards_y
    for j, (n11, n12, n22) in enumerate(((1.0, 0.0, 0.0), (0.0, 1.0, 0.0), (0.0, 0.0, 1.0))):
        system[2, 2 + j] -= 0.5 * (m[0] * m[0] * n11 + 2 * m[0] * m[1] * n12 + m[1] * m[1] * n22)
        system[3, 2 + j] -= 0.5 * (m[0] * m[1] * n11 + (m[0] * m[2] + m[1] * m[1]) * n12 + m[1] * m[2] * n22)
        system[4, 2 + j] -= 0.5 * (m[1] * m[1] * n11 + 2 * m[1] * m[2] * n12 + m[2] * m[2] * n22)
    if not _solve_in_place(system):
        return False
    s, n = system[:2, 5], system[2:, 5]
    step[0] = m[0] * s[0] + m[1] * s[1]
    step[1] = m[1] * s[0] + m[2] * s[1]
    step[2] = m[0] * m[0] * n[0] + 2 * m[0] * m[1] * n[1] + m[1] * m[1] * n[2]
    step[3] = m[0] * m[1] * n[0] + (m[0] * m[2] + m[1] * m[1]) * n[1] + m[1] * m[2] * n[2]
    step[4] = m[1] * m[1] * n[0] + 2 * m[1] * m[2] * n[1] + m[2] * m[2] * n[2]
    return True


@njit(cache=True, error_model="numpy")
def _adaptive(pixels, guess, found):  # type: ignore[no-untyped-def]
    """Write centre (2) and covariance (3) of the adaptive weight of one stamp, in pixels; return the flag.

    The steps are those of Hirata & Seljak's code, with their bounds, until they are short; then Newton's.
    """
    sums, step, better = np.zeros((5, 5)), np.zeros(5), np.zeros(5)
    limit = 0.5 * min(pixels.shape)
    found[0] = found[1] = 0.0
    found[2], found[3], found[4] = guess * guess, 0.0, guess * guess
    longest = 1.0
    for _ in range(MAX_ITERATIONS):
        m = found[2:]
        _weighted_sums(pixels, found[:2], m, sums)
        if not sums[0, 0] > 0.0:
            return _NO_FLUX
        sums /= sums[0, 0]
        small2 = 0.5 * (m[0] + m[2]) - math.sqrt(0.25 * (m[0] - m[2]) ** 2 + m[1] ** 2)
        if not small2 > COLLAPSED:
            return _NOT_POSITIVE
        for k, (a, b) in enumerate(((1, 0), (0, 1), (2, 0), (1, 1), (0, 2))):
            step[k] = 2 * sums[a, b] if k < 2 else 4 * sums[a, b] - 2 * m[k - 2]
        quick = longest < NEAR and _newton(sums, m, better)
        if quick:  # a fixed point that the plain step shuns is not stable: Hirata & Seljak's code leaves it
            along = (step[0] * better[0] + step[1] * better[1]) * small2 + np.dot(step[2:], better[2:])
            quick = along > 0.0 or longest < 1e-6
        if quick:
            step[:] = better
        longest = 0.0
        for k in range(5):
            unit = math.sqrt(small2) if k < 2 else small2
            step[k] = min(max(step[k], -LONGEST_STEP * unit), LONGEST_STEP * unit)
            longest = max(longest, abs(step[k]) / unit)
            found[k] += step[k]
        if not (found[2] > 0.0 and found[4] > 0.0 and found[2] * found[4] > found[3] ** 2):
            return _NOT_POSITIVE
        if max(abs(found[0]), abs(found[1])) > limit or max(found[2], found[4]) > (2 * limit) ** 2:
            return _NOT_CONVERGED
        if longest < TOLERANCE or (quick and longest < math.sqrt(TOLERANCE) * 1e-2):
            return 0
    return _NOT_CONVERGED


@njit(cache=True, error_model="numpy")
def _gaussian(pixels, sigma, found):  # type: ignore[no-untyped-def]
    """Write centre (2) and moments (3) of one stamp under a fixed round weight, in pixels; return the flag."""
    sums, weight = np.zeros((5, 5)), np.array([sigma * sigma, 0.0, sigma * sigma])
    limit = 0.5 * min(pixels.shape)
    total = pixels.sum()
    if not total > 0.0:
        return _NO_FLUX
    ny, nx = pixels.shape
    x, y = 0.0, 0.0
    for row in range(ny):
        for column in range(nx):
            x += pixels[row, column] * (column - 0.5 * (nx - 1))
            y += pixels[row, column] * (row - 0.5 * (ny - 1))
    found[0], found[1] = x / total, y / total
    for _ in range(MAX_ITERATIONS):
        if not max(abs(found[0]), abs(found[1])) < limit:
            return _NOT_CONVERGED
        _weighted_sums(pixels, found[:2], weight, sums)
        if not sums[0, 0] > 0.0:
            return _NO_FLUX
        sums /= sums[0, 0]
        dx, dy = sums[1, 0], sums[0, 1]
        found[2], found[3], found[4] = sums[2, 0], sums[1, 1], sums[0, 2]
        a, b, d = 1 - found[2] / sigma**2, -found[3] / sigma**2, 1 - found[4] / sigma**2
        det = a * d - b * b
        stable = a + d > 0.0 and det > 0.0
        if max(abs(dx), abs(dy)) < TOLERANCE * sigma:
            return 0 if stable else _NOT_CONVERGED
        found[0] += (d * dx - b * dy) / det if stable else dx
        found[1] += (a * dy - b * dx) / det if stable else dy
    return _NOT_CONVERGED


@njit(cache=True, error_model="numpy")
def _plain(pixels, radius, edge, found):  # type: ignore[no-untyped-def]
    """Write centroid (2) and moments (3) of one stamp within an aperture (0: none), in pixels; return the flag."""
    ny, nx = pixels.shape
    found[0] = found[1] = 0.0
    for _ in range(MAX_ITERATIONS):
        flux = x = y = xx = xy = yy = 0.0
        for row in range(ny):
            v = row - 0.5 * (ny - 1) - found[1]
            for column in range(nx):
                u = column - 0.5 * (nx - 1) - found[0]
                value = pixels[row, column]
                if radius > 0.0:
                    beyond = (math.sqrt(u * u + v * v) - radius) / (math.sqrt(2.0) * edge)
                    if beyond > 6.0:
                        continue
                    if beyond > -6.0:
                        value *= 0.5 * math.erfc(beyond)
                flux += value
                x += value * u
                y += value * v
                xx += value * u * u
                xy += value * u * v
                yy += value * v * v
        if not flux > 0.0:
            return _NO_FLUX
        x, y = x / flux, y / flux
        found[0] += x
        found[1] += y
        found[2], found[3], found[4] = xx / flux - x * x, xy / flux - x * y, yy / flux - y * y
        if radius == 0.0 or max(abs(x), abs(y)) < TOLERANCE * radius:
            return 0
        if max(abs(found[0]), abs(found[1])) > radius:
            return _NOT_CONVERGED
    return _NOT_CONVERGED


@njit(cache=True, error_model="numpy")
def _half_light_guess(pixels):  # type: ignore[no-untyped-def]
    """Sigma of the Gaussian with as many pixels above half its maximum, in pixels; 0 without a maximum."""
    highest = pixels.max()
    count = 0
    for row in range(pixels.shape[0]):
        for column in range(pixels.shape[1]):
            count += pixels[row, column] >= 0.5 * highest
    return math.sqrt(count / (2 * math.pi * math.log(2.0))) if highest > 0.0 else 0.0


@njit(cache=True, parallel=True, error_model="numpy")
def _measure(images, kind, parameters, found, flag):  # type: ignore[no-untyped-def]
    """Measure each stamp: kind 0 plain (radius, edge), 1 fixed weight (sigma), 2 adaptive (guess)."""
    for i in prange(images.shape[0]):
        pixels = images[i]
        if not np.isfinite(pixels.sum()):
            flag[i] = _NOT_FINITE
        elif kind == 0:
            flag[i] = _plain(pixels, parameters[0], parameters[1], found[i])
        elif kind == 1:
            flag[i] = _gaussian(pixels, parameters[0], found[i])
        else:
            guess = parameters[0] if parameters[0] > 0.0 else _half_light_guess(pixels)
            flag[i] = _adaptive(pixels, guess, found[i]) if guess > 0.0 else _NO_FLUX


def measure_stamps(
    images: FloatArray, scale: float, estimator: Estimator, guess_sigma: float | None = None
) -> Stamps:
    r"""Shapes and centroids of many stamps.

    Parameters
    ----------
    images : (n, ny, nx) float array
        Pixels in any unit of flux, rows upwards.
    scale : float
        Side of a pixel, in arcsec.
    estimator : Estimator
        `Plain`, `GaussianWeight` or `Adaptive`.
    guess_sigma : float, optional
        Sigma of the round weight from which `Adaptive` starts, in the middle of the stamp, in arcsec; from
        the area above half the maximum where not given.

    Returns
    -------
    stamps : Stamps
        In the order of the images; the same bits for a stamp alone or among others.

    Raises
    ------
    ValueError
        If the images are not three-dimensional.
    TypeError
        If the estimator is none of the three.

    Notes
    -----
    Sums over pixels, not integrals: on survey pixels the result depends on where the star lies in its
    pixel.  Adaptive moments take the steps of Hirata & Seljak's code, so that they end at its fixed point
    and fail where it fails, until a step is shorter than `NEAR`; then Newton's method with moments of
    order 4 ends in two or three steps at `TOLERANCE`.  A stamp is flagged when its weight leaves the
    stamp, outgrows it or loses its flux.

    References
    ----------
    Hirata2003
    """
    pixels = np.ascontiguousarray(images, dtype=float)
    if pixels.ndim != 3:
        raise ValueError(f"images must have shape (n, ny, nx), got {pixels.shape}")
    kind, parameters = _parameters(estimator, scale, guess_sigma)
    found = np.full((len(pixels), 5), np.nan)
    flag = np.zeros(len(pixels), dtype=np.int64)
    _measure(pixels, kind, parameters, found, flag)
    found[flag != 0] = np.nan
    covariance = found[:, 2:] * scale**2
    return Stamps(shape=Shape.from_covariance(covariance, flag), x=found[:, 0] * scale, y=found[:, 1] * scale)


def _parameters(estimator: Estimator, scale: float, guess_sigma: float | None) -> tuple[int, FloatArray]:
    """Which compiled estimator, and its lengths in pixels."""
    if isinstance(estimator, Plain):
        return 0, np.array([estimator.aperture or 0.0, APERTURE_EDGE]) / scale
    if isinstance(estimator, GaussianWeight):
        return 1, np.array([estimator.sigma / scale])
    if isinstance(estimator, Adaptive):
        return 2, np.array([(guess_sigma or 0.0) / scale])
    raise TypeError(f"estimator must be Plain, GaussianWeight or Adaptive, got {type(estimator).__name__}")
