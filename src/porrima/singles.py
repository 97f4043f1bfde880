r"""What one star alone adds to the measured shape of a stack, exactly, on the nodes of a quadrature.

Averaged over its orientation, any smooth function of a pair's kernel is a smooth function of :math:`y = f/(1+f)^2`
and r², and its average over the stars follows from their powers up to the eighth.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import cache
from typing import TYPE_CHECKING

import numpy as np

from porrima.moments import INDICES, N_MOMENTS, ORDER, KernelMoments, pair_coefficient

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from porrima.response import Response

    FloatArray = NDArray[np.float64]

__all__ = ["ANGLES", "AddedShape", "added_shapes", "added_to_shape", "node_weights", "pair_moments"]

ANGLES = 24
"""Orientations of a pair: kernels of order 8 turn no faster than eight times, products sixteen times (count)."""


@dataclass(frozen=True, slots=True, kw_only=True)
class AddedShape:
    """What single pairs, one of N stars, add to the shape of a stack, averaged over their orientations.

    Parameters
    ----------
    mean : (n_node, 4) float array
        Change of e1, e2, R² over R0² and ln R², dimensionless.
    product : (n_node, 4, 4) float array
        Mean product of two changes.
    with_moments : (n_node, 4, n_moment) float array
        Mean product of a change and a kernel moment, the latter in arcsec^(a+b).
    n_too_wide : int
        Pairs for which there is no exact shape, taken to second order (count).
    """

    mean: FloatArray
    product: FloatArray
    with_moments: FloatArray
    n_too_wide: int


@cache
def _nodes() -> FloatArray:
    """Chebyshev's extreme points on [0, 1] without 0, (8,): nodes for 4 y and for (r/cut)²."""
    points: FloatArray = np.sin(0.5 * math.pi * np.arange(1, ORDER + 1) / ORDER) ** 2
    return points


@cache
def _from_powers() -> FloatArray:
    """Polynomials (8, 9) that are 1 at one node and 0 at 0 and the others, as factors of powers 0 to 8."""
    inverse: FloatArray = np.linalg.inv(np.vander(np.append(0.0, _nodes()), increasing=True)).T[1:]
    return inverse


def node_weights(powers: FloatArray) -> FloatArray:
    """Weights of the nodes in an average over stars.

    Parameters
    ----------
    powers : (k, 9, 9) float array
        Of the stars, as `averages.PopulationMoments` has them, dimensionless.

    Returns
    -------
    weight : (k, 64) float array
        For functions that vanish without a companion; exact for polynomials of degree 8 in y and in r².
    """
    weight: FloatArray = np.einsum("aj,kjl,bl->kab", _from_powers(), powers, _from_powers(), optimize=True)
    return weight.reshape(powers.shape[0], -1)


def pair_moments(four_y: FloatArray, separation: FloatArray, angle: FloatArray) -> FloatArray:
    """Kernel moments of pairs.

    Parameters
    ----------
    four_y : (n,) float array
        4 f/(1+f)², in [0, 1].
    separation, angle : (n,) float array
        In arcsec, and position angle in rad.

    Returns
    -------
    moments : (n, n_moment) float array
        In the order of `INDICES`, in arcsec^(a+b).
    """
    root = np.sqrt(1.0 - four_y)
    f = (1.0 - root) / (1.0 + root)
    x, y = separation * np.cos(angle), separation * np.sin(angle)
    c = {n: pair_coefficient(f, n) for n in range(2, ORDER + 1)}
    return np.stack([c[a + b] * x**a * y**b for a, b in INDICES], axis=-1)


def added_shapes(response: Response, moments: FloatArray) -> tuple[FloatArray, int]:
    """Changes of shape by given mean kernels, exact where there is an exact solution.

    Parameters
    ----------
    response : Response
        Of the PSF and estimator.
    moments : (n, n_moment) float array
        Mean kernel moments of stacks, in arcsec^(a+b).

    Returns
    -------
    change, n_too_wide : (n, 4) float array, int
        Of e1, e2, R² over R0² and ln R², dimensionless; and how many had to be taken to second order (count).
    """
    shape, zero = response.shapes(KernelMoments(values=moments, n_stars=1)), response.shape0
    change = np.stack([shape.e1 - zero.e1, shape.e2 - zero.e2, shape.r2 - zero.r2], axis=1)
    wide = np.isnan(change[:, 2])
    some = moments[wide]
    change[wide] = some @ response.first.T + 0.5 * np.einsum(
        "ni,qij,nj->nq", some, response.second, some, optimize=True
    )
    relative = change[:, 2:] / float(zero.r2)
    logarithm = np.log1p(np.maximum(relative, -0.5))  # second order may pass 0 where it means nothing
    return np.concatenate([change[:, :2], relative, logarithm], axis=1), int(wide.sum())


def added_to_shape(response: Response, cut: float, n_stars: int) -> AddedShape:
    """What a pair, one of the stars of a stack, adds to its shape, on the nodes of `node_weights`.

    Parameters
    ----------
    response : Response
        Of the PSF and estimator.
    cut : float
        Largest separation, in arcsec.
    n_stars : int
        Stars in the stack, the others single (count).

    Returns
    -------
    added : AddedShape
        On 64 nodes, dimensionless.
    """
    nodes = _nodes()
    four_y, square, angle = (
        part.ravel()
        for part in np.meshgrid(nodes, nodes, 2 * math.pi * (np.arange(ANGLES) + 0.5) / ANGLES, indexing="ij")
    )
    kernel = pair_moments(four_y, cut * np.sqrt(square), angle)
    change, n_too_wide = added_shapes(response, kernel / n_stars)
    change, kernel = change.reshape(-1, ANGLES, change.shape[1]), kernel.reshape(-1, ANGLES, N_MOMENTS)
    return AddedShape(
        mean=change.mean(axis=1),
        product=np.einsum("nta,ntb->nab", change, change) / ANGLES,
        with_moments=np.einsum("nta,nti->nai", change, kernel, optimize=True) / ANGLES,
        n_too_wide=n_too_wide,
    )
