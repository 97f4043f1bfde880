"""A selection in the engine: which drawn pairs are rejected, and how many single stars (compiled)."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING

import numpy as np
from numba import float32, int32, njit, uint32

from porrima.blocks import FLUX_RATIO, LANES, NUMBER, SEPARATION
from porrima.elementary import bits, centred, larger, log2, normal, smaller, unit
from porrima.pairs import CUT, single_star
from porrima.screen import FOUR_Y, PER_DECADE, SQUARE
from porrima.streams import ALONE_STAGE, LOST_STAGE, SCREEN_STAGE, binomial, philox, uniform_pair

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from porrima.screen import Screen
    from porrima.systems import Population

    FloatArray = NDArray[np.float64]

__all__ = ["is_rejected", "kept_single", "lost_singles", "reject_block", "single_loss"]

_PER_OCTAVE = float32(PER_DECADE * math.log10(2.0))
_Y_START, _SQUARE_START = (float32(1.0 - PER_DECADE * math.log10(node[1])) for node in (FOUR_Y, SQUARE))

_step = njit(inline="always", error_model="numpy")


def single_loss(population: Population, screen: Screen, scale: FloatArray) -> FloatArray:
    """Probability that a single star of a population is rejected.

    Parameters
    ----------
    population : Population
        Of n stars.
    screen : Screen
        Its selection.
    scale : (k,) float array
        Factors of the multiplicity fractions, dimensionless.

    Returns
    -------
    loss : (k,) float array
        In [0, 1].
    """
    if screen.is_empty:
        return np.zeros(scale.size)
    order = np.argsort(population.law.multiplicity_fraction, kind="stable")
    fraction, number = population.law.multiplicity_fraction[order], population.abundance[order]
    columns = np.stack([number, number * screen.single[order]])
    zero = np.zeros((2, 1))
    plain = np.concatenate([zero, np.cumsum(columns, axis=1)], axis=1)
    scaled = np.concatenate([zero, np.cumsum(columns * fraction, axis=1)], axis=1)
    with np.errstate(divide="ignore"):
        below = np.searchsorted(fraction, 1.0 / scale)  # stars that are not all pairs
    singles, lost = plain[:, below] - scale * scaled[:, below]
    loss: FloatArray = np.divide(lost, singles, out=np.zeros_like(lost), where=singles > 1e-9 * fraction.size)
    return np.clip(loss, 0.0, 1.0)


@_step
def _place(value, start, n):  # type: ignore[no-untyped-def]
    """Lower node of a value: 0, or one of nodes even in its logarithm."""
    return int32(smaller(larger(log2(value) * _PER_OCTAVE + start, float32(0)), float32(n - 2)))


@_step
def is_rejected(screen, star, four_y, square, key_low, key_high, stack_low, stack_high, pair):  # type: ignore[no-untyped-def]
    """Whether any layer rejects a pair of a star, by 4 f/(1+f)^2 and the square of its separation over the cut."""
    score, rejected = screen.score, False
    number = screen.slice[star]
    k = _place(larger(four_y, float32(1e-30)), _Y_START, score.shape[2])
    i = _place(larger(square, float32(1e-30)), _SQUARE_START, score.shape[3])
    y0, v0 = screen.four_y[k], screen.square[i]
    a, b = (four_y - y0) / (screen.four_y[k + 1] - y0), (square - v0) / (screen.square[i + 1] - v0)
    for layer in range(score.shape[0]):
        low = score[layer, number, k, i] + b * (score[layer, number, k, i + 1] - score[layer, number, k, i])
        high = score[layer, number, k + 1, i] + b * (
            score[layer, number, k + 1, i + 1] - score[layer, number, k + 1, i]
        )
        word = philox(key_low, key_high, pair, uint32(SCREEN_STAGE + layer), stack_low, stack_high)[0]
        deviate = normal(centred(word)) if screen.normal[layer] else unit(word)
        rejected |= deviate < low + a * (high - low)
    return rejected


@njit(_nrt=False)
def reject_block(screen, block, key_low, key_high, stack_low, stack_high, first):  # type: ignore[no-untyped-def]
    """Bring the rejected pairs of a block to beyond the cut; `first` is the number of the first in its stack."""
    for lane in range(LANES):
        r = block[SEPARATION + lane] * float32(1.0 / CUT)
        if r >= float32(1):
            continue
        f = block[FLUX_RATIO + lane]
        four_y = float32(4) * f / ((float32(1) + f) * (float32(1) + f))
        star, pair = bits(block[NUMBER + lane]), uint32(first + lane)
        if is_rejected(screen, star, four_y, r * r, key_low, key_high, stack_low, stack_high, pair):
            block[SEPARATION + lane] = float32(2.0 * CUT)


@njit(_nrt=False)
def lost_singles(n, loss, key_low, key_high, stack_low, stack_high, draw):  # type: ignore[no-untyped-def]
    """How many of n single stars are rejected, one binomial draw, and the next free draw."""
    if loss == 0.0:
        return 0, draw
    return binomial(n, loss, key_low, key_high, uint32(LOST_STAGE), stack_low, stack_high, draw)


@njit(_nrt=False)
def kept_single(tables, screen, scale, key_low, key_high, stack_low, stack_high, draw):  # type: ignore[no-untyped-def]
    """Number of a single star that is not rejected, and the next free draw."""
    while True:
        star, draw = single_star(tables, scale, key_low, key_high, stack_low, stack_high, draw)
        if screen.score.size == 0:
            return star, draw
        words = philox(key_low, key_high, uint32(draw), ALONE_STAGE, stack_low, stack_high)
        if uniform_pair(words[0], words[1]) >= screen.single[star]:
            return star, draw
