"""One pair, step by step: the compiled scalar functions of the engine, the same on a CPU and on a GPU.

Each function is a physical step in float32 and without branches.  Lengths are in units of the cut over `CUT`, so
that the eighth powers of all of them stay within float32; masses and fluxes are binary logarithms.
"""

from __future__ import annotations

import math
from functools import lru_cache
from typing import TYPE_CHECKING, NamedTuple

import numpy as np
from numba import float32, int32, int64, njit, uint32, uint64
from scipy.special import ndtr

from porrima.elementary import bits, centred, exp2, from_bits, larger, log2, sine_cosine, smaller, unit
from porrima.orbits import projection_factor
from porrima.photometry import STEP, magnitudes
from porrima.streams import PAIR_STAGE, PHASE_STAGE, SINGLE_STAGE, philox, uniform_pair

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from porrima.systems import Population

    FloatArray = NDArray[np.float64]

__all__ = [
    "CUT", "MOST_TRIES", "Tables", "add_moments", "axis_argument", "companion_mass", "direction", "flux_ratio",
    "is_too_many", "light", "phase_word", "place_on_track", "primary", "random_words", "separation", "single_star",
    "tables_of",
]  # fmt: skip

WIDTH = 16
"""Columns of `Tables.star`: a row is one line of a CPU's cache."""

A, SIGMA, TRUNCATION, MASS, Q_SLOPE, Q_START, Q_FLAT, BASE, DIMMING, FRACTION = range(10)
"""Columns of `Tables.star`; two stay free."""

W0, W1, W2, W3 = range(12, WIDTH)
"""Its last columns, the weights of the four tracks of a star."""

CUT = 4096.0
"""The cut in the unit of length: eighth powers of 1e-7 to 1 cut are then normal float32.  Where they are not, a CPU
takes a hundred times as long for a product."""

_WIDEST = 8 * CUT
"""Separation to which resolved pairs are brought: its eighth power, times a weight of 0, is still a number."""

_SMALLEST = -6.0
"""Binary logarithm of the least semi-major axis, 4e-6 of the cut."""

_MAGNITUDE_TO_LOG2 = -0.4 * math.log2(10.0)

MOST_TRIES = 10_000
"""Pairs drawn for each star of a stack before it is given up: all are resolved."""


class Tables(NamedTuple):
    """A population as the compiled loops read it: everything that one pair needs stands in two rows.

    A star has a row for each class of its companions: the mean of log2(a/d), the scatter of log2 a and the cumulative
    probability of the longest axis; log2 of the mass that the mass ratio multiplies (the primary's times the largest
    mass ratio, or the companion's where it is given), and the three numbers of the mass ratio (see `companion_mass`);
    the first row of its group of tracks (as bits), a fourth of log2 of 1 over the primary's flux, the multiplicity
    fraction; the weights of its four tracks.  A track row has log2 of the flux on the four tracks of a group at one
    mass and at the next.
    """

    star: NDArray[np.float32]  # (n, 16)
    track: NDArray[np.float32]  # (n_group * n_grid, 8)
    n_grid: int  # rows of each group, on a uniform grid of log2 mass
    grid_start: np.float32
    grid_per_unit: np.float32
    log_dark: np.float32  # log2 of the mass below which there is no light
    isotropic: bool
    largest_fraction: float
    weight: NDArray[np.float32]  # (n,) of each star in a stack; no rows where all count alike
    abundance: NDArray[
        np.float32
    ]  # (n,) of each row among the stars, over the largest; none where all are alike
    alias: NDArray[np.float32]  # (n, 2) alias table of abundance x multiplicity fraction: see `alias_table`


@lru_cache(maxsize=2)
def tables_of(population: Population) -> Tables:
    """Tables of a population.

    Parameters
    ----------
    population : Population
        Stars, their companions' law and the cut.

    Returns
    -------
    tables : Tables
        In float32.
    """
    law, tracks = population.law, population.tracks
    log2_10 = math.log2(10.0)
    groups, group_number = np.unique(tracks.index, axis=0, return_inverse=True)
    light = tracks.magnitude * _MAGNITUDE_TO_LOG2
    group_rows = [np.concatenate([light[:-1, group], light[1:, group]], axis=1) for group in groups]
    equal, abundance = bool(np.all(population.weight == 1.0)), population.abundance
    alike = bool(np.all(abundance == 1.0))
    return Tables(
        star=_star_rows(population, group_number.ravel() * (light.shape[0] - 1)),
        track=np.ascontiguousarray(np.concatenate(group_rows), dtype=np.float32),
        n_grid=light.shape[0] - 1,
        grid_start=np.float32(tracks.log_mass_min * log2_10),
        grid_per_unit=np.float32(1.0 / (STEP * log2_10)),
        log_dark=np.float32(math.log2(tracks.dark_below) if tracks.dark_below > 0 else -math.inf),
        isotropic=population.projection == "isotropic",
        largest_fraction=float(law.multiplicity_fraction.max()),
        weight=np.empty(0, np.float32) if equal else population.weight.astype(np.float32),
        abundance=np.empty(0, np.float32) if alike else (abundance / abundance.max()).astype(np.float32),
        alias=alias_table(abundance * law.multiplicity_fraction),
    )


def _star_rows(population: Population, base: NDArray[np.int64]) -> NDArray[np.float32]:
    """Rows of the stars, each on one line of a CPU's cache; `base` is the first row of each one's tracks."""
    law, stars, tracks = population.law, population.stars, population.tracks
    given = ~np.isnan(law.mass_ratio)
    g = law.mass_ratio_exponent + 1
    power_law = (np.abs(g) > 1e-9) & ~given
    log2_10 = math.log2(10.0)
    n, q_min = base.size, law.mass_ratio_min / law.mass_ratio_max
    room = np.zeros((n + 1) * WIDTH, np.float32)
    start = -room.ctypes.data % (4 * WIDTH) // 4
    rows = room[start : start + n * WIDTH].reshape(n, WIDTH)
    rows[:, A] = (law.log_a - np.log10(stars.distance)) * log2_10 - math.log2(population.cut / CUT)
    rows[:, SIGMA] = law.log_a_sigma * log2_10
    rows[:, TRUNCATION] = ndtr((law.log_a_max - law.log_a) / law.log_a_sigma)
    rows[:, MASS] = np.log2(stars.mass * np.where(given, law.mass_ratio, law.mass_ratio_max))
    rows[:, Q_SLOPE] = np.divide(1.0, g, out=np.zeros_like(g), where=power_law)
    rows[:, Q_START] = np.where(power_law, q_min ** np.where(power_law, g, 1.0), 1.0)
    rows[:, Q_FLAT] = np.where(power_law | given, 0.0, np.log2(q_min))
    rows[:, BASE] = base.astype(np.int32).view(np.float32)
    rows[:, DIMMING] = -0.25 * _MAGNITUDE_TO_LOG2 * magnitudes(tracks, stars.mass[:, None])[:, 0]
    rows[:, FRACTION] = law.multiplicity_fraction
    rows[:, W0:] = tracks.weight
    return rows


@njit(cache=True)
def alias_table(weight):  # type: ignore[no-untyped-def]
    """Alias table (n, 2) by which a uniform draw follows the weights of n stars (Vose 1991): the probability to stay
    with a star, and the number (as bits) of the star taken otherwise.
    """
    n = weight.size
    stay, alias = weight * (n / weight.sum()), np.arange(n).astype(np.int32)
    small, large = np.empty(n, np.int64), np.empty(n, np.int64)
    n_small, n_large = 0, 0
    for k in range(n):
        if stay[k] < 1.0:
            small[n_small], n_small = k, n_small + 1
        else:
            large[n_large], n_large = k, n_large + 1
    while n_small > 0 and n_large > 0:
        n_small -= 1
        low, high = small[n_small], large[n_large - 1]
        alias[low] = high
        stay[high] -= 1.0 - stay[low]
        if stay[high] < 1.0:
            n_large -= 1
            small[n_small], n_small = high, n_small + 1
    for k in range(n_small):  # full but for rounding
        stay[small[k]] = 1.0
    table = np.empty((n, 2), np.float32)
    for k in range(n):
        table[k, 0], table[k, 1] = min(stay[k], 1.0), from_bits(alias[k])
    return table


_step = njit(inline="always", fastmath={"contract"}, error_model="numpy")


@_step
def random_words(key_low, key_high, stack_low, stack_high, pair):  # type: ignore[no-untyped-def]
    """Four 32-bit words of one pair: one call of the generator is all that it needs."""
    return philox(key_low, key_high, pair, PAIR_STAGE, stack_low, stack_high)


@_step
def phase_word(key_low, key_high, stack_low, stack_high, pair):  # type: ignore[no-untyped-def]
    """A fifth word, for orbits whose projection takes two random numbers."""
    return philox(key_low, key_high, pair, PHASE_STAGE, stack_low, stack_high)[0]


@_step
def primary(word, alias):  # type: ignore[no-untyped-def]
    """Number of a star, drawn in proportion to its multiplicity fraction by the alias table.

    The word times the number of stars: its whole part is the star, its fraction tells whether to stay.
    """
    product = uint64(word) * uint64(alias.shape[0])
    star = product >> uint64(32)
    other = bits(alias[star, 1])  # looked up in any case: no branch
    return int32(star) if unit(uint32(product)) < alias[star, 0] else other


@_step
def is_too_many(mass_word, axis_word, scale, fraction):  # type: ignore[no-untyped-def]
    """Whether a star drawn in proportion to its fraction must go, as scale x fraction is above 1.

    From the 16 bits that mass ratio and semi-major axis leave over.
    """
    spare = ((mass_word & uint32(0xFF)) << uint32(8)) | (axis_word & uint32(0xFF))
    return _unit16(spare) * (float32(scale) * fraction) >= float32(1)


@njit(inline="always")
def single_star(tables, scale, key_low, key_high, stack_low, stack_high, draw):  # type: ignore[no-untyped-def]
    """Number of a single star and the next free draw: any star, kept with its probability of being single."""
    single = -1
    while single < 0:
        words = philox(key_low, key_high, draw, SINGLE_STAGE, stack_low, stack_high)
        draw += 1
        star = int64((uint64(words[0]) * uint64(tables.alias.shape[0])) >> uint64(32))
        is_here = tables.abundance.size == 0 or unit(words[3]) < tables.abundance[star]
        if is_here and uniform_pair(words[1], words[2]) >= scale * tables.star[star, FRACTION]:
            single = star
    return single, draw


@_step
def axis_argument(axis_word, truncation):  # type: ignore[no-untyped-def]
    """Uniform number in (-1, 1) from which the semi-major axis follows, below its truncation."""
    return larger((centred(axis_word) + float32(1)) * truncation - float32(1), float32(-0.9999999))


@_step
def separation(isotropic, log_a, turn_word, phase_word):  # type: ignore[no-untyped-def]
    """Projected separation of an orbit with log2 of its semi-major axis, at most `_WIDEST`."""
    rho = projection_factor(isotropic, _unit16(turn_word >> uint32(16)), unit(phase_word))
    return smaller(exp2(smaller(larger(log_a, float32(_SMALLEST)), float32(60.0))) * rho, float32(_WIDEST))


@_step
def direction(turn_word):  # type: ignore[no-untyped-def]
    """Cosine and sine of a random position angle."""
    s, c = sine_cosine(_unit16(turn_word & uint32(0xFFFF)) - float32(0.5))  # of half the angle
    return c * c - s * s, float32(2) * s * c


@_step
def companion_mass(word, mass, slope, start, flat):  # type: ignore[no-untyped-def]
    """Binary logarithm of the companion's mass, for dN/dq in proportion to q^(g - 1) on [q_min, 1].

    log2 q = log2(q_min^g + u (1 - q_min^g)) / g, or (1 - u) log2 q_min where g = 0: in both, slope x
    log2(start + u (1 - start)) + (1 - u) flat.
    """
    u = unit(word)
    return mass + slope * log2(start + u * (float32(1) - start)) + (float32(1) - u) * flat


@_step
def place_on_track(mass, start, per_unit, n_grid):  # type: ignore[no-untyped-def]
    """Interval of the grid that holds a mass, and the place in it; beyond the end, the last one goes on."""
    place = larger((mass - start) * per_unit, float32(0))
    k = smaller(int32(place), int32(n_grid - 1))
    return k, place - float32(k)


@_step
def light(w0, w1, w2, w3, l0, l1, l2, l3, dimming):  # type: ignore[no-untyped-def]
    """Binary logarithm of the flux over that of the primary, on a star's own mean of four tracks."""
    return (w0 * l0 + dimming) + (w2 * l2 + dimming) + ((w1 * l1 + dimming) + (w3 * l3 + dimming))


@_step
def flux_ratio(left, right, t, is_dark):  # type: ignore[no-untyped-def]
    """Flux of the companion over that of the primary, from `light` at two masses."""
    ratio = smaller(exp2(left + t * (right - left)), float32(1))
    return float32(0) if is_dark else ratio


@_step
def _unit16(word):  # type: ignore[no-untyped-def]
    """Float32 in (0, 1), never either end, from 16 bits."""
    return (float32(int32(word)) + float32(0.5)) * float32(2.0**-16)


@_step
def _add3(sums, row, stride, factor, a, b, c):  # type: ignore[no-untyped-def]
    sums[row] += factor * a
    sums[row + stride] += factor * b
    sums[row + 2 * stride] += factor * c


@_step
def _add4(sums, row, stride, factor, a, b, c, d):  # type: ignore[no-untyped-def]
    sums[row] += factor * a
    sums[row + stride] += factor * b
    sums[row + 2 * stride] += factor * c
    sums[row + 3 * stride] += factor * d


@_step
def _add5(sums, row, stride, factor, a, b, c, d, e):  # type: ignore[no-untyped-def]
    sums[row] += factor * a
    sums[row + stride] += factor * b
    sums[row + 2 * stride] += factor * c
    sums[row + 3 * stride] += factor * d
    sums[row + 4 * stride] += factor * e


@_step
def add_moments(sums, lane, stride, kept, f, a, b):  # type: ignore[no-untyped-def]
    """Add the kernel moments c_n x^a y^b of a pair of weight `kept` to sums[k stride + lane], c_n = phi_1 (-phi_2)^n
    + phi_2 phi_1^n: so c_2 = phi_1 phi_2 and c_(n+1) = (phi_1 - phi_2) c_n + phi_1 phi_2 c_(n-1), of positive terms.

    Written out to order 8: only so does a compiler keep the powers in registers.
    """
    # fmt: off
    primary = float32(1) / (float32(1) + f)
    product, difference = f * primary * primary, (float32(1) - f) * primary
    c, last = kept * product, float32(0)
    m20, m11, m02 = a * a, a * b, b * b
    _add3(sums, 0 * stride + lane, stride, c, m20, m11, m02)
    c, last = difference * c + product * last, c
    m30, m21 = m20 * a, m11 * a
    m12, m03 = m02 * a, m02 * b
    _add4(sums, 3 * stride + lane, stride, c, m30, m21, m12, m03)
    c, last = difference * c + product * last, c
    m40, m31, m22 = m30 * a, m21 * a, m12 * a
    m13, m04 = m03 * a, m03 * b
    _add5(sums, 7 * stride + lane, stride, c, m40, m31, m22, m13, m04)
    c, last = difference * c + product * last, c
    m50, m41, m32 = m40 * a, m31 * a, m22 * a
    m23, m14, m05 = m13 * a, m04 * a, m04 * b
    _add3(sums, 12 * stride + lane, stride, c, m50, m41, m32)
    _add3(sums, 15 * stride + lane, stride, c, m23, m14, m05)
    c, last = difference * c + product * last, c
    m60, m51, m42, m33 = m50 * a, m41 * a, m32 * a, m23 * a
    m24, m15, m06 = m14 * a, m05 * a, m05 * b
    _add4(sums, 18 * stride + lane, stride, c, m60, m51, m42, m33)
    _add3(sums, 22 * stride + lane, stride, c, m24, m15, m06)
    c, last = difference * c + product * last, c
    m70, m61, m52, m43 = m60 * a, m51 * a, m42 * a, m33 * a
    m34, m25, m16, m07 = m24 * a, m15 * a, m06 * a, m06 * b
    _add4(sums, 25 * stride + lane, stride, c, m70, m61, m52, m43)
    _add4(sums, 29 * stride + lane, stride, c, m34, m25, m16, m07)
    c, last = difference * c + product * last, c
    m80, m71, m62, m53, m44 = m70 * a, m61 * a, m52 * a, m43 * a, m34 * a
    m35, m26, m17, m08 = m25 * a, m16 * a, m07 * a, m07 * b
    _add5(sums, 33 * stride + lane, stride, c, m80, m71, m62, m53, m44)
    _add4(sums, 38 * stride + lane, stride, c, m35, m26, m17, m08)
    # fmt: on
