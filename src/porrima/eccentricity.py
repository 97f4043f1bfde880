r"""Eccentric orbits: how far from its mean distance a companion is found at a random time.

At a random time on an isotropic orbit the projected separation is :math:`a (1 - e \cos E) \sqrt{1 - \mu^2}` with
:math:`\mu` uniform, since the direction to the companion is isotropic whatever its distance.  An eccentricity thus
only shifts the logarithm of the semi-major axis at random, and a class of companions becomes a few.
"""

from __future__ import annotations

from dataclasses import replace
from functools import lru_cache
from typing import TYPE_CHECKING, Literal

import numpy as np

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from porrima.companions import CompanionLaw

    FloatArray = NDArray[np.float64]

__all__ = [
    "NODES", "Eccentricity", "eccentric", "eccentricity_index", "largest_eccentricity", "log_period", "orbit_nodes",
]  # fmt: skip

Eccentricity = Literal["circular", "uniform", "thermal", "mds17"]
"""Density of the eccentricity: all 0; 1; 2e; or a power of e that depends on the period."""

NODES = 5
"""Classes that a class becomes: Gauss's rule, exact for polynomials of degree 9 in log10 of the distance (count)."""

_FINE = 64  # points in the eccentricity, and in the eccentric anomaly, of the distribution behind the nodes
_PERIOD_STEP = 0.25  # dex, to which periods are rounded so that classes share their nodes
_WIDTH_STEP = 0.02  # dex, likewise for the widths of narrow classes, so that they share tables of separations
_LOG_YEAR = float(np.log10(365.25))


def log_period(log_a: FloatArray, total_mass: FloatArray) -> FloatArray:
    """Period by Kepler's third law.

    Parameters
    ----------
    log_a : (n,) float array
        log10 of the semi-major axis in au.
    total_mass : (n,) float array
        Of both stars, in M_sun.

    Returns
    -------
    log_period : (n,) float array
        log10 of the period in days.
    """
    period: FloatArray = 1.5 * log_a - 0.5 * np.log10(total_mass) + _LOG_YEAR
    return period


def eccentricity_index(period: FloatArray) -> FloatArray:
    r"""Exponent :math:`\eta` of the density of the eccentricity, :math:`p(e) \propto e^\eta`.

    Parameters
    ----------
    period : (n,) float array
        log10 of the period in days.

    Returns
    -------
    index : (n,) float array
        :math:`0.6 - 0.7/(\log P - 0.5)` for primaries below 3 M_sun, its value at 0.7 for shorter periods
        (dimensionless).

    References
    ----------
    MoeDiStefano2017
    """
    return 0.6 - 0.7 / (np.maximum(period, 0.7) - 0.5)


def largest_eccentricity(period: FloatArray) -> FloatArray:
    r"""Eccentricity at which a pair would fill its Roche lobe at periastron.

    Parameters
    ----------
    period : (n,) float array
        log10 of the period in days.

    Returns
    -------
    largest : (n,) float array
        :math:`1 - (P/2\,\mathrm{d})^{-2/3}`, 0 below two days; dimensionless.

    References
    ----------
    MoeDiStefano2017
    """
    return 1.0 - np.minimum((10.0**period / 2.0) ** (-2.0 / 3.0), 1.0)


def _power_law(eccentricity: Eccentricity, period: float) -> tuple[float, float]:
    """Largest eccentricity, and exponent of its density; where that cannot be normalised, all orbits are circles."""
    if eccentricity == "mds17":
        index = float(eccentricity_index(np.array(period)))
        return (float(largest_eccentricity(np.array(period))), index) if index > -1 else (0.0, 0.0)
    return {"circular": (0.0, 0.0), "uniform": (1.0, 0.0), "thermal": (1.0, 1.0)}[eccentricity]


@lru_cache(maxsize=512)
def orbit_nodes(
    eccentricity: Eccentricity, period: float, nodes: int = NODES
) -> tuple[FloatArray, FloatArray]:
    r"""Nodes and weights of a quadrature over where on its orbit a companion is.

    Parameters
    ----------
    eccentricity : {"circular", "uniform", "thermal", "mds17"}
        The law.
    period : float
        log10 of the period in days, of which ``mds17`` makes use.
    nodes : int
        At least 1 (count).

    Returns
    -------
    shift, weight : (nodes,) float array
        log10 of the distance over the semi-major axis, in dex, and weights of sum 1.

    Notes
    -----
    The mean anomaly is uniform, so the eccentric one has the density :math:`(1 - e\cos E)/2\pi`.  Gauss's rule for
    the distribution of :math:`\log_{10}(1 - e\cos E)`, from its recursion of orthogonal polynomials on 64 x 64
    points.

    References
    ----------
    MoeDiStefano2017
    """
    largest, index = _power_law(eccentricity, period)
    middle = (np.arange(_FINE) + 0.5) / _FINE
    e = largest * middle[:, None] ** (1.0 / (index + 1.0))
    distance = 1.0 - e * np.cos(np.pi * middle)
    return _gauss(np.log10(distance).ravel(), (distance / distance.sum()).ravel(), nodes)


def _gauss(value: FloatArray, weight: FloatArray, nodes: int) -> tuple[FloatArray, FloatArray]:
    """Gauss's rule for a discrete distribution; fewer nodes, the rest without weight, where it has no spread."""
    before, now, step = np.zeros_like(value), np.ones_like(value), 0.0
    diagonal, beside = [], []
    for _ in range(nodes):
        diagonal.append(float(weight @ (value * now**2)))
        new = (value - diagonal[-1]) * now - step * before
        step = float(np.sqrt(weight @ new**2))
        if step < 1e-9:
            break
        before, now = now, new / step
        beside.append(step)
    beside = beside[: len(diagonal) - 1]
    matrix = np.diag(diagonal) + np.diag(beside, 1) + np.diag(beside, -1)
    node, vector = np.linalg.eigh(matrix)
    empty = nodes - node.size
    return np.pad(node, (0, empty)), np.pad(vector[0] ** 2, (0, empty))


def eccentric(law: CompanionLaw, mass: FloatArray, eccentricity: Eccentricity) -> CompanionLaw:
    r"""The law of projected orbits: each class of circles becomes one or more of eccentric orbits.

    Parameters
    ----------
    law : CompanionLaw
        Its classes have semi-major axes.
    mass : (n,) float array
        Of the primaries, in M_sun.
    eccentricity : {"circular", "uniform", "thermal", "mds17"}
        Density of the eccentricity; that of ``mds17`` at the mean log a of each class.

    Returns
    -------
    law : CompanionLaw
        Its classes have axes of circles that are seen as far away, in log10 au.

    Notes
    -----
    The only class of a star becomes `NODES`.  Where a star has several classes they are narrow and make up a smooth
    distribution together: each is shifted by the mean of :math:`\log_{10}(1 - e\cos E)` and widened by its variance.

    References
    ----------
    MoeDiStefano2017
    """
    if eccentricity == "circular":
        return law
    period = np.zeros(law.star.size)
    if eccentricity == "mds17":
        period = log_period(law.log_a, 1.5 * mass[law.star])
        period = _PERIOD_STEP * np.round(period / _PERIOD_STEP)
    values, which = np.unique(period, return_inverse=True)
    rules = [orbit_nodes(eccentricity, float(p)) for p in values]
    shift, weight = (np.array([rule[k] for rule in rules])[which] for k in (0, 1))
    alone = np.bincount(law.star)[law.star] == 1
    mean = np.sum(weight * shift, axis=1)
    variance = np.sum(weight * (shift - mean[:, None]) ** 2, axis=1)
    copies = np.where(alone, NODES, 1)
    of = np.repeat(np.arange(law.star.size), copies)
    node = np.arange(of.size) - np.repeat(np.cumsum(copies) - copies, copies)
    moved = np.where(alone[of], shift[of, node], mean[of])
    wider = _WIDTH_STEP * np.round(np.sqrt(law.log_a_sigma**2 + variance) / _WIDTH_STEP)
    sigma = np.where(alone, law.log_a_sigma, wider)
    out = law.take(of)
    return replace(
        out,
        share=out.share * np.where(alone[of], weight[of, node], 1.0),
        log_a=out.log_a + moved,
        log_a_sigma=sigma[of],
        log_a_max=out.log_a_max + moved,
    )
