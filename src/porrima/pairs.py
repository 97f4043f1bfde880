"""Pairs drawn sixteen at a time: the compiled inside of the engine.

Each physical step is a loop over the lanes of a block, in float32 and without branches, which the compiler turns
into vector instructions.  Lengths are in units of the cut, so that powers of them stay within float32; masses
and fluxes are binary logarithms.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, NamedTuple

import numpy as np
from numba import float32, int32, njit, uint32, uint64

from porrima.elementary import centred, exp2, log2, normal, sine_cosine, unit
from porrima.moments import N_MOMENTS
from porrima.orbits import projection_factor
from porrima.streams import philox

if TYPE_CHECKING:
    from numpy.typing import NDArray

__all__ = [
    "FLUX_RATIO", "FRACTION", "KEPT", "LANES", "SEPARATION", "STAR_COLUMNS", "VALID", "WEIGHT", "Scratch", "Tables",
    "X", "Y", "alias_table", "draw_block", "flush", "scratch", "sum_block",
]  # fmt: skip

LANES = 16
"""Pairs in a block."""

STAR_COLUMNS = 15
"""Columns of the table of stars: see `Tables`."""

# rows of `Scratch.star`: the columns of `Tables.star`
_A, _A_SIGMA, _TRUNCATION = 0, LANES, 2 * LANES
_Q_SLOPE, _Q_START, _Q_FLAT = 3 * LANES, 4 * LANES, 5 * LANES
_MASS, _FLUX = 6 * LANES, 7 * LANES
_W0, _W1, _W2, _W3, _TRACK = 8 * LANES, 9 * LANES, 10 * LANES, 11 * LANES, 12 * LANES
WEIGHT = 13 * LANES
"""Row of `Scratch.star`: weight of the star in the stack."""

FRACTION = 14 * LANES
"""Row of `Scratch.star`: its multiplicity fraction."""

X, Y = 0, LANES
"""Rows of `Scratch.pair`: companion from primary, over the cut."""

SEPARATION, FLUX_RATIO = 2 * LANES, 3 * LANES
"""Rows of `Scratch.pair`: length of that; flux of the companion over that of the primary."""

KEPT = 4 * LANES
"""Row of `Scratch.pair`: weight in the stack, 0 where the pair is resolved or not wanted."""

VALID = 5 * LANES
"""Row of `Scratch.pair`: 1, or 0 where the star was drawn beyond what min(1, scale x fraction) allows."""

_SMALLEST = -14.0
"""Binary logarithm of the least separation over the cut: its eighth power is still a normal float32."""


class Tables(NamedTuple):
    """A population as the compiled loops read it.

    The columns of `star`: mean and scatter of log2(a/d over the cut), cumulative probability of the longest
    axis, the three numbers of the mass ratio (see `_companion_masses`), log2 of the mass that it multiplies (the
    primary's, or the companion's where it is given) and of the flux of the primary,
    four weights of its tracks, the first of these, its weight in the stack, its multiplicity fraction.
    """

    star: NDArray[np.float32]  # (n, 15)
    grid: NDArray[np.float32]  # (n_grid, n_track) log2 of flux on a uniform grid of log2 mass
    grid_start: np.float32
    grid_step: np.float32
    track_offset: NDArray[np.int32]  # (4,) of a star's tracks from its first
    log_dark: np.float32  # log2 of the mass below which there is no light
    isotropic: bool
    equal_weights: bool
    stay: NDArray[np.float32]  # (n,) alias table of the multiplicity fractions: probability to stay,
    alias: NDArray[np.int32]  # (n,) and the star taken otherwise


class Scratch(NamedTuple):
    """One block of pairs, and the sums over blocks that wait to be flushed.

    Flat arrays, one row of `LANES` after the other: with distances that it knows, the compiler vectorises.
    """

    word: NDArray[np.uint32]  # 8 rows of random words
    number: NDArray[np.int32]  # 1 row: the star
    star: NDArray[np.float32]  # rows: columns of `Tables.star`
    pair: NDArray[np.float32]  # 6 rows: see `X` to `VALID`
    sums: NDArray[np.float32]  # rows: moments


@njit
def scratch():  # type: ignore[no-untyped-def]
    """Room for one block."""
    return Scratch(
        np.empty(8 * LANES, np.uint32),
        np.empty(LANES, np.int32),
        np.empty(STAR_COLUMNS * LANES, np.float32),
        np.zeros(6 * LANES, np.float32),
        np.zeros(N_MOMENTS * LANES, np.float32),
    )


@njit
def alias_table(weight):  # type: ignore[no-untyped-def]
    """Probability to stay and the alias of each of n stars: a uniform draw then follows their weights (Vose 1991)."""
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
    return np.minimum(stay, 1.0).astype(np.float32), alias


@njit
def draw_block(tables, block, scale, key_low, key_high, stage, low, high, first):  # type: ignore[no-untyped-def]
    """Draw the pairs of one block, none of them kept yet; `first` is the number of the first in its stream."""
    word, star = block.word, block.star
    for lane in range(LANES):
        draw = uint32(2) * uint32(first + lane)
        a, b, c, d = philox(key_low, key_high, draw, stage, low, high)
        word[lane], word[LANES + lane], word[2 * LANES + lane], word[3 * LANES + lane] = a, b, c, d
    for lane in range(LANES):
        draw = uint32(2) * uint32(first + lane) + uint32(1)
        a, b, c, d = philox(key_low, key_high, draw, stage, low, high)
        word[4 * LANES + lane], word[5 * LANES + lane], word[6 * LANES + lane], word[7 * LANES + lane] = (
            a,
            b,
            c,
            d,
        )
    _primaries(tables.stay, tables.alias, word, block.number)
    for column in range(STAR_COLUMNS):
        for lane in range(LANES):
            star[column * LANES + lane] = tables.star[block.number[lane], column]
    for lane in range(
        LANES
    ):  # drawn in proportion to the fraction; where scaled it passes 1, some are too many
        excess = unit(word[7 * LANES + lane]) * (float32(scale) * star[FRACTION + lane])
        block.pair[VALID + lane] = float32(1) if excess < float32(1) else float32(0)
        block.pair[KEPT + lane] = float32(0)
    _separations(tables.isotropic, word, star, block.pair)
    _companion_masses(word, star, block.pair)
    grid, offset = tables.grid, tables.track_offset
    _flux_ratios(grid, tables.grid_start, tables.grid_step, offset, tables.log_dark, star, block.pair)


@njit(error_model="numpy")
def _primaries(stay, alias, word, number):  # type: ignore[no-untyped-def]
    """Stars in proportion to their multiplicity fractions, by the alias table."""
    n = uint64(stay.size)
    for lane in range(LANES):
        k = int32((uint64(word[lane]) * n) >> uint64(32))
        number[lane] = k if unit(word[LANES + lane]) < stay[k] else alias[k]


@njit(fastmath={"contract"}, error_model="numpy")
def _separations(isotropic, word, star, pair):  # type: ignore[no-untyped-def]
    """Projected separation over the cut, and its components at a random position angle."""
    for lane in range(LANES):
        uniform = (centred(word[2 * LANES + lane]) + float32(1)) * star[_TRUNCATION + lane] - float32(1)
        log_a = star[_A + lane] + star[_A_SIGMA + lane] * normal(max(uniform, float32(-0.9999999)))
        rho = projection_factor(isotropic, unit(word[4 * LANES + lane]), unit(word[5 * LANES + lane]))
        r = exp2(min(max(log_a, float32(_SMALLEST)), float32(60.0))) * rho
        s, c = sine_cosine(unit(word[6 * LANES + lane]) - float32(0.5))  # of half the position angle
        pair[X + lane], pair[Y + lane] = r * (c * c - s * s), r * float32(2) * s * c
        pair[SEPARATION + lane] = r


@njit(fastmath={"contract"}, error_model="numpy")
def _companion_masses(word, star, pair):  # type: ignore[no-untyped-def]
    """Binary logarithm of the companion's mass, for dN/dq in proportion to q^(g - 1) on [q_min, 1].

    log2 q = log2(q_min^g + u (1 - q_min^g)) / g, or (1 - u) log2 q_min where g = 0: in both, slope x
    log2(start + u (1 - start)) + (1 - u) flat.  It waits in the row of the flux ratio.
    """
    for lane in range(LANES):
        u, start = unit(word[3 * LANES + lane]), star[_Q_START + lane]
        bent = star[_Q_SLOPE + lane] * log2(start + u * (float32(1) - start))
        pair[FLUX_RATIO + lane] = star[_MASS + lane] + bent + (float32(1) - u) * star[_Q_FLAT + lane]


@njit(fastmath={"contract"}, error_model="numpy")
def _flux_ratios(grid, start, step, offset, log_dark, star, pair):  # type: ignore[no-untyped-def]
    """Flux ratio in the place of the companion's log2 mass, linear on the star's own mean of four tracks."""
    last = int32(grid.shape[0] - 2)
    per_step = float32(1) / step
    for lane in range(LANES):
        log_mass = pair[FLUX_RATIO + lane]
        place = max((log_mass - start) * per_step, float32(0))
        k = min(int32(place), last)
        t = place - float32(k)
        track = int32(star[_TRACK + lane])
        w0, w1, w2, w3 = star[_W0 + lane], star[_W1 + lane], star[_W2 + lane], star[_W3 + lane]
        t0, t1, t2, t3 = track + offset[0], track + offset[1], track + offset[2], track + offset[3]
        left = w0 * grid[k, t0] + w1 * grid[k, t1] + w2 * grid[k, t2] + w3 * grid[k, t3]
        right = w0 * grid[k + 1, t0] + w1 * grid[k + 1, t1] + w2 * grid[k + 1, t2] + w3 * grid[k + 1, t3]
        ratio = min(exp2(left + t * (right - left) - star[_FLUX + lane]), float32(1))
        pair[FLUX_RATIO + lane] = ratio if log_mass >= log_dark else float32(0)


@njit(inline="always", fastmath={"contract"})
def _add3(sums, row, factor, a, b, c):  # type: ignore[no-untyped-def]
    sums[row] += factor * a
    sums[row + LANES] += factor * b
    sums[row + 2 * LANES] += factor * c


@njit(inline="always", fastmath={"contract"})
def _add4(sums, row, factor, a, b, c, d):  # type: ignore[no-untyped-def]
    sums[row] += factor * a
    sums[row + LANES] += factor * b
    sums[row + 2 * LANES] += factor * c
    sums[row + 3 * LANES] += factor * d


@njit(inline="always", fastmath={"contract"})
def _add5(sums, row, factor, a, b, c, d, e):  # type: ignore[no-untyped-def]
    sums[row] += factor * a
    sums[row + LANES] += factor * b
    sums[row + 2 * LANES] += factor * c
    sums[row + 3 * LANES] += factor * d
    sums[row + 4 * LANES] += factor * e


@njit(fastmath={"contract"}, error_model="numpy")
def sum_block(pair, sums):  # type: ignore[no-untyped-def]
    """Add the kernel moments c_n x^a y^b of the kept pairs of a block, c_n = phi_1 (-phi_2)^n + phi_2 phi_1^n.

    Written out to order 8: only so does the compiler keep a lane's powers in vector registers.
    """
    # fmt: off
    for lane in range(LANES):
        kept, f = pair[KEPT + lane], pair[FLUX_RATIO + lane]
        a = pair[X + lane] if kept > float32(0) else float32(0)  # a resolved pair may be so wide
        b = pair[Y + lane] if kept > float32(0) else float32(0)  # that its powers overflow
        primary = float32(1) / (float32(1) + f)
        companion = f * primary
        near = kept * primary * companion * companion
        far = kept * companion * primary * primary
        m20, m11, m02 = a * a, a * b, b * b
        _add3(sums, 0 * LANES + lane, near + far, m20, m11, m02)
        near, far = near * -companion, far * primary
        m30, m21 = m20 * a, m11 * a
        m12, m03 = m02 * a, m02 * b
        _add4(sums, 3 * LANES + lane, near + far, m30, m21, m12, m03)
        near, far = near * -companion, far * primary
        m40, m31, m22 = m30 * a, m21 * a, m12 * a
        m13, m04 = m03 * a, m03 * b
        _add5(sums, 7 * LANES + lane, near + far, m40, m31, m22, m13, m04)
        near, far = near * -companion, far * primary
        m50, m41, m32 = m40 * a, m31 * a, m22 * a
        m23, m14, m05 = m13 * a, m04 * a, m04 * b
        _add3(sums, 12 * LANES + lane, near + far, m50, m41, m32)
        _add3(sums, 15 * LANES + lane, near + far, m23, m14, m05)
        near, far = near * -companion, far * primary
        m60, m51, m42, m33 = m50 * a, m41 * a, m32 * a, m23 * a
        m24, m15, m06 = m14 * a, m05 * a, m05 * b
        _add4(sums, 18 * LANES + lane, near + far, m60, m51, m42, m33)
        _add3(sums, 22 * LANES + lane, near + far, m24, m15, m06)
        near, far = near * -companion, far * primary
        m70, m61, m52, m43 = m60 * a, m51 * a, m42 * a, m33 * a
        m34, m25, m16, m07 = m24 * a, m15 * a, m06 * a, m06 * b
        _add4(sums, 25 * LANES + lane, near + far, m70, m61, m52, m43)
        _add4(sums, 29 * LANES + lane, near + far, m34, m25, m16, m07)
        near, far = near * -companion, far * primary
        m80, m71, m62, m53, m44 = m70 * a, m61 * a, m52 * a, m43 * a, m34 * a
        m35, m26, m17, m08 = m25 * a, m16 * a, m07 * a, m07 * b
        _add5(sums, 33 * LANES + lane, near + far, m80, m71, m62, m53, m44)
        _add4(sums, 38 * LANES + lane, near + far, m35, m26, m17, m08)
    # fmt: on


@njit
def flush(sums, total):  # type: ignore[no-untyped-def]
    """Move the sums of all lanes to one float64 total per moment."""
    for k in range(N_MOMENTS):
        value = 0.0
        for lane in range(LANES):
            value += sums[k * LANES + lane]
            sums[k * LANES + lane] = float32(0)
        total[k] += value
