"""The engine: many stacks of exactly N stars, each reduced to the mean kernel moments of its systems.

No image is drawn.  The number of pairs of a stack is one binomial draw and single stars cost nothing; each
pair draws its primary, mass ratio, orbit and orientation, and adds its moments.  A resolved pair leaves the
sample and another star takes its place.  Every stack has random streams of its own, so its numbers depend
on the seed and its number alone.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import TYPE_CHECKING, Literal, NamedTuple

import numpy as np
from numba import njit, prange
from scipy.special import ndtr

from porrima.moments import N_MOMENTS, ORDER, KernelMoments
from porrima.orbits import projection_factor
from porrima.photometry import magnitude_on_track, magnitudes
from porrima.streams import binomial, inverse_normal, philox, uniform, uniform_pair
from porrima.systems import Systems

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from porrima.systems import Population

    FloatArray = NDArray[np.float64]

__all__ = ["BinaryFraction", "Stacks", "draw_stacks", "draw_systems"]

BinaryFraction = float | Literal["uniform", "model"]
"""A number in [0, 1], ``uniform`` for one in (0, 1) per stack, ``model`` for the multiplicity model's own."""

_FRACTION, _COUNT, _PAIR, _SINGLE = 0, 1, 2, 3  # the stages of a stack, each with a stream of its own
_MAX_SEED = 2**64


@dataclass(frozen=True, slots=True, kw_only=True)
class Stacks:
    """Stacks of equal size and what companions made of them.

    Parameters
    ----------
    binary_fraction : (n_stack,) float array
        Of the population of each stack before resolved pairs leave, in [0, 1].
    moments : KernelMoments
        Mean kernel moments of each stack, in arcsec^(a+b).
    """

    binary_fraction: FloatArray
    moments: KernelMoments


class _Tables(NamedTuple):
    """A population as the compiled loop reads it; stars in ascending order of multiplicity fraction."""

    star: FloatArray  # (n, 12): see `_tables`
    track: NDArray[np.int64]  # (n, 4)
    grid: FloatArray
    log_mass_min: float
    log_dark: float
    cut: float
    isotropic: bool
    equal_weights: bool
    group_fraction: FloatArray  # (g,) the distinct multiplicity fractions
    group_start: NDArray[np.int64]  # (g + 1,) first star of each
    group_sum: FloatArray  # (g + 1,) sum of the fractions of all stars before it


def draw_stacks(
    population: Population,
    *,
    n_stars: int,
    binary_fraction: BinaryFraction,
    seed: int,
    first: int,
    last: int,
) -> Stacks:
    """Kernel moments of the stacks number `first` to `last` - 1 of a run.

    Parameters
    ----------
    population : Population
        Stars, their companions' law and the cut.
    n_stars : int
        Stars in each stack after resolved pairs have left, at least 1 (count).
    binary_fraction : float or {"uniform", "model"}
        In [0, 1], or one uniform draw per stack, or as the multiplicity model gives it.
    seed : int
        Of the run, from 0 to 2^64 - 1.
    first, last : int
        Range of stack numbers; the numbers of a stack do not depend on it.

    Returns
    -------
    stacks : Stacks
        Binary fractions and moments of `last` - `first` stacks.

    Raises
    ------
    ValueError
        If a count, the seed or the binary fraction is out of range.
    """
    fractions = _fractions(population, n_stars, binary_fraction, seed, first, last)
    scale = population.scale(fractions) if binary_fraction != "model" else np.ones(last - first)
    sums = np.zeros((last - first, N_MOMENTS))
    _fill(_tables(population), np.uint64(seed), first, n_stars, fractions, scale, sums)
    return Stacks(binary_fraction=fractions, moments=KernelMoments(values=sums, n_stars=n_stars))


def draw_systems(
    population: Population, *, n_stars: int, binary_fraction: BinaryFraction, seed: int, stack: int
) -> Systems:
    """Systems of one stack: the very ones whose moments `draw_stacks` sums.

    Parameters
    ----------
    population : Population
        Stars, their companions' law and the cut.
    n_stars : int
        Stars in the stack (count).
    binary_fraction : float or {"uniform", "model"}
        As for `draw_stacks`.
    seed, stack : int
        Of the run, and the number of the stack.

    Returns
    -------
    systems : Systems
        The n_stars systems, pairs first.

    Raises
    ------
    ValueError
        As `draw_stacks`.
    """
    fractions = _fractions(population, n_stars, binary_fraction, seed, stack, stack + 1)
    scale = population.scale(fractions) if binary_fraction != "model" else np.ones(1)
    listed = np.zeros((n_stars, 4))
    tables, sums, powers = _tables(population), np.zeros(N_MOMENTS), np.empty(N_MOMENTS)
    _draw_stack(tables, np.uint64(seed), stack, n_stars, fractions[0], scale[0], sums, powers, listed)
    return Systems.from_pairs(*listed.T)


def _fractions(
    population: Population, n_stars: int, binary_fraction: BinaryFraction, seed: int, first: int, last: int
) -> FloatArray:
    """Binary fraction of each stack, the arguments checked on the way."""
    if n_stars < 1:
        raise ValueError(f"n_stars must be at least 1, got {n_stars}")
    if not 0 <= seed < _MAX_SEED:
        raise ValueError(f"seed must be in [0, 2^64), got {seed}")
    if not 0 <= first <= last:
        raise ValueError(f"first must be in [0, last = {last}], got {first}")
    if binary_fraction == "uniform":
        fractions = np.empty(last - first)
        _uniform_fractions(np.uint64(seed), first, fractions)
        return fractions
    if binary_fraction == "model":
        return np.full(last - first, population.law.multiplicity_fraction.mean())
    if not 0 <= float(binary_fraction) <= 1:
        raise ValueError(f"binary_fraction must be in [0, 1], got {binary_fraction}")
    return np.full(last - first, float(binary_fraction))


def _tables(population: Population) -> _Tables:
    law, tracks, stars = population.law, population.tracks, population.stars
    order = np.argsort(law.multiplicity_fraction, kind="stable")
    g = law.mass_ratio_exponent + 1
    star = np.column_stack(
        [
            law.log_a - np.log10(stars.distance),  # au / pc = arcsec
            law.log_a_sigma,
            ndtr((law.log_a_max - law.log_a) / law.log_a_sigma),
            g,
            np.where(np.abs(g) > 1e-9, law.mass_ratio_min**g, law.mass_ratio_min),
            np.log10(stars.mass),
            magnitudes(tracks, stars.mass[:, None])[:, 0],
            tracks.weight,
            population.weight,
        ]
    )
    fraction, start = np.unique(law.multiplicity_fraction[order], return_index=True)
    cumulative = np.concatenate([[0.0], np.cumsum(law.multiplicity_fraction[order])])
    return _Tables(
        star=np.ascontiguousarray(star[order]),
        track=np.ascontiguousarray(tracks.index[order]),
        grid=tracks.magnitude,
        log_mass_min=tracks.log_mass_min,
        log_dark=math.log10(tracks.dark_below) if tracks.dark_below > 0 else -math.inf,
        cut=population.cut,
        isotropic=population.projection == "isotropic",
        equal_weights=bool(np.all(population.weight == 1.0)),
        group_fraction=fraction,
        group_start=np.append(start, order.size),
        group_sum=np.append(cumulative[start], cumulative[-1]),
    )


@njit(inline="always")
def _halves(number):  # type: ignore[no-untyped-def]
    """Low and high 32 bits of a number."""
    return np.uint32(np.uint64(number) & np.uint64(0xFFFFFFFF)), np.uint32(np.uint64(number) >> np.uint64(32))


@njit(cache=True)
def _uniform_fractions(seed, first, fractions):  # type: ignore[no-untyped-def]
    key_low, key_high = _halves(seed)
    for s in range(fractions.size):
        low, high = _halves(first + s)
        words = philox(key_low, key_high, 0, _FRACTION, low, high)
        fractions[s] = uniform_pair(words[0], words[1])


@njit(inline="always")
def _draw_primary(tables, scale, u):  # type: ignore[no-untyped-def]
    """Number of a star drawn in proportion to its probability min(1, scale x fraction) of being a pair."""
    group_fraction, group_start, group_sum = tables.group_fraction, tables.group_start, tables.group_sum
    capped = group_fraction.size  # first group whose stars are all pairs
    while capped > 0 and scale * group_fraction[capped - 1] >= 1.0:
        capped -= 1
    below = scale * group_sum[capped]
    target = u * (below + (group_start[-1] - group_start[capped]))
    if target >= below:
        return min(group_start[capped] + int(target - below), group_start[-1] - 1)
    target /= scale
    group = np.searchsorted(group_sum[: capped + 1], target, side="right") - 1
    inside = int((target - group_sum[group]) / group_fraction[group])
    return min(group_start[group] + inside, group_start[group + 1] - 1)


@njit(inline="always")
def _draw_single(tables, scale, u):  # type: ignore[no-untyped-def]
    """Number of a star drawn in proportion to its probability 1 - min(1, scale x fraction) of being single."""
    group_fraction, group_start, group_sum = tables.group_fraction, tables.group_start, tables.group_sum
    capped = group_fraction.size
    while capped > 0 and scale * group_fraction[capped - 1] >= 1.0:
        capped -= 1
    target = u * (group_start[capped] - scale * group_sum[capped])
    low, high = 0, capped - 1  # the group that holds the target
    while low < high:
        middle = (low + high + 1) // 2
        if group_start[middle] - scale * group_sum[middle] <= target:
            low = middle
        else:
            high = middle - 1
    inside = int((target - group_start[low] + scale * group_sum[low]) / (1.0 - scale * group_fraction[low]))
    return min(group_start[low] + inside, group_start[low + 1] - 1)


@njit(inline="always")
def _log_mass_ratio(g, q_min_power, u):  # type: ignore[no-untyped-def]
    """log10 of a mass ratio with density q^(g-1) on [q_min, 1]; q_min_power is q_min^g (q_min if g is 0)."""
    if abs(g) > 1e-9:
        return math.log10(q_min_power + u * (1.0 - q_min_power)) / g
    return (1.0 - u) * math.log10(q_min_power)


@njit(inline="always")
def _flux_ratio(tables, star, track, log_q):  # type: ignore[no-untyped-def]
    log_mass = star[5] + log_q
    if log_mass < tables.log_dark:
        return 0.0
    companion = magnitude_on_track(
        tables.grid, tables.log_mass_min, log_mass,
        track[0], track[1], track[2], track[3], star[7], star[8], star[9], star[10],
    )  # fmt: skip
    return min(math.exp(-0.4 * math.log(10.0) * (companion - star[6])), 1.0)


@njit(inline="always")
def _add_moments(sums, powers, weight, flux_ratio, dx, dy):  # type: ignore[no-untyped-def]
    """Add the weighted kernel moments of one pair; `powers` is scratch for the products dx^a dy^b."""
    primary = 1.0 / (1.0 + flux_ratio)
    companion = flux_ratio * primary
    near, far = -companion, primary  # c_n = primary (-companion)^n + companion primary^n
    powers[0], powers[1], powers[2] = dx * dx, dx * dy, dy * dy
    first = 0
    for n in range(2, ORDER + 1):
        near *= -companion
        far *= primary
        c = weight * (primary * near + companion * far)
        for k in range(first, first + n + 1):
            sums[k] += c * powers[k]
        following = first + n + 1
        if n < ORDER:
            for k in range(n + 1):
                powers[following + k] = powers[first + k] * dx
            powers[following + n + 1] = powers[following - 1] * dy
        first = following


@njit
def _draw_stack(tables, seed, stack, n_stars, fraction, scale, sums, powers, listed):  # type: ignore[no-untyped-def]
    """Mean moments of one stack in `sums`; its systems (flux ratio, dx, dy, weight) in `listed` where that has rows."""
    key_low, key_high = _halves(seed)
    low, high = _halves(stack)
    left, count_draw, pair_draw, kept, total = n_stars, 0, 0, 0, 0.0
    while left > 0:
        proposed, count_draw = binomial(left, fraction, key_low, key_high, _COUNT, low, high, count_draw)
        left = 0
        for _ in range(proposed):
            a = philox(key_low, key_high, pair_draw, _PAIR, low, high)
            b = philox(key_low, key_high, pair_draw + 1, _PAIR, low, high)
            pair_draw += 2
            number = _draw_primary(tables, scale, uniform_pair(a[0], a[1]))
            star = tables.star[number]
            log_separation = star[0] + star[1] * inverse_normal(star[2] * uniform(a[2]))
            separation = math.exp(math.log(10.0) * log_separation)
            separation *= projection_factor(tables.isotropic, uniform(b[0]), uniform(b[1]))
            if separation >= tables.cut:
                left += 1
                continue
            log_q = _log_mass_ratio(star[3], star[4], uniform(a[3]))
            flux_ratio = _flux_ratio(tables, star, tables.track[number], log_q)
            angle = 2.0 * math.pi * uniform(b[2])
            dx, dy = separation * math.cos(angle), separation * math.sin(angle)
            _add_moments(sums, powers, star[11], flux_ratio, dx, dy)
            total += star[11]
            if listed.shape[0] > 0:
                listed[kept, 0], listed[kept, 1], listed[kept, 2], listed[kept, 3] = (
                    flux_ratio,
                    dx,
                    dy,
                    star[11],
                )
            kept += 1
    first_single = kept
    if tables.equal_weights and listed.shape[0] == 0:  # single stars cost nothing
        total, first_single = float(n_stars), n_stars
    for single in range(first_single, n_stars):
        weight = 1.0
        if not tables.equal_weights:
            words = philox(key_low, key_high, single, _SINGLE, low, high)
            weight = tables.star[_draw_single(tables, scale, uniform_pair(words[0], words[1])), 11]
        total += weight
        if listed.shape[0] > 0:
            listed[single, 3] = weight
    for k in range(sums.size):
        sums[k] /= total


@njit(cache=True, parallel=True)
def _fill(tables, seed, first, n_stars, fractions, scale, sums):  # type: ignore[no-untyped-def]
    for s in prange(fractions.size):
        _draw_stack(
            tables,
            seed,
            first + s,
            n_stars,
            fractions[s],
            scale[s],
            sums[s],
            np.empty(N_MOMENTS),
            np.empty((0, 4)),
        )
