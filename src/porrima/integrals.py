r"""Expectations over the companion of each star, without drawing any: powers of y and of the separation.

An even kernel moment of a pair is a polynomial in :math:`y = c_2 = f/(1+f)^2` times a power of its separation,
and so is every product of moments of even total order.  Mass ratio and separation are independent in the models
at hand, so the expectations :math:`E[y^j]` and :math:`E[r^{2k};\ r < r_{cut}]` say all.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import lru_cache
from typing import TYPE_CHECKING

import numpy as np
from numba import njit, prange
from scipy.interpolate import CubicSpline
from scipy.special import log_ndtr, logsumexp

from porrima.kept import joint_powers, mass_ratio_rule
from porrima.moments import ORDER
from porrima.orbits import projection_nodes
from porrima.photometry import magnitude_on_track
from porrima.screen import screen_of

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator

    from numpy.typing import NDArray

    from porrima.companions import CompanionLaw
    from porrima.orbits import Projection
    from porrima.systems import Population

    FloatArray = NDArray[np.float64]
    IntArray = NDArray[np.int64]

__all__ = [
    "EVEN", "PRODUCTS", "PairIntegrals", "coefficient_polynomial", "integrate", "separation_moments",
    "separations_below", "starts_of_mass_ratios",
]  # fmt: skip

EVEN = tuple(range(2, ORDER + 1, 2))
"""Orders of the moments that do not vanish in the mean."""

PRODUCTS = tuple((n, m) for n in range(2, ORDER + 1) for m in range(n, ORDER + 1) if (n + m) % 2 == 0)
"""Pairs of orders whose products do not vanish in the mean."""

_INTERVALS = 128  # of Simpson's rule over the logarithm of the mass ratio; the coarse rule takes half as many
_STEP = 0.02  # dex of cut times distance over semi-major axis; the coarse rule takes twice as much
_SPAN = 4  # dex to whose multiples a table reaches, so that one serves many magnitudes and cuts
_LEAST = 1e-300  # so that a share which is 0 has a logarithm


@dataclass(frozen=True, slots=True, kw_only=True)
class PairIntegrals:
    r"""Expectations over the companion of each of n stars, given that it has one.

    Parameters
    ----------
    cut : float
        Separation from which a pair is resolved, in arcsec.
    coefficient : (2, n, 9) float array
        :math:`E[(4y)^j]` for j = 0 to 8, dimensionless: by the rule in use, and by one of half its nodes.
    separation : (2, n, 9) float array
        :math:`E[(r/r_{cut})^{2k};\ r < r_{cut}]` for k = 0 to 8, dimensionless, likewise.
    joint : (2, n, 9, 9) float array or None
        :math:`E[(4y)^j (r/r_{cut})^{2k};\ \mathrm{kept}]` of the pairs that a selection keeps; without one it is the
        product of the two others.  Dimensionless.
    single_kept : (n,) float array or None
        Probability that a star, if single, is kept, in [0, 1]; None without a selection.
    """

    cut: float
    coefficient: FloatArray
    separation: FloatArray
    joint: FloatArray | None = None
    single_kept: FloatArray | None = None

    @property
    def unresolved(self) -> FloatArray:
        """Probability that the pair is closer than the cut, (n,), in [0, 1]."""
        probability: FloatArray = self.separation[0, :, 0]
        return probability

    @property
    def kept(self) -> FloatArray:
        """Probability that the pair stays in the sample, (n,), in [0, 1]."""
        return self.unresolved if self.joint is None else self.joint[0, :, 0, 0]

    @property
    def lost(self) -> FloatArray:
        """Probability that the star stays when it is single minus that when it is a pair, (n,)."""
        return (1.0 if self.single_kept is None else self.single_kept) - self.kept

    def power(self, j: int, k: int) -> FloatArray:
        """Expectation of one joint power over the pairs that stay.

        Parameters
        ----------
        j, k : int
            Of 4 y and of the square of the separation over the cut, 0 to 8.

        Returns
        -------
        power : (n,) float array
            Dimensionless.
        """
        if self.joint is not None:
            return self.joint[0, :, j, k]
        return self.coefficient[0, :, j] * self.separation[0, :, k]

    def sums_of_powers(self, weight: FloatArray, group: IntArray, n_groups: int, rule: int) -> FloatArray:
        """Sums of all joint powers over the rows of some groups.

        Parameters
        ----------
        weight : (n,) float array
            Of each row, dimensionless.
        group : (n,) int array
            Number of each row's group, dimensionless.
        n_groups : int
            Groups (count).
        rule : {0, 1}
            The rule in use or the coarser one.

        Returns
        -------
        powers : (n_groups, 9, 9) float array
            Dimensionless.
        """
        out = np.zeros((n_groups, ORDER + 1, ORDER + 1))
        if self.joint is not None:
            _add_joint(weight, group, self.joint[rule], out)
        else:
            _add_products(weight, group, self.coefficient[rule], self.separation[rule], out)
        return out

    @property
    def mean(self) -> FloatArray:
        r""":math:`E[c_n r^n;\ r < r_{cut}]` for the even orders 2 to 8, (n, 4), in arcsec^n."""
        return self._of([(n, coefficient_polynomial(n)) for n in EVEN])

    @property
    def product(self) -> FloatArray:
        r""":math:`E[c_n c_m r^{n+m};\ r < r_{cut}]` for `PRODUCTS`, (n, n_product), in arcsec^(n+m)."""
        return self._of([(n + m, coefficient_polynomial(n, m)) for n, m in PRODUCTS])

    def _of(self, terms: list[tuple[int, FloatArray]]) -> FloatArray:
        """Expectation of some polynomials in 4 y, each times a power of r."""
        joint = self.joint
        if joint is not None:
            return np.stack([(joint[0, :, :, n // 2] @ c) * self.cut**n for n, c in terms], axis=1)
        columns = [(self.coefficient[0] @ c) * self.separation[0, :, n // 2] * self.cut**n for n, c in terms]
        return np.stack(columns, axis=1)


def coefficient_polynomial(n: int, m: int = 0) -> FloatArray:
    r"""Coefficients that make :math:`c_n`, or :math:`c_n c_m`, of powers of 4 y.

    Parameters
    ----------
    n, m : int
        Orders of the moments, 2 to 8 and even in sum; m = 0 for one moment.

    Returns
    -------
    polynomial : (9,) float array
        Factor of :math:`(4y)^j`, j from 0 to 8, dimensionless.

    Notes
    -----
    With the shares p = 1/(1+f) and 1 - p of the flux, y = p (1 - p).  For even n,
    :math:`c_n = y S_{n-1}` with the sums of powers :math:`S_k = S_{k-1} - y S_{k-2}`, :math:`S_0 = 2, S_1 = 1`;
    for odd n, :math:`c_n = y \sqrt{1-4y}\, D_{n-1}` with :math:`D_k = D_{k-1} - y D_{k-2}`,
    :math:`D_0 = 0, D_1 = 1`.  Exact.
    """
    y = np.polynomial.Polynomial([0.0, 1.0])

    def recursion(zero: float, k: int) -> np.polynomial.Polynomial:
        before, now = zero + 0 * y, 1 + 0 * y
        for _ in range(k - 1):
            before, now = now, now - y * before
        return now

    if n % 2 == 0:
        result = y * recursion(2.0, n - 1) * (y * recursion(2.0, m - 1) if m else 1)
    else:
        result = y**2 * (1 - 4 * y) * recursion(0.0, n - 1) * recursion(0.0, m - 1)
    out = np.zeros(ORDER + 1)
    found = np.asarray(result.trim().coef, dtype=float)
    out[: found.size] = found / 4.0 ** np.arange(found.size)
    return out


def integrate(population: Population, intervals: int = _INTERVALS, is_rough: bool = False) -> PairIntegrals:
    r"""Expectations over companions by quadrature: mass ratio by Simpson's rule, orientation by Gauss's.

    Parameters
    ----------
    population : Population
        Stars, their companions' law, the cut and the selection.
    intervals : int
        Of Simpson's rule, a multiple of four (count).
    is_rough : bool
        Whether every other node of a selection will do: then both rules have these, and no error of it is known.

    Returns
    -------
    integrals : PairIntegrals
        One row per star, dimensionless, each by two rules, whose difference is the estimate of the error.

    Notes
    -----
    Simpson's rule has 128 intervals in the logarithm of the mass ratio, along which tracks are piecewise linear.
    The separation is exact for one orientation, see `separation_moments`.  With a selection mass ratio and separation
    are integrated together, see `kept.joint_powers`; the coarser rule has half the nodes of the selection, too.
    """
    screen = screen_of(population)
    joint = None
    if not screen.is_empty:
        start, rules = starts_of_mass_ratios(population.law), (1,) if is_rough else (0, 1)
        found = [
            joint_powers(
                population, screen, rule, intervals // (1 if is_rough else 1 + rule), start,
                separations_below(population, rule),
            )
            for rule in rules
        ]  # fmt: skip
        joint = np.stack([found[0], found[-1]])
    return PairIntegrals(
        cut=population.cut,
        coefficient=coefficient_moments(population, intervals),
        separation=separation_moments(population),
        joint=joint,
        single_kept=None if screen.is_empty else 1.0 - screen.single,
    )


def separations_below(
    population: Population, rule: int, order: int = ORDER
) -> Callable[[IntArray, FloatArray], FloatArray]:
    """Partial moments of the separation of some rows below some fractions of the cut.

    Parameters
    ----------
    population : Population
        Of n rows.
    rule : {0, 1}
        The rule in use or the coarser one.
    order : int
        Of the highest even moment that is wanted, halved, 0 to 8 (count).

    Returns
    -------
    moments : callable
        From the numbers (m,) of rows and fractions (k,) in dex to the even moments (m, k, order + 1) of the
        separation below each fraction, over it (dimensionless).
    """
    law = population.law
    place = np.log10(population.cut * population.stars.distance) - law.log_a
    scatter, beyond = law.log_a_sigma.round(12), (law.log_a_max - law.log_a).round(12)

    def found(some: IntArray, fraction: FloatArray) -> FloatArray:
        out = np.empty((some.size, fraction.size, order + 1))
        for sigma, widest, mine in _kinds(scatter[some], beyond[some]):
            at = (place[some[mine], None] + fraction).ravel()
            log_moments = _log_moments(sigma, widest, population.projection, at, rule, order)
            out[mine] = log_moments.reshape(-1, fraction.size, order + 1)
        return np.asarray(np.exp(out, out=out))

    return found


def coefficient_moments(population: Population, intervals: int = _INTERVALS) -> FloatArray:
    """Expectation of powers of 4 y over the mass ratio of each star.

    Parameters
    ----------
    population : Population
        Of n stars.
    intervals : int
        Of Simpson's rule, a multiple of four (count).

    Returns
    -------
    moments : (2, n, 9) float array
        Powers 0 to 8, dimensionless; by all nodes, and by every other.
    """
    law, tracks = population.law, population.tracks
    columns = law.mass_ratio_min, law.mass_ratio_max, law.mass_ratio_exponent, law.mass_ratio
    start = starts_of_mass_ratios(law)
    moments = np.empty((2, start.size, ORDER + 1))
    _coefficients(
        tracks.magnitude, tracks.log_mass_min, tracks.dark_below, tracks.index[start], tracks.weight[start],
        population.stars.mass[start], *(column[start] for column in columns), intervals, moments,
    )  # fmt: skip
    return (
        moments
        if start.size == law.star.size
        else np.repeat(moments, np.diff(start, append=law.star.size), axis=1)
    )


def starts_of_mass_ratios(law: CompanionLaw) -> NDArray[np.int64]:
    """First of each run of classes that share star and mass ratios, and may differ in their orbits.

    Parameters
    ----------
    law : CompanionLaw
        Of m classes.

    Returns
    -------
    start : (k,) int array
        Numbers of rows, ascending from 0 (dimensionless).
    """
    is_new = np.diff(law.star, prepend=-1) != 0
    for column in (law.mass_ratio_min, law.mass_ratio_max, law.mass_ratio_exponent):
        is_new |= np.diff(column, prepend=np.nan) != 0
    return np.flatnonzero(is_new)


@njit(inline="always")
def _add_powers(weight, flux_ratio, out):  # type: ignore[no-untyped-def]
    """Weight times each power of 4 y, from the first on, added to a row."""
    four_y = 4.0 * flux_ratio / (1.0 + flux_ratio) ** 2
    for j in range(1, out.size):
        weight *= four_y
        out[j] += weight


@njit(cache=True)
def _add_products(weight, group, coefficient, separation, out):  # type: ignore[no-untyped-def]
    """Add the products of both expectations of each row to its group's."""
    for s in range(weight.size):
        total = out[group[s]]
        for j in range(total.shape[0]):
            share = weight[s] * coefficient[s, j]
            for k in range(total.shape[1]):
                total[j, k] += share * separation[s, k]


@njit(cache=True)
def _add_joint(weight, group, joint, out):  # type: ignore[no-untyped-def]
    """Add the joint expectations of each row to its group's."""
    for s in range(weight.size):
        total = out[group[s]]
        for j in range(total.shape[0]):
            for k in range(total.shape[1]):
                total[j, k] += weight[s] * joint[s, j, k]


@njit(cache=True, parallel=True)
def _coefficients(  # type: ignore[no-untyped-def]
    grid, log_mass_min, dark_below, index, weight, mass, q_min, q_max, exponent, given, intervals, out
):
    """E[(4y)^j] of each star by Simpson's rule in ln q, with all nodes and with every other one."""
    to_log, to_exponent = 1.0 / math.log(10.0), -0.4 * math.log(10.0)
    for s in prange(mass.size):
        i, w, log_mass = index[s], weight[s], math.log10(mass[s])
        primary = magnitude_on_track(grid, log_mass_min, log_mass, i, w)
        out[:, s, :] = 0.0
        out[:, s, 0] = 1.0
        g, norm, last, span, nodes = mass_ratio_rule(
            mass[s], dark_below, q_min[s], q_max[s], exponent[s], given[s], intervals
        )
        h = span / intervals
        for k in range(nodes):
            log_q = h * k - span + last
            magnitude = magnitude_on_track(grid, log_mass_min, log_mass + log_q * to_log, i, w)
            f = min(math.exp(to_exponent * (magnitude - primary)), 1.0)
            if nodes == 1:
                _add_powers(1.0, f, out[0, s])
                _add_powers(1.0, f, out[1, s])
                continue
            end = k == 0 or k == intervals
            density = math.exp(g * log_q) / norm * h / 3.0
            _add_powers(density * (1.0 if end else 4.0 if k % 2 else 2.0), f, out[0, s])
            if k % 2 == 0:
                _add_powers(density * 2.0 * (1.0 if end else 4.0 if k % 4 else 2.0), f, out[1, s])


def separation_moments(population: Population, is_rough: bool = False) -> FloatArray:
    r"""Expectation of even powers of the separation below the cut, over the orbits of each star.

    Parameters
    ----------
    population : Population
        Of n stars.
    is_rough : bool
        Whether no error need be known: then both rules are the one in use.

    Returns
    -------
    moments : (2, n, 9) float array
        :math:`E[(r/r_{cut})^{2k};\ r < r_{cut}]`, k = 0 to 8; by the rule in use and by a coarser one.

    Notes
    -----
    For one orientation the projected separation is :math:`\rho a/d`, and the partial moments of a log-normal a
    with :math:`\mu, s` in natural logarithms are
    :math:`E[a^k; a < A] = \exp(k\mu + k^2 s^2/2)\, \Phi((\ln A - \mu)/s - k s)`.  What remains depends on the
    star through :math:`\ln(r_{cut} d/\bar a)` alone: a table of it, for each scatter and truncation, is
    interpolated (cubic, in logarithms).
    """
    out = np.empty((2, len(population.stars), ORDER + 1))
    law = population.law
    place = np.log10(population.cut * population.stars.distance) - law.log_a  # of the cut over mean a, dex
    for sigma, beyond, mine in _kinds(law.log_a_sigma.round(12), (law.log_a_max - law.log_a).round(12)):
        for rule in (0,) if is_rough else (0, 1):
            found = _log_moments(sigma, beyond, population.projection, place[mine], rule)
            out[rule, mine] = np.exp(found)
    if is_rough:
        out[1] = out[0]
    return out


def _kinds(scatter: FloatArray, beyond: FloatArray) -> Iterator[tuple[float, float, IntArray]]:
    """Scatters and truncations that occur together, and the rows that have them."""
    (of_scatter, i), (of_beyond, j) = (np.unique(v, return_inverse=True) for v in (scatter, beyond))
    number = i * of_beyond.size + j
    order = np.argsort(number, kind="stable")
    found, first = np.unique(number[order], return_index=True)
    for kind, mine in zip(found.tolist(), np.split(order, first[1:]), strict=True):
        one, other = divmod(kind, of_beyond.size)
        yield float(of_scatter[one]), float(of_beyond[other]), mine


def _log_moments(
    sigma: float, beyond: float, projection: Projection, place: FloatArray, rule: int, order: int = ORDER
) -> FloatArray:
    """Logarithms of the partial moments (n, order + 1) where cut times distance over mean axis is (n,), in dex."""
    lowest = _SPAN * math.floor(min(place.min(), beyond - _STEP) / _SPAN)
    inside = np.minimum(place, beyond)
    if math.isinf(beyond):
        highest, across = float(_SPAN * math.ceil((place.max() + 1) / _SPAN)), inside
    else:
        highest, across = beyond, np.sqrt(beyond - inside)
    table = _separation_table(sigma, beyond, projection, lowest, highest, rule, order)
    farther = (place - inside)[:, None] * math.log(10)  # where the cut is beyond the widest orbit
    log_moments: FloatArray = table(across) - 2 * np.arange(order + 1) * farther
    return log_moments


@lru_cache(maxsize=256)
def _separation_table(
    sigma: float, beyond: float, projection: Projection, lowest: float, highest: float, rule: int, order: int
) -> CubicSpline:
    """Logarithms of the partial moments against log10 of cut times distance over the mean semi-major axis.

    Where orbits are truncated, against the root of what is left to the widest, which is smooth up to that one.
    """
    step, s, largest = _STEP * (1 + rule), sigma * math.log(10), beyond * math.log(10)
    n = 2 * math.ceil((highest - lowest) / step / 2) + 1
    if math.isinf(beyond):
        node = place = np.linspace(lowest, highest, n)
        rho, weight = projection_nodes(projection, nodes=64 // (1 + rule))
    else:
        node = np.linspace(0.0, math.sqrt(highest - lowest), n)
        place = highest - node**2
        kink = np.minimum(10.0 ** (place - beyond), 1.0)
        rho, weight = projection_nodes(projection, kink, nodes=32 // (1 + rule))
    reach = place[:, None] * math.log(10) - np.log(rho)  # of ln(a / mean a) at the cut
    z = np.minimum(reach, largest) / s
    log_moments = np.empty((place.size, order + 1))
    for k in range(order + 1):
        log_partial = -2 * k * reach + 0.5 * (2 * k * s) ** 2 + log_ndtr(z - 2 * k * s)
        log_moments[:, k] = logsumexp(log_partial, axis=1, b=np.maximum(weight, _LEAST))
    return CubicSpline(node, log_moments - log_ndtr(largest / s))


def separation_share(sigma: float, beyond: float, projection: Projection, place: FloatArray) -> FloatArray:
    """Probability that a pair is seen closer than a separation.

    Parameters
    ----------
    sigma : float
        Scatter of log10 of the semi-major axis, in dex.
    beyond : float
        log10 of the largest semi-major axis over the mean one, in dex; infinite where there is none.
    projection : {"isotropic", "inclination-uniform"}
        Orientation of the orbits.
    place : (n, m) float array
        log10 of the separation times the distance over the mean semi-major axis, in dex.

    Returns
    -------
    probability : (n, m) float array
        In [0, 1].
    """
    return np.exp(_log_moments(sigma, beyond, projection, place.ravel(), 0)[:, 0]).reshape(place.shape)
