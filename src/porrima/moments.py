r"""Moments of the tiny kernels that companions turn stars into: indices, coefficients, the type.

A stack of stars is the PSF convolved with the mean of one kernel per star: its point sources, with
unit total flux, about their flux centroid.  Moments of order 2 to `ORDER` describe it.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cache
from math import gamma, pi
from typing import TYPE_CHECKING

import numpy as np

if TYPE_CHECKING:
    from numpy.typing import NDArray

    FloatArray = NDArray[np.float64]

__all__ = ["INDICES", "N_MOMENTS", "ORDER", "KernelMoments", "angular_mean", "pair_coefficient"]

ORDER = 8
"""Highest order kept: with it the change of shape of one worst pair (r = 0.05 arcsec) is known to 1e-6."""

INDICES = tuple((n - b, b) for n in range(2, ORDER + 1) for b in range(n + 1))
"""Powers (a, b) of x and y of each moment, in the order in which every array of moments keeps them."""

N_MOMENTS = len(INDICES)
"""Number of moments of order 2 to `ORDER`."""


@dataclass(frozen=True, slots=True, kw_only=True)
class KernelMoments:
    r"""Mean kernel moments :math:`m_{ab} = \langle \sum_j \phi_j x_j^a y_j^b \rangle` of stacks.

    Parameters
    ----------
    values : (n_stack, n_moment) float array
        Moment of each stack in the order of `INDICES`, in arcsec^(a+b).
    n_stars : int
        Number of stars in each stack (count).

    Raises
    ------
    ValueError
        If the last axis is not that of `INDICES`.
    """

    values: FloatArray
    n_stars: int

    def __post_init__(self) -> None:
        if self.values.ndim != 2 or self.values.shape[1] != N_MOMENTS:
            raise ValueError(f"values must have shape (n_stack, {N_MOMENTS}), got {self.values.shape}")

    def __len__(self) -> int:
        return int(self.values.shape[0])


def pair_coefficient(flux_ratio: FloatArray, order: int) -> FloatArray:
    r"""Factor between a pair's separation and its kernel moment of one order.

    Parameters
    ----------
    flux_ratio : (n,) float array
        Companion flux over primary flux, in [0, 1].
    order : int
        Order n of the moment.

    Returns
    -------
    c_n : (n,) float array
        Dimensionless.

    Notes
    -----
    .. math:: c_n = \frac{f + (-f)^n}{(1 + f)^{n+1}}

    so that the moment of a pair with offset :math:`(\delta x, \delta y)` about its flux centroid is
    :math:`c_n\, \delta x^a \delta y^b`, a + b = n.  For n = 2 this is KCM16, Eq. 4.  Exact.

    References
    ----------
    KCM16
    """
    primary = 1.0 / (1.0 + flux_ratio)
    companion = flux_ratio * primary
    near, far = (
        primary * -companion,
        companion * primary,
    )  # by products: numpy's powers take ten times as long
    for _ in range(order - 1):
        near, far = near * -companion, far * primary
    return near + far


@cache
def angular_mean(a: int, b: int) -> float:
    r"""Mean over position angle of :math:`\cos^a\theta \sin^b\theta`.

    Parameters
    ----------
    a, b : int
        Powers, 0 or more.

    Returns
    -------
    mean : float
        Dimensionless; 0 unless both powers are even.

    Notes
    -----
    :math:`\Gamma(\frac{a+1}{2}) \Gamma(\frac{b+1}{2}) / [\pi\, \Gamma(\frac{a+b}{2} + 1)]` for even a and b.
    """
    if a % 2 or b % 2:
        return 0.0
    return gamma((a + 1) / 2) * gamma((b + 1) / 2) / (pi * gamma((a + b) / 2 + 1))


def moments_of_points(flux: FloatArray, x: FloatArray, y: FloatArray) -> FloatArray:
    """Kernel moments of systems of point sources.

    Parameters
    ----------
    flux : (n, k) float array
        Share of each source in the flux of its system, in [0, 1], sum 1.
    x, y : (n, k) float array
        Offset of each source from the flux centroid of its system, in arcsec.

    Returns
    -------
    moments : (n, n_moment) float array
        In the order of `INDICES`, in arcsec^(a+b).
    """
    x_powers = [np.ones_like(x)]
    y_powers = [np.ones_like(y)]
    for _ in range(ORDER):
        x_powers.append(x_powers[-1] * x)
        y_powers.append(y_powers[-1] * y)
    return np.stack([np.sum(flux * x_powers[a] * y_powers[b], axis=1) for a, b in INDICES], axis=1)
