r"""Averages over triple stars for the closed forms: points of a scrambled Sobol sequence in place of draws.

A triple has a dozen random numbers, and what it adds has no closed form.  The points stand for star, mass ratios, ratio
of the axes, hierarchy and orientations.  Given these the common scale of both orbits is log-normal, and is integrated
exactly, as is the turn of the whole on the sky; the ratio of the axes is taken from what is stable alone.  Scrambled
several times the sequence tells its own error.  The points are always the same: nothing is drawn.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cache, lru_cache
from math import ceil, comb, cos, log, log2, pi, sin
from typing import TYPE_CHECKING, NamedTuple

import numpy as np
from scipy.special import log_ndtr, ndtr, ndtri
from scipy.stats import qmc

from porrima.hierarchy import INNER_AROUND_PRIMARY, STABLE_EXPONENT, STABLE_RATIO, members
from porrima.moments import INDICES, N_MOMENTS, ORDER, moments_of_points
from porrima.photometry import flux_ratio

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from porrima.companions import CompanionLaw
    from porrima.systems import Population

    BoolArray = NDArray[np.bool_]
    FloatArray = NDArray[np.float64]
    IntArray = NDArray[np.int64]

__all__ = ["TripleAverages", "TripleSums", "triple_averages"]

_SCRAMBLES = 8
_POINTS = 12  # log2 of the points of each
_SEED = 20140401
_GROUPS = 64  # of stars of like multiplicity fraction
_SAMPLE = 4096  # triples kept for what is not linear in their moments
_STABILITY = 20  # log2 of the points for the probabilities of stability of all kinds of stars together
_MOST_STABILITY, _LEAST_STABILITY = 13, 7  # log2 of those of one
_HIERARCHY, _OUTER, _INNER, _PHASES, _ANGLE, _TURN, _SCALE = 5, 6, 7, 8, 10, 11, 12
_DIMENSIONS = 13  # after the star's: two classes, ratio of the axes, two mass ratios, and the above
_TURNS = 24  # on the sky, each seen in a mirror too: exact up to order 16
_ORDERS = np.sum(INDICES, axis=1)
_EVEN_SUMS = [(n, m) for n in range(2, ORDER + 1) for m in range(n, ORDER + 1, 2)]


class _Orbits(NamedTuple):
    """Stable hierarchies, one to a point, but for the scale of both orbits: log10 of the outer axis in au is normal."""

    mean: FloatArray  # of log10 of the outer axis
    sd: FloatArray
    longest: FloatArray  # its largest value
    ratio: FloatArray  # log10 of the outer axis over the inner one
    weight: FloatArray  # density of stable hierarchies at the point
    q_outer: FloatArray  # mass over that of the primary: of C in (A,B)-C, of B in A-(B,C)
    q_inner: FloatArray  # likewise, of B in (A,B)-C, of C in A-(B,C)
    share: FloatArray  # of the lighter star in the mass of the inner pair


class _Triples(NamedTuple):
    """Triples, one to a point, with the scale of both orbits integrated over."""

    kernel: FloatArray  # (n, n_moment) of one whose sources reach the cut
    log_scale: FloatArray  # (n, 17) log of the mean of powers 0 to 16 of the scale over that, of those kept
    weight: FloatArray  # (n,) how often each is
    some_scale: FloatArray  # (n,) one scale of those kept, at random


@dataclass(frozen=True, slots=True, kw_only=True)
class TripleSums:
    r"""Sums over the triples among n stars, for k factors on their multiplicity fractions.

    Parameters
    ----------
    number, kept : (k,) float array
        Triples, and those that are not resolved (count).
    lost : (2, k) float array
        Weight in a stack of those that are resolved, and the same of the squares of weights, dimensionless.
    mean : (2, k, n_moment) float array
        Kernel moments of those kept times the weight, or its square, in arcsec^(a+b).
    product : (k, n_moment, n_moment) float array
        Products of two moments times the square of the weight, in arcsec^(a+b+c+d).
    error : (2, k) float array
        Standard errors of the sums of x and of x², by the scrambles, in arcsec² and arcsec⁴.
    kernel : (n, n_moment) float array
        Moments of some of the triples that are kept, in arcsec^(a+b).
    share : (k, n) float array
        How many each of them stands for (count).
    """

    number: FloatArray
    kept: FloatArray
    lost: FloatArray
    mean: FloatArray
    product: FloatArray
    error: FloatArray
    kernel: FloatArray
    share: FloatArray


@dataclass(frozen=True, slots=True, kw_only=True)
class TripleAverages:
    """Sums over the triples of a population by groups of like multiplicity fraction, if each multiple star were one.

    Parameters
    ----------
    fraction : (n_group,) float array
        Multiplicity fraction, in [0, 1].
    columns : (n_group, n_column) float array
        Number; kept; weight and its square lost; mean moments with either weight; products; as `TripleSums` has them.
    errors : (n_scramble, n_group, 2) float array
        x and x² by each scramble, in arcsec² and arcsec⁴.
    kernel : (n, n_moment) float array
        Moments of some triples that are kept, in arcsec^(a+b).
    group : (n,) int array
        Their groups (dimensionless).
    share : (n,) float array
        How many multiple stars each stands for (count).
    """

    fraction: FloatArray
    columns: FloatArray
    errors: FloatArray
    kernel: FloatArray
    group: IntArray
    share: FloatArray

    def sums(self, scale: FloatArray) -> TripleSums:
        """Sums over the triples where all multiplicity fractions are scaled.

        Parameters
        ----------
        scale : (k,) float array
            Factor, dimensionless; fractions stay at most 1.

        Returns
        -------
        sums : TripleSums
            Of k populations, in powers of arcsec.
        """
        multiple = np.minimum(1.0, scale[:, None] * self.fraction)
        total, n = multiple @ self.columns, N_MOMENTS
        each = multiple @ self.errors
        return TripleSums(
            number=total[:, 0],
            kept=total[:, 1],
            lost=total[:, 2:4].T,
            mean=total[:, 4 : 4 + 2 * n].reshape(-1, 2, n).swapaxes(0, 1),
            product=total[:, 4 + 2 * n :].reshape(-1, n, n),
            error=each.std(axis=0, ddof=1).T / np.sqrt(len(each)),
            kernel=self.kernel,
            share=multiple[:, self.group] * self.share,
        )


@lru_cache(maxsize=4)
def triple_averages(population: Population) -> TripleAverages | None:
    """Averages over the triples of a population.

    Parameters
    ----------
    population : Population
        Of n rows; without a selection.

    Returns
    -------
    averages : TripleAverages or None
        In powers of arcsec; None where there are no triples.

    Notes
    -----
    The number of points of a star follows its number in the population.  Their weights, the density of stable
    hierarchies, are divided by the probability that a draw of their star is stable, by another such rule for each kind
    of star.  Resolved is a triple two of whose sources are at or beyond the cut.
    """
    law, number = population.law, population.abundance
    rows = np.flatnonzero(law.is_triple & (number > 0) & (law.multiplicity_fraction > 0))
    if rows.size == 0:
        return None
    rows = rows[np.argsort(law.multiplicity_fraction[rows], kind="stable")]
    start, fraction = _groups(law.multiplicity_fraction[rows], number[rows])
    running, stable = np.cumsum(number[rows]), _stable_share(law)
    columns, samples = [], []
    for scramble in range(_SCRAMBLES):
        point = qmc.Sobol(_DIMENSIONS + 1, rng=_SEED + scramble).random_base2(_POINTS)
        point = point[np.argsort(point[:, 0])]
        place = np.minimum(np.searchsorted(running, point[:, 0] * running[-1]), rows.size - 1)
        triples = _triples(population, rows[place], point[:, 1:], stable)
        triples.weight[:] *= running[-1] / place.size
        group = np.searchsorted(start, place, side="right") - 1
        columns.append(_columns(triples, population.weight[rows[place]], group, fraction.size))
        samples.append(_some(triples, group, point[:, _TURN + 1]))
    kernel, share, group = (np.concatenate(part) for part in zip(*samples, strict=True))
    mean = np.mean(columns, axis=0)
    found = np.bincount(group, share, fraction.size)
    share *= np.divide(mean[:, 1], found, out=np.zeros_like(found), where=found > 0)[group]
    return TripleAverages(
        fraction=fraction,
        columns=_isotropic(_with_lost(mean, number[rows], population.weight[rows], start)),
        errors=np.stack([_sizes(part) for part in columns]),
        kernel=kernel,
        group=group,
        share=share,
    )


def _groups(fraction: FloatArray, number: FloatArray) -> tuple[IntArray, FloatArray]:
    """First of each group of rows of like multiplicity fraction, which ascends, and the mean of that."""
    start = np.flatnonzero(np.diff(fraction, prepend=-1.0))
    if start.size > _GROUPS:
        running = np.cumsum(number)
        start = np.unique(np.searchsorted(running, running[-1] * np.arange(_GROUPS) / _GROUPS))
    return start, np.add.reduceat(fraction * number, start) / np.add.reduceat(number, start)


def _orbits(law: CompanionLaw, row: IntArray, around: BoolArray, u: FloatArray) -> _Orbits:
    """Stable hierarchies of the stars of some rows from five uniform numbers each.

    Both orbits are alike, so that the first is the outer one in half of the draws.
    """
    first, count = (column[row] for column in members(law))
    running = np.cumsum(np.where(law.is_triple, law.share, 0.0))
    before = np.where(first > 0, running[first - 1], 0.0)
    total = running[first + count - 1] - before
    one, two = (
        np.clip(np.searchsorted(running, before + u[:, k] * total, side="right"), first, first + count - 1)
        for k in range(2)
    )
    q_outer, q_inner = _mass_ratios(law, one, u[:, 3]), _mass_ratios(law, two, u[:, 4])
    third = np.where(around, q_outer / (1 + q_inner), 1 / (q_outer * (1 + q_inner)))
    least = np.log10(STABLE_RATIO) + STABLE_EXPONENT * np.log10(1 + third)
    between, wide = law.log_a[one] - law.log_a[two], np.hypot(law.log_a_sigma[one], law.log_a_sigma[two])
    stable = ndtr((between - least) / wide)
    z = -ndtri(np.maximum(u[:, 2], 1e-12) * stable)
    ratio = between + wide * z
    inside = [ndtr((law.log_a_max[k] - law.log_a[k]) / law.log_a_sigma[k]) for k in (one, two)]
    return _Orbits(
        mean=law.log_a[one] + law.log_a_sigma[one] ** 2 / wide * z,
        sd=law.log_a_sigma[one] * law.log_a_sigma[two] / wide,
        longest=np.minimum(law.log_a_max[one], law.log_a_max[two] + ratio),
        ratio=ratio,
        weight=2 * stable / (inside[0] * inside[1]),
        q_outer=q_outer,
        q_inner=np.where(around, q_inner, q_inner * q_outer),
        share=q_inner / (1 + q_inner),
    )


def _mass_ratios(law: CompanionLaw, k: IntArray, u: FloatArray) -> FloatArray:
    """Mass ratios of some classes from uniform numbers."""
    low, high, g = law.mass_ratio_min[k], law.mass_ratio_max[k], law.mass_ratio_exponent[k] + 1
    flat = np.abs(g) < 1e-9
    g = np.where(flat, 1.0, g)
    power = (low**g + u * (high**g - low**g)) ** (1 / g)
    return np.asarray(np.where(flat, low * (high / low) ** u, power))


def _stable_share(law: CompanionLaw) -> FloatArray:
    """Probability that a hierarchy is stable, (m, 2): of A-(B,C) and of (A,B)-C; 0 for classes of pairs."""
    first, count = members(law)
    star = np.unique(first[count > 0])
    each = star[:, None] + np.arange(count.max())
    inside = each < (star + count[star])[:, None]
    each = np.where(inside, each, star[:, None])
    columns = (
        law.share, law.mass_ratio_exponent, law.mass_ratio_min, law.mass_ratio_max, law.log_a_sigma,
        law.log_a_max - law.log_a,
    )  # fmt: skip
    figures = [column[each] for column in columns] + [law.log_a[each] - law.log_a[star][:, None]]
    figures[0] = figures[0] / np.sum(figures[0] * inside, axis=1, keepdims=True)
    figures = [np.where(inside & np.isfinite(figure), figure, 0.0).round(9) for figure in figures]
    _, kind, which = np.unique(
        np.concatenate(figures, axis=1), axis=0, return_index=True, return_inverse=True
    )
    points = min(max(_STABILITY - ceil(log2(kind.size)), _LEAST_STABILITY), _MOST_STABILITY)
    u = qmc.Sobol(5, rng=_SEED).random_base2(points)
    probability = np.empty((kind.size, 2))
    for some in np.array_split(np.arange(kind.size), ceil(kind.size * len(u) / 2**_STABILITY)):
        row, each_u = np.repeat(star[kind[some]], len(u)), np.tile(u, (some.size, 1))
        for around in (False, True):
            found = _orbits(law, row, np.full(row.size, around), each_u)
            weight = found.weight * ndtr((found.longest - found.mean) / found.sd)
            probability[some, int(around)] = weight.reshape(some.size, -1).mean(axis=1)
    out = np.zeros((law.star.size, 2))
    out[count > 0] = probability[which.ravel()][np.searchsorted(star, first[count > 0])]
    return out


def _triples(population: Population, row: IntArray, u: FloatArray, stable: FloatArray) -> _Triples:
    """Triples of the stars of some rows from uniform numbers."""
    around = u[:, _HIERARCHY] < INNER_AROUND_PRIMARY
    orbits = _orbits(population.law, row, around, u)
    flux, x, y = _sources(population, row, around, orbits, u)
    widest = np.max(np.hypot(x - x[:, [1, 2, 0]], y - y[:, [1, 2, 0]]), axis=1)
    at_cut = np.log10(population.cut / widest)
    x, y = ((p - np.sum(flux * p, axis=1, keepdims=True)) * 10.0 ** at_cut[:, None] for p in (x, y))
    power, s = np.arange(2 * ORDER + 1), (orbits.sd * log(10.0))[:, None]
    end = (np.minimum(at_cut, orbits.longest) - orbits.mean) / orbits.sd
    log_scale = power * (orbits.mean - at_cut)[:, None] * log(10.0) + 0.5 * (power * s) ** 2
    some = orbits.mean + orbits.sd * ndtri(np.maximum(u[:, _SCALE] * ndtr(end), 1e-300))
    return _Triples(
        kernel=moments_of_points(flux, x, y),
        log_scale=log_scale + log_ndtr(end[:, None] - power * s),
        weight=orbits.weight / stable[row, around.astype(int)],
        some_scale=10.0 ** (some - at_cut),
    )


def _sources(
    population: Population, row: IntArray, around: BoolArray, orbits: _Orbits, u: FloatArray
) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Flux shares and places of the sources, (n, 3), in arcsec if the outer axis were 1 au.

    The inner pair stands about its centre of mass, the third star at the end of the outer orbit, or A at its start.
    """
    stars, tracks = population.stars, population.tracks
    d_out = _projected(population, u[:, _OUTER], u[:, _PHASES]) / stars.distance[row]
    d_in = _projected(population, u[:, _INNER], u[:, _PHASES + 1]) / stars.distance[row]
    d_in = d_in * 10.0**-orbits.ratio
    angle, nothing = 2 * pi * u[:, _ANGLE], np.zeros(row.size)
    x, y, lighter = d_in * np.cos(angle), d_in * np.sin(angle), orbits.share
    of_inner = np.where(around, nothing, d_out)
    f = flux_ratio(
        replace(tracks, index=tracks.index[row], weight=tracks.weight[row]), stars.mass[row],
        np.stack([orbits.q_outer, orbits.q_inner], axis=1),
    )  # fmt: skip
    primary = np.where(around, 1.0, f[:, 0])  # of the inner pair
    flux = np.stack([primary, f[:, 1], np.where(around, f[:, 0], 1.0)], axis=1)
    place_x = np.stack([of_inner - lighter * x, of_inner + (1 - lighter) * x, d_out - of_inner], axis=1)
    place_y = np.stack([-lighter * y, (1 - lighter) * y, nothing], axis=1)
    return flux / flux.sum(axis=1, keepdims=True), place_x, place_y


def _projected(population: Population, u: FloatArray, v: FloatArray) -> FloatArray:
    """Projected separation over semi-major axis from uniform numbers."""
    mu = u if population.projection == "isotropic" else np.sin(0.5 * pi * u) * np.sin(0.5 * pi * v)
    return np.asarray(np.sqrt(1 - mu**2))


def _columns(triples: _Triples, weight: FloatArray, group: IntArray, n_group: int) -> FloatArray:
    """Sums over the points of each group, as `TripleAverages` has them, with the weights kept for those lost."""
    out = np.zeros((n_group, 4 + 2 * N_MOMENTS + N_MOMENTS**2))
    edge = np.searchsorted(group, np.arange(n_group + 1))
    scale = np.exp(triples.log_scale) * triples.weight[:, None]
    first, second = scale * weight[:, None], scale * weight[:, None] ** 2
    orders = [np.flatnonzero(n == _ORDERS) for n in range(2, ORDER + 1)]
    for k in range(n_group):
        mine = slice(edge[k], edge[k + 1])
        kernel = triples.kernel[mine]
        out[k, 1:4] = scale[mine, 0].sum(), first[mine, 0].sum(), second[mine, 0].sum()
        out[k, 4 : 4 + N_MOMENTS] = np.sum(first[mine][:, _ORDERS] * kernel, axis=0)
        out[k, 4 + N_MOMENTS : 4 + 2 * N_MOMENTS] = np.sum(second[mine][:, _ORDERS] * kernel, axis=0)
        product = out[k, 4 + 2 * N_MOMENTS :].reshape(N_MOMENTS, N_MOMENTS)
        for n, m in _EVEN_SUMS:
            one, two = orders[n - 2], orders[m - 2]
            block = kernel[:, one].T @ (second[mine, n + m, None] * kernel[:, two])
            product[np.ix_(one, two)], product[np.ix_(two, one)] = block, block.T
    return out


def _with_lost(columns: FloatArray, number: FloatArray, weight: FloatArray, start: IntArray) -> FloatArray:
    """The columns with all triples of each group in the first, and weights lost in place of those kept."""
    out = columns.copy()
    out[:, 0] = np.add.reduceat(number, start)
    out[:, 2] = np.add.reduceat(number * weight, start) - columns[:, 2]
    out[:, 3] = np.add.reduceat(number * weight**2, start) - columns[:, 3]
    return out


def _some(triples: _Triples, group: IntArray, u: FloatArray) -> tuple[FloatArray, FloatArray, IntArray]:
    """Some of the triples that are kept, turned at random: their moments, what each counts, and their groups."""
    every = slice(None, None, max(1, u.size * _SCRAMBLES // _SAMPLE))
    turn = (u[every] * 2 * _TURNS).astype(int)
    kernel = triples.kernel[every] * triples.some_scale[every, None] ** _ORDERS
    share = triples.weight[every] * np.exp(triples.log_scale[every, 0])
    return np.einsum("nij,nj->ni", _rotations()[turn], kernel), share, group[every]


def _sizes(columns: FloatArray) -> FloatArray:
    """x and x² of each group, (n_group, 2)."""
    mean = columns[:, 4 : 4 + N_MOMENTS]
    product = columns[:, 4 + 2 * N_MOMENTS :].reshape(-1, N_MOMENTS, N_MOMENTS)
    xx, yy = INDICES.index((2, 0)), INDICES.index((0, 2))
    square = product[:, xx, xx] + 2 * product[:, xx, yy] + product[:, yy, yy]
    return np.stack([mean[:, xx] + mean[:, yy], square], axis=1)


@cache
def _rotations() -> FloatArray:
    """What turns moments by equal steps, without and with a mirror, (2 _TURNS, n_moment, n_moment)."""
    out = np.zeros((_TURNS, N_MOMENTS, N_MOMENTS))
    for turn in range(_TURNS):
        c, s = cos(2 * pi * turn / _TURNS), sin(2 * pi * turn / _TURNS)
        for row, (a, b) in enumerate(INDICES):
            for i in range(a + 1):
                for j in range(b + 1):
                    factor = comb(a, i) * c ** (a - i) * (-s) ** i * comb(b, j) * s ** (b - j) * c**j
                    out[turn, row, INDICES.index((a - i + b - j, i + j))] += factor
    mirror = np.array([(-1.0) ** b for _, b in INDICES])
    return np.concatenate([out, out * mirror])


def _isotropic(columns: FloatArray) -> FloatArray:
    """The columns averaged over the turn on the sky and its mirror image."""
    out, turn = columns.copy(), _rotations()
    for k in (4, 4 + N_MOMENTS):
        out[:, k : k + N_MOMENTS] = columns[:, k : k + N_MOMENTS] @ turn.mean(axis=0).T
    for k, product in enumerate(columns[:, 4 + 2 * N_MOMENTS :].reshape(-1, N_MOMENTS, N_MOMENTS)):
        out[k, 4 + 2 * N_MOMENTS :] = (turn @ product @ turn.swapaxes(1, 2)).mean(axis=0).ravel()
    return out
