"""Triple stars in the engine: one compiled function draws one, and its three sources add their moments in float64.

Triples are few and no loop is made for them: in a population that has any, those of a block are drawn one by one after
its pairs, and what the block holds of the pair in their place is made to add nothing.
"""

from __future__ import annotations

import math
from typing import TYPE_CHECKING

import numpy as np
from numba import float32, int32, njit, uint32

from porrima.blocks import FLUX_RATIO, KEPT, LANES, NUMBER, SEPARATION, X, Y
from porrima.elementary import bits, exp2, log2, normal, unit
from porrima.hierarchy import INNER_AROUND_PRIMARY, STABLE_EXPONENT, STABLE_RATIO, members
from porrima.moments import N_MOMENTS, ORDER
from porrima.pairs import (
    BASE,
    DIMMING,
    MASS,
    Q_FLAT,
    Q_SLOPE,
    Q_START,
    SIGMA,
    TRUNCATION,
    W0,
    W1,
    W2,
    W3,
    A,
    axis_argument,
    companion_mass,
    direction,
    flux_ratio,
    light,
    place_on_track,
    separation,
)
from porrima.streams import TRIPLE_STAGE, philox

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from porrima.systems import Population

__all__ = ["ROOM", "add_triples", "draw_triples", "list_triples", "member_rows"]

ROOM = (LANES + 1, N_MOMENTS)
"""Shape of the room of a thread: a row for each triple of a block, and one for the terms of a moment."""

_MEMBERS, _FIRST, _CUMULATIVE, _PRIMARY = range(4)
"""Columns of `member_rows`."""

_F1, _X1, _Y1, _F2, _X2, _Y2 = range(6)
"""Columns of a triple: flux ratio and offset from the primary of either companion, in `pairs.CUT`."""

_MOST_TRIES = 600
"""Hierarchies tried; where one of fifteen is stable, one of 1e18 triples is left with the last."""

_LOG_RATIO = math.log2(STABLE_RATIO)


def member_rows(population: Population) -> NDArray[np.float32]:
    """What triples need of the rows of a population beside what pairs do.

    Parameters
    ----------
    population : Population
        Of n rows.

    Returns
    -------
    rows : (n, 4) float32 array
        How many classes a triple of the star takes two of, 0 for a pair, and the first of them (both as bits); the
        share of this and the classes before among them, in [0, 1]; log2 of the primary's mass in M_sun.  No rows where
        there are no triples.
    """
    law = population.law
    if not np.any(law.is_triple):
        return np.empty((0, 4), np.float32)
    first, count = members(law)
    rows = np.zeros((count.size, 4), np.float32)
    rows[:, _MEMBERS] = count.astype(np.int32).view(np.float32)
    rows[:, _FIRST] = first.astype(np.int32).view(np.float32)
    running = np.cumsum(np.where(law.is_triple, law.share, 0.0))
    before = np.where(first > 0, running[first - 1], 0.0)
    total = np.where(law.is_triple, running[np.maximum(first + count - 1, 0)] - before, 1.0)
    rows[:, _CUMULATIVE] = np.where(law.is_triple, (running - before) / total, 0.0)
    rows[:, _PRIMARY] = np.log2(population.stars.mass)
    return rows


_step = njit(_nrt=False, fastmath={"contract"}, error_model="numpy")


@_step
def _member(member, row, word):  # type: ignore[no-untyped-def]
    """Class of one of the two orbits, drawn by the shares of those of the star."""
    k = bits(member[row, _FIRST])
    last, u = k + bits(member[row, _MEMBERS]) - 1, unit(word)
    while k < last and u >= member[k, _CUMULATIVE]:
        k += 1
    return k


@_step
def _log_axis(star, row, word):  # type: ignore[no-untyped-def]
    """Binary logarithm of the semi-major axis."""
    return star[row, A] + star[row, SIGMA] * normal(axis_argument(word, star[row, TRUNCATION]))


@_step
def _log_mass(star, row, word):  # type: ignore[no-untyped-def]
    """Binary logarithm of the mass of a companion of the primary."""
    return companion_mass(word, star[row, MASS], star[row, Q_SLOPE], star[row, Q_START], star[row, Q_FLAT])


@_step
def _shine(tables, row, mass):  # type: ignore[no-untyped-def]
    """Flux of a companion over that of the primary."""
    k, t = place_on_track(mass, tables.grid_start, tables.grid_per_unit, tables.n_grid)
    own, track, line = tables.star, tables.track, bits(tables.star[row, BASE]) + k
    left = light(
        own[row, W0], own[row, W1], own[row, W2], own[row, W3],
        track[line, 0], track[line, 1], track[line, 2], track[line, 3], own[row, DIMMING],
    )  # fmt: skip
    right = light(
        own[row, W0], own[row, W1], own[row, W2], own[row, W3],
        track[line, 4], track[line, 5], track[line, 6], track[line, 7], own[row, DIMMING],
    )  # fmt: skip
    return flux_ratio(left, right, t, mass < tables.log_dark)


@_step
def _hierarchy(tables, member, row, key_low, key_high, low, high, pair):  # type: ignore[no-untyped-def]
    """Outer and inner axis, masses of the outer and the inner companion, all log2, and whether the inner pair holds the
    primary: drawn until it is stable.  Of (A,B)-C the inner companion is B, of A-(B,C) it is C.
    """
    star, own, around, stage = tables.star, member[row, _PRIMARY], False, uint32(TRIPLE_STAGE + 1)
    outer, inner, m_outer, m_inner = float32(0), float32(0), float32(0), float32(0)
    for attempt in range(_MOST_TRIES):
        words = philox(key_low, key_high, pair, stage, low, high)
        others = philox(key_low, key_high, pair, uint32(stage + uint32(1)), low, high)
        stage = uint32(stage + uint32(2))
        if attempt == 0:
            around = unit(others[2]) < float32(INNER_AROUND_PRIMARY)
        one, two = _member(member, row, others[0]), _member(member, row, others[1])
        outer, inner = _log_axis(star, one, words[0]), _log_axis(star, two, words[1])
        m_outer, m_inner = _log_mass(star, one, words[2]), _log_mass(star, two, words[3])
        if inner > outer:
            outer, inner = inner, outer
            m_outer, m_inner = m_inner, m_outer
        q_outer, q_inner = exp2(m_outer - own), exp2(m_inner - own)
        if around:
            third = q_outer / (float32(1) + q_inner)
        else:
            m_inner += m_outer - own
            third = float32(1) / (q_outer * (float32(1) + q_inner))
        if outer - inner > float32(_LOG_RATIO) + float32(STABLE_EXPONENT) * log2(float32(1) + third):
            break
    return outer, inner, m_outer, m_inner, around


@njit(_nrt=False, fastmath={"contract"}, error_model="numpy")
def _draw_triple(tables, member, row, key_low, key_high, low, high, pair, three):  # type: ignore[no-untyped-def]
    """Draw one triple into `three` and return the largest distance between two of its sources."""
    outer, inner, m_outer, m_inner, around = _hierarchy(
        tables, member, row, key_low, key_high, low, high, pair
    )
    turns = philox(key_low, key_high, pair, uint32(TRIPLE_STAGE), low, high)
    r_out = separation(tables.isotropic, outer, turns[0], turns[2])
    r_in = separation(tables.isotropic, inner, turns[1], turns[3])
    c_out, s_out = direction(turns[0])
    c_in, s_in = direction(turns[1])
    x, y, dx, dy = r_out * c_out, r_out * s_out, r_in * c_in, r_in * s_in
    lighter = exp2(m_inner - (member[row, _PRIMARY] if around else m_outer))
    share = lighter / (float32(1) + lighter)  # of the inner companion in the mass of its pair
    three[_F1], three[_F2] = _shine(tables, row, m_outer), _shine(tables, row, m_inner)
    if around:  # from the primary to the centre of the inner pair, and on to the third star
        three[_X1], three[_Y1] = share * dx + x, share * dy + y
        three[_X2], three[_Y2] = dx, dy
    else:
        three[_X1], three[_Y1] = x - share * dx, y - share * dy
        three[_X2], three[_Y2] = three[_X1] + dx, three[_Y1] + dy
    first = three[_X1] * three[_X1] + three[_Y1] * three[_Y1]
    second = three[_X2] * three[_X2] + three[_Y2] * three[_Y2]
    between = (three[_X1] - three[_X2]) ** 2 + (three[_Y1] - three[_Y2]) ** 2
    return math.sqrt(max(first, max(second, between)))


@njit(_nrt=False)
def draw_triples(tables, member, block, room, key_low, key_high, low, high, first):  # type: ignore[no-untyped-def]
    """Put triples where a block has their stars: its rows get their widest separation, and a pair without light."""
    for lane in range(LANES):
        row = bits(block[NUMBER + lane])
        if bits(member[row, _MEMBERS]) > 0:
            block[SEPARATION + lane] = _draw_triple(
                tables, member, row, key_low, key_high, low, high, uint32(first + lane), room[lane]
            )
            block[FLUX_RATIO + lane], block[X + lane], block[Y + lane] = float32(0), float32(0), float32(0)


@njit(_nrt=False)
def add_triples(member, block, room, total):  # type: ignore[no-untyped-def]
    """Add the kernel moments of the kept triples of a block, in float64."""
    for lane in range(LANES):
        kept = float(block[KEPT + lane])
        if kept > 0.0 and bits(member[bits(block[NUMBER + lane]), _MEMBERS]) > 0:
            three, term = room[lane], room[LANES]
            f1, f2 = three[_F1], three[_F2]
            norm = 1.0 / (1.0 + f1 + f2)
            x = (f1 * three[_X1] + f2 * three[_X2]) * norm
            y = (f1 * three[_Y1] + f2 * three[_Y2]) * norm
            _add_source(total, term, kept * norm, -x, -y)
            _add_source(total, term, kept * f1 * norm, three[_X1] - x, three[_Y1] - y)
            _add_source(total, term, kept * f2 * norm, three[_X2] - x, three[_Y2] - y)


@njit(_nrt=False)
def _add_source(total, term, flux, x, y):  # type: ignore[no-untyped-def]
    """Add the moments of one source about the centroid; those of each order follow from the last one's in `term`."""
    term[0], term[1], term[2] = flux * x * x, flux * x * y, flux * y * y
    total[0] += term[0]
    total[1] += term[1]
    total[2] += term[2]
    start, last = 3, 0
    for order in range(3, ORDER + 1):
        for b in range(order):
            term[start + b] = term[last + b] * x
        term[start + order] = term[last + order - 1] * y
        for b in range(order + 1):
            total[start + b] += term[start + b]
        start, last = start + order + 1, start


@njit(_nrt=False)
def list_triples(member, block, room, listed, row):  # type: ignore[no-untyped-def]
    """Put the sources of the kept triples of a block into its listed systems, the first of which is in `row`."""
    for lane in range(LANES):
        if block[KEPT + lane] > float32(0):
            if bits(member[bits(block[NUMBER + lane]), _MEMBERS]) > 0:
                three = room[lane]
                listed[row, 0], listed[row, 1], listed[row, 2] = three[_F1], three[_X1], three[_Y1]
                listed[row, 4], listed[row, 5], listed[row, 6] = three[_F2], three[_X2], three[_Y2]
            row += int32(1)
