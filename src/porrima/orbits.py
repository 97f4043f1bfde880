"""From a semi-major axis to the separation on the sky: circular orbits seen from any side."""

from __future__ import annotations

import math
from typing import Literal

import numpy as np
from numba import float32, njit
from numpy.typing import NDArray

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
    return math.sqrt((float32(1) - product) * (float32(1) + product))


def projection_nodes(projection: Projection) -> tuple[FloatArray, FloatArray]:
    r"""Nodes and weights of a quadrature over the orientation of circular orbits.

    Parameters
    ----------
    projection : {"isotropic", "inclination-uniform"}
        Distribution of the orientations.

    Returns
    -------
    factor, weight : (n,) float array
        Projected separation over semi-major axis, in (0, 1], and weights of sum 1, dimensionless.

    Notes
    -----
    Isotropic: :math:`\langle g(\sqrt{1-\mu^2}) \rangle = \int_0^{\pi/2} g(\cos t) \cos t\, dt`, Gauss-Legendre.
    Inclination-uniform: :math:`\langle g(\sqrt{1 - \sin^2 i \sin^2\theta}) \rangle`, midpoint rule in both
    angles over a quarter turn, spectrally accurate for such periodic functions.
    The mean square of the factor is 2/3 and 3/4.
    """
    if projection == "isotropic":
        x, w = np.polynomial.legendre.leggauss(128)
        t = 0.25 * math.pi * (x + 1)
        return np.cos(t), 0.25 * math.pi * w * np.cos(t)
    s = np.sin(0.5 * math.pi * (np.arange(24) + 0.5) / 24)
    product = np.outer(s, s)[np.triu_indices(24)]
    double = np.where(np.equal(*np.triu_indices(24)), 1.0, 2.0)
    return np.sqrt(1 - product**2), double / double.sum()
