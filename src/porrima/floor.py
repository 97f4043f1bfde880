"""The floor of the engine: its random numbers drawn and transformed in the same compiled way, and nothing else."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
from numba import njit, prange

from porrima.blocks import BLOCK_SIZE, LANES, draw_block, draw_numbers, keep_block
from porrima.pairs import tables_of
from porrima.streams import COUNT_STAGE, binomial, halves

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from porrima.systems import Population

    IntArray = NDArray[np.int64]

__all__ = ["draw_floor"]

_BATCH = 64  # stacks that share one thread's room, as in `stack`


def draw_floor(
    population: Population, *, n_stars: int, binary_fraction: float, seed: int, first: int, last: int
) -> IntArray:
    """Number of pairs that each stack draws, once they are drawn but not looked up, lit or summed.

    Parameters
    ----------
    population : Population
        As for `stack.draw_stacks`.
    n_stars : int
        Stars in each stack (count).
    binary_fraction : float
        In [0, 1].
    seed, first, last : int
        Of the run, and the range of stacks.

    Returns
    -------
    n_pairs : (n_stack,) int array
        Pairs drawn for each stack (count).

    Notes
    -----
    Per pair: the four words of the generator; the star's number and its alias; the normal deviate, the semi-major
    axis, the projection and the position angle; the mass ratio.  That is what any engine must compute that draws
    the same pairs from the same generator.  Axes are those of 32 stars of the population, so that as many pairs are
    resolved, and drawn again, as in the engine.
    """
    n_pairs = np.empty(last - first, np.int64)
    _draw(tables_of(population), np.uint64(seed), first, n_stars, float(binary_fraction), n_pairs)
    return n_pairs


@njit(cache=True, parallel=True)
def _draw(tables, seed, first, n_stars, fraction, n_pairs):  # type: ignore[no-untyped-def]
    for batch in prange((n_pairs.size + _BATCH - 1) // _BATCH):
        block = np.zeros(BLOCK_SIZE, np.float32)
        key_low, key_high = halves(seed)
        draw_block(tables, block, 1.0, key_low, key_high, *halves(first), 0)
        for s in range(batch * _BATCH, min((batch + 1) * _BATCH, n_pairs.size)):
            low, high = halves(first + s)
            wanted, draw = binomial(n_stars, fraction, key_low, key_high, COUNT_STAGE, low, high, 0)
            drawn, needed = 0, wanted
            while wanted > 0:
                resolved = 0
                while drawn < needed:
                    draw_numbers(tables, block, key_low, key_high, low, high, drawn)
                    n_valid, n_kept = keep_block(block)
                    resolved += min(n_valid, needed - drawn) * (n_valid - n_kept) // n_valid
                    drawn += LANES
                wanted = 0
                if resolved > 0:
                    wanted, draw = binomial(
                        resolved, fraction, key_low, key_high, COUNT_STAGE, low, high, draw
                    )
                needed += wanted
            n_pairs[s] = drawn
