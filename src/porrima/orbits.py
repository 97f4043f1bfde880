"""From a semi-major axis to the separation on the sky: circular orbits seen from any side."""

from __future__ import annotations

import math
from typing import Literal

import numpy as np
from numba import float32, njit
from numpy.typing import NDArray
from scipy.special import ellipkm1

from porrima.elementary import sine_cosine

FloatArray = NDArray[np.float64]
Projection = Literal["isotropic", "inclination-uniform"]

__all__ = ["Projection", "projection_factor", "projection_nodes"]


@njit(inline="always", fastmath={"contract"})
def projection_factor(isotropic, u, v):  # type: ignore[no-untyped-def]
    """Projected separation over semi-major axis, float32, from one or two uniform numbers in (0, 1) (compiled).

    A companion on a circular isotropic orbit lies anywhere on a sphere: sqrt(1 - mu^2), mu uniform.
    With the inclination i itself uniform in angle: sqrt(1 - sin^2 i sin^2 theta), theta the uniform phase.
    """
    half = float32(0.5)
    product = u if isotropic else sine_cosine(half * u)[0] * sine_cosine(half * v)[0]
    return np.sqrt((float32(1) - product) * (float32(1) + product))


def projection_nodes(
    projection: Projection, kink: FloatArray | None = None, nodes: int = 48
) -> tuple[FloatArray, FloatArray]:
    r"""Nodes and weights of a quadrature over the orientation of circular orbits.

    Parameters
    ----------
    projection : {"isotropic", "inclination-uniform"}
        Distribution of the orientations.
    kink : (n,) float array, optional
        Projected separations over the semi-major axis, in (0, 1], at which the integrands have a kink; each gets
        nodes of its own, on either side of it (dimensionless).
    nodes : int
        On each side (count).

    Returns
    -------
    factor, weight : (n, 2 nodes) float array
        Projected separation over semi-major axis, in (0, 1], and weights of sum 1, dimensionless; (nodes,) arrays
        where there is no kink.

    Notes
    -----
    The factor is :math:`\sqrt{1 - m^2}`.  Isotropic: m is uniform in (0, 1).  Inclination-uniform: m is the product of
    two sines of uniform angles, with the density :math:`(2/\pi)^2 K(\sqrt{1-m^2})` (the complete elliptic integral).
    By :math:`m = \sin(\frac{\pi}{2} s^4)`, which takes its logarithm at m = 0, Gauss-Legendre in s.
    The mean square of the factor is 2/3 and 3/4.
    """
    x, w = np.polynomial.legendre.leggauss(nodes)
    unit, unit_weight = 0.5 * (x + 1), 0.5 * w
    if kink is None:
        s, ds = unit, unit_weight
    else:
        split = (np.arccos(kink) / (0.5 * math.pi))[:, None] ** 0.25
        s = np.concatenate([split * unit, split + (1 - split) * unit], axis=1)
        ds = np.concatenate([split * unit_weight, (1 - split) * unit_weight], axis=1)
    angle = 0.5 * math.pi * s**4
    factor = np.cos(angle)
    weight = 2 * math.pi * s**3 * ds * factor
    if projection == "inclination-uniform":
        weight = weight * (2 / math.pi) ** 2 * ellipkm1(np.maximum(np.sin(angle) ** 2, 1e-300))
    return factor, weight / weight.sum(axis=-1, keepdims=True)
