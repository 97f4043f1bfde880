r"""Pairs that a selection keeps: what is integrated over mass ratio and separation together.

Between two nodes of separation a score is linear in :math:`v = (r/r_{cut})^2`, so the mean of what is kept, and its
first moment, are integrals of a normal law, however sharp its edge; the moments of v over the orbits in between are
exact.
"""

from __future__ import annotations

import math
from typing import TYPE_CHECKING

import numpy as np
from numba import njit, prange
from scipy.special import ndtr

from porrima.moments import ORDER
from porrima.photometry import magnitude_on_track

if TYPE_CHECKING:
    from collections.abc import Callable

    from numpy.typing import NDArray

    from porrima.screen import Screen
    from porrima.systems import Population

    FloatArray = NDArray[np.float64]
    IntArray = NDArray[np.int64]

__all__ = ["cell_moments", "coarse_nodes", "joint_powers", "kept_cells", "mass_ratio_rule", "row_of_scores"]

_ROWS = 512  # whose orbits are in memory at a time
_SURE = 8.0  # normal deviates beyond which nothing, or everything, is kept
_FLAT = 0.1  # difference of scores below which what is kept is nearly linear
_PER_UNIT = 64.0  # nodes of the normal law
_NODES = np.arange(-_SURE, _SURE + 0.5 / _PER_UNIT, 1 / _PER_UNIT)
_BELOW, _DENSITY = ndtr(_NODES), np.exp(-0.5 * _NODES**2) / math.sqrt(2 * math.pi)


def coarse_nodes(n: int) -> IntArray:
    """Nodes of the coarser rule: 0, the next, and every other one from there.

    Parameters
    ----------
    n : int
        Nodes of the finer rule (count).

    Returns
    -------
    node : (n/2 + 1,) int array
        Their numbers, dimensionless.
    """
    return np.append(0, np.arange(1, n, 2))


def joint_powers(
    population: Population,
    screen: Screen,
    rule: int,
    intervals: int,
    start: IntArray,
    moments: Callable[[IntArray, FloatArray], FloatArray],
) -> FloatArray:
    r"""Expectation of powers of 4 y and of the separation over the pairs that are kept.

    Parameters
    ----------
    population : Population
        Of n stars.
    screen : Screen
        Its selection.
    rule : {0, 1}
        All nodes of separation and flux ratio, or every other one.
    intervals : int
        Of Simpson's rule over the logarithm of the mass ratio, even (count).
    start : (k,) int array
        First row of each run of classes that share star and mass ratios, ascending from 0 (dimensionless).
    moments : callable
        Even moments (m, n_r, 9) of the separation below some (n_r,) fractions of the cut, over these, for some stars
        (dimensionless).

    Returns
    -------
    powers : (n, 9, 9) float array
        :math:`E[(4y)^j (r/r_{cut})^{2k};\ \mathrm{kept}]`, dimensionless.
    """
    law, tracks = population.law, population.tracks
    y, v = np.arange(screen.four_y.size), np.arange(screen.square.size)
    if rule:
        y, v = coarse_nodes(y.size), coarse_nodes(v.size)
    four_y, square = screen.four_y[y].astype(float), screen.square[v].astype(float)
    score = np.ascontiguousarray(screen.score[:, :, y][..., v])
    out = np.zeros((law.star.size, ORDER + 1, ORDER + 1))
    edges = np.append(start, law.star.size)
    for part in np.array_split(np.arange(start.size), max(1, law.star.size // _ROWS)):
        own = start[part]
        rows = np.arange(own[0], edges[part[-1] + 1])
        cells = cell_moments(moments(rows, 0.5 * np.log10(square[1:])), square)
        _joint(
            tracks.magnitude, tracks.log_mass_min, tracks.dark_below, tracks.index[own], tracks.weight[own],
            population.stars.mass[own], law.mass_ratio_min[own], law.mass_ratio_max[own],
            law.mass_ratio_exponent[own], law.mass_ratio[own], intervals, four_y, square, score, screen.normal,
            screen.slice[own], edges[part[0] : part[-1] + 2] - own[0], cells, np.cumsum(cells[:, 0], axis=1),
            out[rows[0] : rows[-1] + 1],
        )  # fmt: skip
    return out


def cell_moments(moments: FloatArray, square: FloatArray) -> FloatArray:
    r"""Moments of v between its nodes, and how they lean.

    Parameters
    ----------
    moments : (n, n_r - 1, n_k) float array
        Even moments of the separation below each node but 0, over that node (dimensionless).
    square : (n_r,) float array
        Nodes of v, the first 0, dimensionless.

    Returns
    -------
    cells : (n, 2, n_r - 1, n_k) float array
        In each interval :math:`E[v^k]` and :math:`12 E[v^k (s - 1/2)]`, with s from 0 to 1 in proportion to v;
        dimensionless.
    """
    below = moments * square[1:, None] ** np.arange(moments.shape[2])
    content = np.diff(below, axis=1, prepend=0.0)
    lean = np.empty_like(content)
    step = np.diff(square)[:, None]
    raised = (content[..., 1:] - square[:-1, None] * content[..., :-1]) / step
    lean[..., :-1] = 12 * (raised - 0.5 * content[..., :-1])
    last = np.divide(
        lean[..., -2], content[..., -2], out=np.zeros(content.shape[:-1]), where=content[..., -2] > 0
    )
    lean[..., -1] = last * content[..., -1]
    return np.stack([content, lean], axis=1)


@njit(inline="always")
def row_of_scores(score, four_y, value, out):  # type: ignore[no-untyped-def]
    """Scores of one magnitude at a value of 4 y, linear between its nodes, at all nodes of separation."""
    k = min(max(np.searchsorted(four_y, value, side="right") - 1, 0), four_y.size - 2)
    upper = (value - four_y[k]) / (four_y[k + 1] - four_y[k])
    for i in range(out.size):
        out[i] = (1.0 - upper) * score[k, i] + upper * score[k + 1, i]


@njit(inline="always")
def _normal_law(z):  # type: ignore[no-untyped-def]
    """Probability and density of the normal law, by Taylor's series about the nearest node: to 1e-10 and 1e-9."""
    if z > _SURE:
        return 1.0, 0.0
    if z < -_SURE:
        return 0.0, 0.0
    k = int(z * _PER_UNIT + _SURE * _PER_UNIT + 0.5)
    node = k / _PER_UNIT - _SURE
    d, square = z - node, node * node
    second, third = square - 1.0, node * (3.0 - square)
    density = _DENSITY[k] * (1.0 + d * (-node + d * (0.5 * second + d * (third / 6.0))))
    below = _BELOW[k] + _DENSITY[k] * d * (1.0 + d * (-0.5 * node + d * (second / 6.0 + d * third / 24.0)))
    return below, density


@njit
def kept_cells(normal, scores, mean, lean):  # type: ignore[no-untyped-def]
    """Mean of what a row of scores keeps in each interval, and of that times (s - 1/2), after what was kept before."""
    p0, d0 = _normal_law(scores[0]) if normal else (scores[0], 0.0)
    for c in range(mean.size):
        z0, z1 = scores[c], scores[c + 1]
        p1, d1 = _normal_law(z1) if normal else (z1, 0.0)
        step = z1 - z0
        if normal and abs(step) > _FLAT:
            first = (z1 * p1 + d1) - (z0 * p0 + d0)  # of the law, and of the law times the deviate
            second = 0.5 * (((z1 * z1 - 1.0) * p1 + z1 * d1) - ((z0 * z0 - 1.0) * p0 + z0 * d0))
            a, b = 1.0 - first / step, (0.5 * (z0 + z1) * first - second) / (step * step)
        else:
            a, b = 1.0 - 0.5 * (p0 + p1) + step * (d1 - d0) / 12.0, (p0 - p1) / 12.0
        mean[c], lean[c] = mean[c] * a + 12.0 * lean[c] * b, mean[c] * b + lean[c] * a
        p0, d0 = p1, d1


@njit(inline="always")
def _keep(score, normal, four_y, value, row, mean, lean):  # type: ignore[no-untyped-def]
    """What is kept of pairs of one flux ratio in each interval; the first and last where not all or nothing is."""
    mean[:], lean[:] = 1.0, 0.0
    for layer in range(score.shape[0]):
        row_of_scores(score[layer], four_y, value, row)
        kept_cells(normal[layer], row, mean, lean)
    first, last = 0, mean.size
    while first < last and mean[first] == 1.0 and lean[first] == 0.0:
        first += 1
    while last > first and mean[last - 1] == 0.0 and lean[last - 1] == 0.0:
        last -= 1
    return first, last


@njit(inline="always")
def _add(weight, value, first, last, mean, lean, cells, below, kept, out):  # type: ignore[no-untyped-def]
    """Weight times the powers of 4 y times what is kept of those of v, added to a row's."""
    for k in range(kept.size):
        kept[k] = weight * below[first - 1, k] if first > 0 else 0.0
    for c in range(first, last):
        a, b = weight * mean[c], weight * lean[c]
        for k in range(kept.size):
            kept[k] += a * cells[0, c, k] + b * cells[1, c, k]
    power = 1.0
    for j in range(out.shape[0]):
        for k in range(kept.size):
            out[j, k] += power * kept[k]
        power *= value


@njit(inline="always")
def mass_ratio_rule(mass, dark_below, q_min, q_max, exponent, given, intervals):  # type: ignore[no-untyped-def]
    """Simpson's rule in ln q from 1, or from q_max, down to where companions of one star are dark: the exponent of q in
    the density over ln q, its norm, ln of the last node, the span, and how many nodes there are: one where q is given.
    """
    g = exponent + 1.0
    norm = (q_max**g - q_min**g) / g if abs(g) > 1e-9 else math.log(q_max / q_min)
    last, nodes = math.log(q_max), intervals + 1
    span = last - math.log(min(max(dark_below / mass, q_min), q_max))
    if not math.isnan(given):
        last, span, nodes = 0.0, -math.log(given), 1 if given * mass >= dark_below else 0
    elif span == 0.0:
        nodes = 0
    return g, norm, last, span, nodes


@njit(cache=True, parallel=True)
def _joint(  # type: ignore[no-untyped-def]
    grid, log_mass_min, dark_below, index, weight, mass, q_min, q_max, exponent, given, intervals, four_y, square,
    score, normal, number, edge, cells, below, out,
):  # fmt: skip
    """Joint powers of runs of rows; mass ratios by Simpson's rule in their logarithm, as in `integrals`."""
    to_log, to_exponent = 1.0 / math.log(10.0), -0.4 * math.log(10.0)
    for s in prange(mass.size):
        row, mean, lean = np.empty(square.size), np.empty(square.size - 1), np.empty(square.size - 1)
        kept = np.empty(out.shape[2])
        i, w, log_mass = index[s], weight[s], math.log10(mass[s])
        primary = magnitude_on_track(grid, log_mass_min, log_mass, i, w)
        g, norm, last, span, nodes = mass_ratio_rule(
            mass[s], dark_below, q_min[s], q_max[s], exponent[s], given[s], intervals
        )
        one, dark, h = not math.isnan(given[s]), 1.0, span / intervals
        for k in range(nodes + 1):  # the last for companions that are dark
            log_q, is_dark = h * k - span + last, k == nodes
            magnitude = magnitude_on_track(grid, log_mass_min, log_mass + log_q * to_log, i, w)
            f = 0.0 if is_dark else min(math.exp(to_exponent * (magnitude - primary)), 1.0)
            simpson = 1.0 if k == 0 or k == intervals else 4.0 if k % 2 else 2.0
            share = 1.0 if one else math.exp(g * log_q) / norm * h / 3.0 * simpson
            share = dark if is_dark else share
            dark -= share
            value = 4.0 * f / (1.0 + f) ** 2
            from_cell, to_cell = _keep(score[:, number[s]], normal, four_y, value, row, mean, lean)
            for r in range(edge[s], edge[s + 1]):
                _add(share, value, from_cell, to_cell, mean, lean, cells[r], below[r], kept, out[r])
