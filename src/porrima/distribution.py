r"""How the size error of a stack is distributed, not only how wide: quantiles at any number of stars.

A stack's change of size is a sum over its stars, of which most add nothing and few a lot.  Its distribution is the
characteristic function of one star, to the power of their number, turned back by a fast Fourier transform.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
from numba import njit

from porrima.averages import population_moments
from porrima.errors import InputError
from porrima.integrals import integrate, separation_share
from porrima.moments import N_MOMENTS
from porrima.photometry import magnitude_on_track
from porrima.prediction import predict
from porrima.screen import kept_share, screen_of
from porrima.singles import ANGLES, added_shapes, pair_moments
from porrima.triple_averages import triple_averages

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from porrima.integrals import PairIntegrals
    from porrima.prediction import Prediction
    from porrima.response import Response
    from porrima.systems import Population

    FloatArray = NDArray[np.float64]
    IntArray = NDArray[np.int64]

__all__ = ["PairDensity", "SizeDistribution", "pair_density", "size_distribution"]

_MASS_RATIOS = 128  # of each star, at the middles of equal steps in the logarithm
_PLACE_STEP = 0.02  # dex of cut times distance over mean semi-major axis
_Y_CELLS, _Y_DECADES = 200, 5  # cells in log 4 y
_R_CELLS, _R_DECADES = 400, 4  # cells in log r
_DEGREE = 7  # of the polynomials in y and in r² between cells
_LATTICE = 1 << 18  # points of the transform
_FINE = 8  # steps of the lattice about 0 within which it is refined
_TINY = 1e-30
_REACH = 12.0  # standard deviations beyond the mean that the lattice holds


@dataclass(frozen=True, slots=True, kw_only=True)
class PairDensity:
    """Stars of a stack that are pairs, on cells of flux ratio and separation.

    Parameters
    ----------
    four_y : (n,) float array
        4 f/(1+f)² in the middle of the cells, in (0, 1].
    square : (m,) float array
        (r/cut)², in (0, 1].
    share : (n, m) float array
        Share of the stars of the stack in each cell, in [0, 1]; what is left to 1 adds nothing.
    """

    four_y: FloatArray
    square: FloatArray
    share: FloatArray


@dataclass(frozen=True, slots=True, kw_only=True)
class SizeDistribution:
    """Distribution of the relative size error of a stack, (R² - R0²)/R0².

    Parameters
    ----------
    n_stars : int
        Stars in the stack (count).
    value : (n,) float array
        Ascending size errors, dimensionless.
    cumulative : (n,) float array
        Probability of one at most as large, stacks without any companion left aside, in [0, 1].
    none : float
        Probability of no companion that shines, and so of no error, in [0, 1].
    prediction : Prediction
        Mean and covariance of the same stacks.
    """

    n_stars: int
    value: FloatArray
    cumulative: FloatArray
    none: float
    prediction: Prediction

    def probability(self, value: FloatArray) -> FloatArray:
        """Probability of a size error of at most some values.

        Parameters
        ----------
        value : (n,) float array
            (R² - R0²)/R0², dimensionless.

        Returns
        -------
        probability : (n,) float array
            In [0, 1].
        """
        value = np.asarray(value, dtype=float)
        below = np.interp(value, self.value, self.cumulative, left=0.0, right=1.0 - self.none)
        return below + np.where(value >= 0.0, self.none, 0.0)

    def quantile(self, probability: FloatArray) -> FloatArray:
        """Size errors that a stack stays below with some probabilities.

        Parameters
        ----------
        probability : (n,) float array
            In [0, 1].

        Returns
        -------
        quantile : (n,) float array
            (R² - R0²)/R0², dimensionless; 0 as long as stacks without companions make up the probability.

        Raises
        ------
        ValueError
            If a probability lies outside [0, 1].
        """
        wanted = np.asarray(probability, dtype=float)
        if np.any(~((wanted >= 0) & (wanted <= 1))):
            raise ValueError(
                f"probability must be in [0, 1], got {wanted[~((wanted >= 0) & (wanted <= 1))][0]}"
            )
        negative = np.interp(0.0, self.value, self.cumulative)
        below = np.interp(wanted, self.cumulative, self.value)
        above = np.interp(wanted - self.none, self.cumulative, self.value)
        quantile = np.where(wanted < negative, below, np.maximum(above, 0.0))
        return np.where((wanted >= negative) & (wanted <= negative + self.none), 0.0, quantile)


def size_distribution(
    population: Population,
    response: Response,
    n_stars: int,
    binary_fraction: float | None = None,
    integrals: PairIntegrals | None = None,
) -> SizeDistribution:
    r"""Distribution of the relative size error of stacks.

    Parameters
    ----------
    population : Population
        Stars of equal weight, their companions' law, the cut and the selection.
    response : Response
        Of the PSF and estimator.
    n_stars : int
        Stars in a stack, at least 1 (count).
    binary_fraction : float, optional
        Before resolved pairs leave, in [0, 1]; None for the model's own.
    integrals : PairIntegrals, optional
        Of the population, where they are known already.

    Returns
    -------
    distribution : SizeDistribution
        Dimensionless.

    Raises
    ------
    InputError
        If the stars have unequal weights, or the cut is too wide for the PSF.
    ValueError
        If `n_stars` is less than 1.

    Notes
    -----
    With :math:`g = s_1(k/N) + \frac{N-1}{N^2} m^T B k`, what one star adds on top of the mean of the others (see
    `prediction.predict`), the size error is :math:`\sum_j g(k_j)`, whose characteristic function is
    :math:`\varphi(t)^N` with :math:`\varphi(t) = \langle e^{itg} \rangle`; g is scaled, by less than 1 %, so that its
    mean is the predicted bias.  Exact at N = 1 and for plain moments, otherwise but for what the scatter of two
    stars adds together.  Cells of flux ratio and separation are 6 % and 2 % wide.
    """
    integrals = integrate(population) if integrals is None else integrals
    fraction = None if binary_fraction is None else np.array([binary_fraction])
    moments = population_moments(population, integrals, fraction)
    if not moments.equal_weights:
        raise InputError("must be equal for a distribution", key="stack_weight", value="flux")
    prediction = predict(moments, response, n_stars)
    bias = float(prediction.bias[2, 0])
    if math.isnan(bias):
        raise InputError("is too wide for the kernel moments of this PSF", key="cut", value=population.cut)
    density = pair_density(population, integrals, binary_fraction)
    push = moments.mean[0] @ response.second[2] / float(response.shape0.r2) * (n_stars - 1) / n_stars**2
    added = _added_sizes(density, response, population.cut, n_stars, push)
    share = np.broadcast_to(density.share / added.shape[0], added.shape).ravel()
    added = added.ravel()
    if moments.triples is not None:
        shines = np.any(moments.triples.kernel != 0, axis=1)
        kernel = moments.triples.kernel[shines]
        alone = added_shapes(response, kernel / n_stars)[0][:, 2] + kernel @ push
        added, share = np.append(added, alone), np.append(share, moments.triples.share[0, shines])
    mean = n_stars * np.sum(share * added)
    if mean != 0:
        added = added * (bias / mean)
    none = (1.0 - share.sum()) ** n_stars
    value, cumulative = _sum_of_stars(added, share, n_stars)
    return SizeDistribution(
        n_stars=n_stars, value=value, cumulative=cumulative, none=none, prediction=prediction
    )


def pair_density(
    population: Population, integrals: PairIntegrals, binary_fraction: float | None = None
) -> PairDensity:
    """Stars of a stack that are pairs, by flux ratio and separation.

    Parameters
    ----------
    population : Population
        The n stars.
    integrals : PairIntegrals
        Of the same stars.
    binary_fraction : float, optional
        Before resolved pairs leave, in [0, 1]; None for the model's own.

    Returns
    -------
    density : PairDensity
        Dimensionless.
    """
    law, screen = population.law, screen_of(population)
    scale = population.scale(None if binary_fraction is None else np.array([binary_fraction]))[0]
    pair, number = np.minimum(1.0, scale * law.multiplicity_fraction), population.abundance
    alone = 1.0 if integrals.single_kept is None else integrals.single_kept
    kept = np.sum(number * (alone - pair * integrals.lost * ~law.is_triple))
    averages = triple_averages(population)
    if averages is not None:
        triples = averages.sums(np.array([scale]))
        kept -= triples.number[0] - triples.kept[0]
    pair = np.where(law.is_triple, 0.0, number * pair / kept)
    place = np.log10(population.cut * population.stars.distance) - law.log_a
    kinds, which = np.unique(
        np.stack([law.log_a_sigma, law.log_a_max - law.log_a], axis=1).round(12), axis=0, return_inverse=True
    )
    first = math.floor(place.min())
    n_place = 2 + math.ceil((place.max() - first) / _PLACE_STEP)
    edge = np.linspace(-_R_DECADES, 0.0, _R_CELLS + 1)
    at, inside = first + _PLACE_STEP * np.arange(n_place), []
    for sigma, beyond in kinds:
        below = separation_share(float(sigma), float(beyond), population.projection, at[:, None] + edge)
        below[:, 0] = 0.0
        inside.append(np.diff(below, axis=1))
    middle = 10.0 ** (_Y_DECADES * ((np.arange(_Y_CELLS) + 0.5) / _Y_CELLS - 1))
    square, total = 10.0 ** (edge[1:] + edge[:-1]), np.zeros((2, _Y_CELLS))
    share = np.zeros((_Y_CELLS, _R_CELLS))
    for node in range(1 if screen.is_empty else screen.score.shape[1]):
        some = np.arange(pair.size) if screen.is_empty else np.flatnonzero(screen.slice == node)
        count = np.zeros((len(kinds), n_place, _Y_CELLS))
        _count_rows(population, some, which.ravel(), (place - first) / _PLACE_STEP, pair, count, total)
        here = np.zeros_like(share)
        for stars, cells in zip(count, inside, strict=True):
            here += stars.T @ cells
        share += here if screen.is_empty else here * kept_share(screen, node, middle, square)
    four_y = np.divide(total[1], total[0], out=middle, where=total[0] > 0)
    return PairDensity(four_y=four_y, square=square, share=share)


def _count_rows(
    population: Population,
    some: IntArray,
    kind: IntArray,
    place: FloatArray,
    pair: FloatArray,
    count: FloatArray,
    total: FloatArray,
) -> None:
    """Count the pairs of some rows of a population, see `_count_pairs`."""
    law, tracks = population.law, population.tracks
    columns = (
        tracks.index, tracks.weight, population.stars.mass, law.mass_ratio_min, law.mass_ratio_max,
        law.mass_ratio_exponent, law.mass_ratio, kind, place, pair,
    )  # fmt: skip
    mine = [column[some] for column in columns]
    _count_pairs(tracks.magnitude, tracks.log_mass_min, tracks.dark_below, *mine, count, total)


@njit(cache=True)
def _count_pairs(  # type: ignore[no-untyped-def]
    grid,
    log_mass_min,
    dark_below,
    index,
    weight,
    mass,
    q_min,
    q_max,
    exponent,
    given,
    kind,
    place,
    pair,
    count,
    total,
):
    """Pairs that shine by kind of orbit, place of the cut and 4 y; and the sums of 1 and of 4 y in each cell."""
    to_log, to_exponent = 1.0 / math.log(10.0), -0.4 * math.log(10.0)
    for s in range(mass.size):
        i, w, log_mass = index[s], weight[s], math.log10(mass[s])
        primary = magnitude_on_track(grid, log_mass_min, log_mass, i, w)
        g = exponent[s] + 1.0
        first = min(max(dark_below / mass[s], q_min[s]), q_max[s])
        norm = (q_max[s] ** g - q_min[s] ** g) / g if abs(g) > 1e-9 else math.log(q_max[s] / q_min[s])
        last = math.log(q_max[s])
        span = last - math.log(first)
        one = not math.isnan(given[s])
        if one and given[s] * mass[s] < dark_below:
            continue
        steps = 1 if one else _MASS_RATIOS
        low = int(place[s])
        upper = place[s] - low
        for k in range(steps):
            log_q = math.log(given[s]) if one else last - span * (1.0 - (k + 0.5) / steps)
            share = pair[s] if one else pair[s] * math.exp(g * log_q) / norm * span / steps
            magnitude = magnitude_on_track(grid, log_mass_min, log_mass + log_q * to_log, i, w)
            f = min(math.exp(to_exponent * (magnitude - primary)), 1.0)
            four_y = 4.0 * f / (1.0 + f) ** 2
            cell = int(count.shape[2] * (1.0 + math.log10(max(four_y, 1e-300)) / _Y_DECADES))
            cell = min(max(cell, 0), count.shape[2] - 1)
            count[kind[s], low, cell] += share * (1.0 - upper)
            count[kind[s], low + 1, cell] += share * upper
            total[0, cell] += share
            total[1, cell] += share * four_y


def _added_sizes(
    density: PairDensity, response: Response, cut: float, n_stars: int, push: FloatArray
) -> FloatArray:
    """What a pair in each cell adds to the relative size of a stack, (n_angle, n, m).

    The mean of a pair and of the same one turned by half a turn is y r² times a polynomial in y and in r², half
    their difference y r³ times the root of 1 - 4 y and another.
    """
    node = 0.5 * (1.0 - np.cos(math.pi * (np.arange(_DEGREE + 1) + 0.5) / (_DEGREE + 1)))
    angle = 2.0 * math.pi * (np.arange(ANGLES) + 0.5) / ANGLES
    turned, four_y, square = (part.ravel() for part in np.meshgrid(angle, node, node, indexing="ij"))
    kernel = pair_moments(four_y, cut * np.sqrt(square), turned)
    change, _ = added_shapes(response, kernel.reshape(-1, N_MOMENTS) / n_stars)
    size = (change[:, 2] + kernel @ push).reshape(2, ANGLES // 2, node.size, node.size)
    even, odd = 0.5 * (size[0] + size[1]), 0.5 * (size[0] - size[1])
    root = np.sqrt(node)
    even = even / np.multiply.outer(node, node)
    odd = odd / np.multiply.outer(node * np.sqrt(1.0 - node), node * root)
    z, v = density.four_y, density.square
    in_y, in_r = _interpolation(node, z), _interpolation(node, v)
    even = (in_y @ even @ in_r.T) * np.multiply.outer(z, v)
    odd = (in_y @ odd @ in_r.T) * np.multiply.outer(z * np.sqrt(np.maximum(1.0 - z, 0.0)), v**1.5)
    return np.concatenate([even + odd, even - odd])


def _interpolation(node: FloatArray, at: FloatArray) -> FloatArray:
    """Matrix from values at nodes to those of their polynomial elsewhere, (n, n_node)."""
    powers = np.vander(node, increasing=True)
    return np.asarray(np.linalg.solve(powers.T, np.vander(at, node.size, increasing=True).T).T, dtype=float)


def _sum_of_stars(added: FloatArray, share: FloatArray, n_stars: int) -> tuple[FloatArray, FloatArray]:
    """Values of the sum over stars and the probability of less, sums of nothing left aside.

    Sums with one pair alone are as finely known as the pairs themselves, also next to 0; those with more come from
    the lattice.
    """
    alone = 1.0 - share.sum()
    mean, square = n_stars * np.sum(share * added), n_stars * np.sum(share * added**2)
    spread = _REACH * math.sqrt(square)
    low = min(0.0, mean - spread, 2 * added.min()) if added.min() < 0 else 0.0
    step = max(mean + spread + 2 * max(added.max(), 0.0) - low, _TINY) / (_LATTICE - 1)
    first = round(low / step)
    small = np.geomspace(1e-6, _FINE, 50 * _FINE) * step
    value = (first + np.arange(_LATTICE) + 0.5) * step
    value = np.concatenate(
        [value[value < -_FINE * step], -small[::-1], [0.0], small, value[value > _FINE * step]]
    )
    one = np.bincount(np.searchsorted(value, added), weights=share, minlength=value.size)[: value.size]
    cumulative = n_stars * alone ** (n_stars - 1) * np.cumsum(one)
    if n_stars > 1:
        more = np.cumsum(np.roll(_pairs_on_lattice(added / step, share, n_stars), -first))
        edge = (first + np.arange(-1, _LATTICE) + 0.5) * step
        edge[edge == -0.5 * step] = 0.0 if first == 0 else -0.5 * step
        cumulative += np.interp(value, edge, np.append(0.0, more))
    return value, np.maximum.accumulate(cumulative)


def _pairs_on_lattice(place: FloatArray, share: FloatArray, n_stars: int) -> FloatArray:
    """Probability of each sum over stars with two pairs or more, in steps of a lattice that closes on itself."""
    alone = 1.0 - share.sum()
    below = np.floor(place).astype(np.int64)
    pair = np.bincount(below % _LATTICE, weights=share * (below + 1 - place), minlength=_LATTICE)
    pair += np.bincount((below + 1) % _LATTICE, weights=share * (place - below), minlength=_LATTICE)
    turned = np.fft.rfft(pair)
    many = (alone + turned) ** n_stars - alone**n_stars - n_stars * alone ** (n_stars - 1) * turned
    return np.maximum(np.fft.irfft(many, _LATTICE), 0.0)
