r"""Stars rejected by their own shape: a pair changes the size and the ellipticity that is measured on it alone."""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import lru_cache
from typing import TYPE_CHECKING, Literal, NamedTuple

import numpy as np
from scipy.special import ndtr, ndtri
from scipy.stats import ncx2

from porrima.errors import InputError
from porrima.moments import KernelMoments
from porrima.selection import SHARP, Layer
from porrima.singles import ANGLES, pair_moments

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from porrima.response import Response

    FloatArray = NDArray[np.float64]

__all__ = ["Clip", "ClippedQuantity", "Noise", "OwnShape", "own_shape", "score", "shape_grid"]

ClippedQuantity = Literal["r2", "e"]
"""What is clipped: the relative change of R², or the length of the change of the ellipticity."""

_SURE = 6.0  # normal deviates within which a probability is turned to a score by itself
_LEAST = 0.01  # of the threshold: changes for which their scatter with position angle is of interest
_LARGEST = 0.2  # threshold: sizes are followed up to 0.3
_FAINT = 1e-4  # 4 f/(1+f)² of a companion that changes no size beyond what is followed
_FEW = 4096  # pairs whose shapes are solved at once


@dataclass(frozen=True, slots=True, kw_only=True)
class Noise:
    """Standard deviation of what is measured on one star, against its magnitude.

    Parameters
    ----------
    magnitude : tuple of float
        Ascending, in mag; one alone serves all.
    sigma : tuple of float
        At these, positive, or all 0 for none: of the relative R², or of each component of e (dimensionless).

    Raises
    ------
    ValueError
        If they do not fit each other.

    Notes
    -----
    The logarithm of sigma is linear in magnitude.
    """

    magnitude: tuple[float, ...] = (0.0,)
    sigma: tuple[float, ...] = (0.0,)

    def __post_init__(self) -> None:
        m, s = np.array(self.magnitude), np.array(self.sigma)
        if not m.size or m.size != s.size or np.any(np.diff(m) <= 0) or not np.all(np.isfinite([*m, *s])):
            raise ValueError("noise must have one sigma for each magnitude, ascending")
        if not (np.all(s > 0) or (s.size == 1 and s[0] == 0)):
            raise ValueError(f"noise must be positive, got {s.min()}")

    def at(self, magnitude: FloatArray) -> FloatArray:
        """Standard deviation for stars of some magnitudes.

        Parameters
        ----------
        magnitude : (n,) float array
            In mag.

        Returns
        -------
        sigma : (n,) float array
            Dimensionless.

        Raises
        ------
        InputError
            If one lies outside those that are given.
        """
        m = np.asarray(magnitude, dtype=float)
        if len(self.sigma) == 1:
            return np.full(m.shape, self.sigma[0])
        low, high = self.magnitude[0], self.magnitude[-1]
        if m.size and not (low - 1e-9 <= m.min() and m.max() <= high + 1e-9):
            outside = m.min() if m.min() < low else m.max()
            rule = f"must be given for the magnitudes of all stars, not from {low:g} to {high:g} alone"
            raise InputError(rule, key="selection.noise", value=f"a star of {outside:.4g}")
        return np.asarray(np.exp(np.interp(m, self.magnitude, np.log(self.sigma))))


class OwnShape(NamedTuple):
    """Change of what is measured on pairs alone: mean over position angle and standard deviation, dimensionless."""

    mean: FloatArray
    spread: FloatArray


def own_shape(
    response: Response, quantity: ClippedQuantity, separation: FloatArray, flux_ratio: FloatArray
) -> OwnShape:
    """Change of the shape that is measured on pairs alone.

    Parameters
    ----------
    response : Response
        Of the PSF and estimator.
    quantity : {"r2", "e"}
        Relative change of R², or length of the change of (e1, e2).
    separation, flux_ratio : (n,) float array
        In arcsec, and in [0, 1].

    Returns
    -------
    shape : OwnShape
        (n,) arrays, dimensionless; infinite where R² grows beyond `response.GROWTH_LIMIT`, NaN where pairs are too
        wide for a series in kernel moments.

    Notes
    -----
    Exact for pairs that change a quantity by more than `response.EXACT_THRESHOLD`.
    """
    r, f = np.broadcast_arrays(separation, flux_ratio)
    four_y = 4 * f.ravel() / (1 + f.ravel()) ** 2
    change = np.concatenate(
        [
            _changes(response, quantity, four_y[k : k + _FEW], r.ravel()[k : k + _FEW])
            for k in range(0, max(r.size, 1), _FEW)
        ]
    )
    mean, spread = change.mean(axis=1), change.std(axis=1)
    lost = np.flatnonzero(np.isnan(mean))
    faint = np.full(lost.size, _FAINT)
    grows = lost[np.isfinite(_changes(response, quantity, faint, r.ravel()[lost]).sum(axis=1))]
    mean[grows], spread[grows] = np.inf, 0.0
    return OwnShape(mean.reshape(r.shape), spread.reshape(r.shape))


def _changes(
    response: Response, quantity: ClippedQuantity, four_y: FloatArray, separation: FloatArray
) -> FloatArray:
    """Changes of pairs turned to each of `ANGLES` position angles, (n, n_angle)."""
    angle = 2 * math.pi * (np.arange(ANGLES) + 0.5) / ANGLES
    y, r, turned = np.broadcast_arrays(four_y[:, None], separation[:, None], angle)
    kernel = pair_moments(y.ravel(), r.ravel(), turned.ravel())
    found, zero = response.shapes(KernelMoments(values=kernel, n_stars=1)), response.shape0
    if quantity == "r2":
        return (found.r2 / float(zero.r2) - 1).reshape(-1, ANGLES)
    return np.hypot(found.e1 - zero.e1, found.e2 - zero.e2).reshape(-1, ANGLES)


def shape_grid(
    response: Response, quantity: ClippedQuantity, separation: FloatArray, flux_ratio: FloatArray
) -> OwnShape:
    """Change of the shape of pairs alone on a grid, finite everywhere.

    Parameters
    ----------
    response : Response
        Of the PSF and estimator.
    quantity : {"r2", "e"}
        As for `own_shape`.
    separation : (n_r,) float array
        Ascending, in arcsec.
    flux_ratio : (n_f,) float array
        In [0, 1].

    Returns
    -------
    shape : OwnShape
        (n_f, n_r) arrays, dimensionless; where R² grows beyond what can be followed it goes on with the square of the
        separation.

    Raises
    ------
    InputError
        If the largest separation is too wide for kernel moments.
    """
    return _shape_grid(_Behind(response), quantity, separation.tobytes(), flux_ratio.tobytes())


class _Behind:
    """A response as a key: itself, not its arrays, which many clips of one PSF share."""

    __slots__ = ("response",)

    def __init__(self, response: Response) -> None:
        self.response = response

    def __hash__(self) -> int:
        return id(self.response)

    def __eq__(self, other: object) -> bool:
        return isinstance(other, _Behind) and self.response is other.response


@lru_cache(maxsize=16)
def _shape_grid(behind: _Behind, quantity: ClippedQuantity, r_bytes: bytes, f_bytes: bytes) -> OwnShape:
    """What `shape_grid` keeps."""
    separation, flux_ratio = np.frombuffer(r_bytes), np.frombuffer(f_bytes)
    mean, spread = own_shape(behind.response, quantity, separation[None, :], flux_ratio[:, None])
    if np.isnan(mean).any():
        widest = separation[np.argmax(np.isnan(mean).any(axis=0)) - 1]
        name = behind.response.psf
        rule = f"is too wide to clip stars by their shape behind {name}: at most {widest:.3g} arcsec"
        raise InputError(rule, key="cut", value=f"{separation[-1]:.4g}")
    for k in np.flatnonzero(np.isinf(mean).any(axis=0)):
        beyond, growth = np.isinf(mean[:, k]), (separation[k] / separation[k - 1]) ** 2
        mean[beyond, k], spread[beyond, k] = mean[beyond, k - 1] * growth, spread[beyond, k - 1] * growth
    return OwnShape(mean, spread)


def score(own: OwnShape, quantity: ClippedQuantity, threshold: float, sigma: FloatArray) -> FloatArray:
    r"""Score of being clipped: a star is, where a normal deviate is below it.

    Parameters
    ----------
    own : OwnShape
        (n,) arrays, or more axes, dimensionless.
    quantity : {"r2", "e"}
        What is clipped.
    threshold : float
        Dimensionless, positive.
    sigma : (n,) float array
        Standard deviation of the noise, 0 for none, of the relative R² or of a component of e (dimensionless).

    Returns
    -------
    score : (n,) float array
        Dimensionless, of the shape of both together.

    Notes
    -----
    For the size :math:`(u - t)/\sqrt{\sigma^2 + s^2}` with the mean u over position angle.  What u scatters by with
    position angle, some per cent, is s: its fourth moment alone is not that of a normal law.  The length of an
    ellipticity with noise in both components follows the law of Rice, whose probability is turned to a score.
    """
    u = own.mean
    relative = np.minimum(own.spread / np.maximum(np.abs(u), _LEAST * threshold), 1.0)
    width = np.maximum(relative, SHARP) * threshold
    out: FloatArray = (u - threshold) / np.hypot(sigma, width)
    if quantity == "r2" or not np.any(sigma > 0):
        return out
    s = np.broadcast_to(np.maximum(sigma, 1e-12 * threshold), out.shape)
    length = np.broadcast_to(u, out.shape)
    out = (length + s**2 / (2 * threshold) - threshold) / np.hypot(s, width)
    near = np.abs(out) < _SURE + 2
    probability = ncx2.sf((threshold / s[near]) ** 2, 2, (length[near] / s[near]) ** 2)
    found = ndtri(np.clip(probability, 1e-300, 1 - 1e-16))
    out[near] = np.where(np.abs(found) < _SURE, found * (s / np.hypot(s, width))[near], out[near])
    return out


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Clip:
    """Stars are rejected whose own shape, known PSF and all, is off by more than a threshold.

    Parameters
    ----------
    response : Response
        Of the PSF and estimator.
    threshold : float
        Of the change, dimensionless, in (0, 0.2]: for R² upwards only.
    quantity : {"r2", "e"}
        Change of R² over that of the PSF, or length of the change of (e1, e2).
    noise : Noise
        Of what is measured on one star; none at first.

    Raises
    ------
    ValueError
        If an option is out of range.

    Notes
    -----
    As every selection, averaged over the position angle.  Behind a PSF that is not round, pairs along it and across
    are clipped at separations that differ by less than 1 %; what their turned kernels add to the mean ellipticity is
    left out: (4 ± 2) % of its bias behind ``optical1`` at a threshold of 0.8 %, and (1 ± 2) % behind ``psf1``.
    """

    response: Response
    threshold: float
    quantity: ClippedQuantity = "r2"
    noise: Noise = Noise()

    def __post_init__(self) -> None:
        if not 0 < self.threshold <= _LARGEST:
            raise ValueError(f"clip must be in (0, {_LARGEST}], got {self.threshold}")
        if self.quantity not in ("r2", "e"):
            raise ValueError(f"quantity must be r2 or e, got {self.quantity}")

    def rejected(self, separation: FloatArray, flux_ratio: FloatArray, magnitude: FloatArray) -> FloatArray:
        """Probability to be clipped.

        Parameters
        ----------
        separation, flux_ratio, magnitude : (n,) float array
            In arcsec, dimensionless and mag.

        Returns
        -------
        probability : (n,) float array
            In [0, 1]; NaN where pairs are too wide for kernel moments.
        """
        r, f, m = np.broadcast_arrays(separation, flux_ratio, magnitude)
        own = own_shape(self.response, self.quantity, r.ravel(), f.ravel())
        z = score(own, self.quantity, self.threshold, self.noise.at(m.ravel()))
        return np.asarray(ndtr(z)).reshape(r.shape)

    def layers(
        self, separation: FloatArray, flux_ratio: FloatArray, magnitude: FloatArray
    ) -> tuple[Layer, ...]:
        """The clip on a grid.

        Parameters
        ----------
        separation, flux_ratio, magnitude : (n_r,), (n_f,), (n_m,) float array
            In arcsec, dimensionless and mag.

        Returns
        -------
        layers : tuple of Layer
            One, dimensionless.

        Raises
        ------
        InputError
            If the largest separation is too wide for kernel moments, or the noise of a star is not given.
        """
        own = shape_grid(self.response, self.quantity, separation, flux_ratio)
        some = magnitude if len(self.noise.sigma) > 1 else magnitude[:1]
        sigma = self.noise.at(some)[:, None, None]
        return (Layer(score=score(own, self.quantity, self.threshold, sigma), normal=True),)
