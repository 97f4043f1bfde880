r"""A selection on one grid for a population: what the engine draws by, and what the closed form integrates over.

Nodes are even in the logarithms of :math:`4y = 4f/(1+f)^2` and of :math:`v = (r/r_{cut})^2`, with 0 below each; between
them scores are linear in y and v.  Stars take the nearest node of magnitude.
"""

from __future__ import annotations

import math
from functools import lru_cache
from typing import TYPE_CHECKING, NamedTuple, cast

import numpy as np
from scipy.special import ndtr

from porrima.errors import InputError

if TYPE_CHECKING:
    from collections.abc import Hashable

    from numpy.typing import NDArray

    from porrima.selection import Selection
    from porrima.systems import Population

    FloatArray = NDArray[np.float64]

__all__ = [
    "FOUR_Y", "MAGNITUDE_STEP", "PER_DECADE", "SQUARE", "Screen", "flux_ratio_of", "kept_share", "magnitude_nodes",
    "no_screen", "screen_of",
]  # fmt: skip

PER_DECADE = 20
"""Nodes in a decade of 4 y or of (r/cut)² (count)."""

FOUR_Y = np.append(0.0, np.logspace(-4, 0, 4 * PER_DECADE + 1))
"""Nodes of 4 f/(1+f)², dimensionless; one of two, from 0 on, are nodes of the coarser rule."""

SQUARE = np.append(0.0, np.logspace(-6, 0, 6 * PER_DECADE + 1))
"""Nodes of the square of the separation over the cut, dimensionless, likewise."""

MAGNITUDE_STEP = 0.05
"""Largest distance of nodes in magnitude, in mag: a star is at most half of it from its own."""

_LEAST_KEPT = 1e-3  # share of single stars that must be left


class Screen(NamedTuple):
    """A selection on the grid of a population of n stars.

    Scores and how they are meant are those of `selection.Layer`.
    """

    score: NDArray[np.float32]  # (n_layer, n_m, n_f, n_r)
    normal: NDArray[np.bool_]  # (n_layer,)
    slice: NDArray[np.int32]  # (n,) node of magnitude of each star
    single: FloatArray  # (n,) probability that each star, if single, is rejected
    four_y: NDArray[np.float32]  # (n_f,)
    square: NDArray[np.float32]  # (n_r,)

    @property
    def is_empty(self) -> bool:
        """Whether nothing is rejected."""
        return self.score.size == 0


def flux_ratio_of(four_y: FloatArray) -> FloatArray:
    """Flux ratio of 4 f/(1+f)².

    Parameters
    ----------
    four_y : (n,) float array
        In [0, 1], dimensionless.

    Returns
    -------
    flux_ratio : (n,) float array
        In [0, 1], dimensionless.
    """
    root = np.sqrt(1.0 - four_y)
    ratio: FloatArray = (1.0 - root) / (1.0 + root)
    return np.where(four_y < 1e-6, 0.25 * four_y, ratio)


def screen_of(population: Population) -> Screen:
    """Screen of a population.

    Parameters
    ----------
    population : Population
        With its selection.

    Returns
    -------
    screen : Screen
        Dimensionless; empty where there is no selection.

    Raises
    ------
    InputError
        If nearly all single stars are rejected.
    """
    if population.selection is None:
        return no_screen()
    return _screen(
        cast("Hashable", population.selection), population.cut, population.stars.magnitude.tobytes()
    )


def no_screen() -> Screen:
    """The screen that rejects nothing.

    Parameters
    ----------
    None

    Returns
    -------
    screen : Screen
        Without stars, dimensionless.
    """
    return Screen(
        score=np.empty((0, 0, 0, 0), np.float32),
        normal=np.empty(0, np.bool_),
        slice=np.empty(0, np.int32),
        single=np.empty(0),
        four_y=FOUR_Y.astype(np.float32),
        square=SQUARE.astype(np.float32),
    )


def magnitude_nodes(magnitude: FloatArray, n: int | None = None) -> tuple[FloatArray, NDArray[np.int32]]:
    """Nodes of magnitude that serve some stars, and the nearest to each star.

    Parameters
    ----------
    magnitude : (n_star,) float array
        Of the stars, in mag.
    n : int, optional
        Nodes (count); as many as `MAGNITUDE_STEP` asks for where not given.

    Returns
    -------
    nodes, number : (n,) float array, (n_star,) int array
        In mag, and the number of each star's node.
    """
    low, high = float(magnitude.min()), float(magnitude.max())
    if n is None:
        n = 1 + math.ceil((high - low) / MAGNITUDE_STEP - 1e-9)
    step = (high - low) / (n - 1) if n > 1 else np.inf
    return np.linspace(low, high, n), np.rint((magnitude - low) / step).astype(np.int32)


def kept_share(screen: Screen, number: int, four_y: FloatArray, square: FloatArray) -> FloatArray:
    """Probability that pairs of one node of magnitude are kept.

    Parameters
    ----------
    screen : Screen
        Of the population.
    number : int
        Node of magnitude (count).
    four_y, square : (n,), (m,) float array
        4 f/(1+f)², and the square of the separation over the cut, in [0, 1].

    Returns
    -------
    kept : (n, m) float array
        In [0, 1].
    """
    kept = np.ones((four_y.size, square.size))
    for score, normal in zip(screen.score[:, number], screen.normal, strict=True):
        rows = np.stack([np.interp(square, SQUARE, row) for row in score])
        found = np.stack([np.interp(four_y, FOUR_Y, column) for column in rows.T], axis=1)
        kept *= 1.0 - (ndtr(found) if normal else found)
    return kept


@lru_cache(maxsize=8)
def _screen(selection: Hashable, cut: float, stars: bytes) -> Screen:
    """What `screen_of` keeps, as changes of a population leave it as it is."""
    separation, flux_ratio = cut * np.sqrt(SQUARE), flux_ratio_of(FOUR_Y)
    magnitude, number = magnitude_nodes(np.frombuffer(stars))
    layers = cast("Selection", selection).layers(separation, flux_ratio, magnitude)
    n_m = max(layer.score.shape[0] for layer in layers)
    if n_m == 1:
        number = np.zeros_like(number)
    score = np.stack(
        [np.broadcast_to(layer.score, (n_m, flux_ratio.size, separation.size)) for layer in layers]
    )
    normal = np.array([layer.normal for layer in layers])
    alone = score[:, :, 0, 0]
    kept = np.prod(1.0 - np.where(normal[:, None], ndtr(alone), alone), axis=0)[number]
    if kept.mean() < _LEAST_KEPT:
        raise InputError("must leave some single stars", key="selection", value=f"{kept.mean():.1e} of them")
    return no_screen()._replace(
        score=np.ascontiguousarray(score, dtype=np.float32), normal=normal, slice=number, single=1.0 - kept
    )
