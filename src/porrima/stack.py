"""The engine: many stacks of exactly N stars, each reduced to the mean kernel moments of its systems.

No image is drawn.  The number of pairs of a stack is one binomial draw and single stars cost nothing; each
pair draws its primary, mass ratio, orbit and orientation, and adds its moments.  A resolved pair leaves the
sample and another star takes its place.  Every stack has random streams of its own, so its numbers depend
on the seed and its number alone.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Literal

import numpy as np
from numba import int64, njit, prange, uint32

from porrima.blocks import (
    BLOCK_SIZE,
    FLUX_RATIO,
    KEPT,
    LANES,
    X,
    Y,
    draw_block,
    flush,
    keep_block,
    keep_lanes,
    sum_block,
    weigh_block,
)
from porrima.errors import InputError
from porrima.moments import INDICES, N_MOMENTS, KernelMoments
from porrima.pairs import CUT, MOST_TRIES, tables_of
from porrima.rejection import kept_single, lost_singles, reject_block, single_loss
from porrima.screen import screen_of
from porrima.streams import COUNT_STAGE, FRACTION_STAGE, binomial, halves, philox, uniform_pair
from porrima.systems import Systems
from porrima.triples import ROOM, add_triples, draw_triples, list_triples, member_rows

if TYPE_CHECKING:
    from collections.abc import Callable

    from numpy.typing import NDArray

    from porrima.systems import Population

    FloatArray = NDArray[np.float64]

__all__ = ["BinaryFraction", "Device", "Stacks", "draw_stacks", "draw_systems"]

Device = Literal["cpu", "cuda"]
"""Where stacks are drawn."""

BinaryFraction = float | Literal["uniform", "model"]
"""A number in [0, 1], ``uniform`` for one in (0, 1) per stack, ``model`` for the multiplicity model's own."""

_MAX_SEED = 2**64
_BATCH = 64  # stacks that share one thread's room
_BLOCKS_IN_FLOAT32 = 32  # sums of more blocks than these go on in float64


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


def draw_stacks(
    population: Population,
    *,
    n_stars: int,
    binary_fraction: BinaryFraction,
    seed: int,
    first: int,
    last: int,
    device: Device = "cpu",
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
    device : {"cpu", "cuda"}
        Where to draw; a GPU draws the same pairs, and its moments differ in rounding alone.

    Returns
    -------
    stacks : Stacks
        Binary fractions and moments of `last` - `first` stacks.

    Raises
    ------
    ValueError
        If a count, the seed or the binary fraction is out of range, or the device is unknown or not there.
    """
    fractions = _fractions(population, n_stars, binary_fraction, seed, first, last)
    scale = population.scale(fractions) if binary_fraction != "model" else np.ones(last - first)
    sums = np.zeros((last - first, N_MOMENTS))
    unit = np.array([(population.cut / CUT) ** (a + b) for a, b in INDICES])
    screen, fill = screen_of(population), _filler(device)
    member = member_rows(population)
    chosen = () if device == "cuda" else (member, screen, single_loss(population, screen, scale))
    for found, what in ((not screen.is_empty, "a selection"), (member.size > 0, "triples")):
        if device == "cuda" and found:
            raise InputError(f"must be cpu for a run with {what}", key="device", value=device)
    fill(tables_of(population), *chosen, np.uint64(seed), first, n_stars, fractions, scale, unit, sums)
    if np.any(np.isnan(sums[:, 0])):
        raise ValueError(
            f"cut must leave some pairs unresolved at this binary fraction, got {population.cut}"
        )
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
        The n_stars systems, multiple stars first; of three sources where the population has triples.

    Raises
    ------
    ValueError
        As `draw_stacks`.
    """
    fractions = _fractions(population, n_stars, binary_fraction, seed, stack, stack + 1)
    scale = population.scale(fractions) if binary_fraction != "model" else np.ones(1)
    listed, sums = np.tile([-1.0, *[0.0] * 6], (n_stars, 1)), np.zeros(N_MOMENTS)
    member, block, key = member_rows(population), np.zeros(BLOCK_SIZE, np.float32), np.uint64(seed)
    screen = screen_of(population)
    loss = single_loss(population, screen, scale)[0]
    _draw_stack(
        tables_of(population), member, screen, loss, block, np.zeros(ROOM), key, stack, n_stars, fractions[0],
        scale[0], sums, listed,
    )  # fmt: skip
    unit, weight = population.cut / CUT, listed[:, 3]
    flux_ratio, dx, dy = listed[:, [0, 4]], listed[:, [1, 5]] * unit, listed[:, [2, 6]] * unit
    if member.size == 0:
        return Systems.from_pairs(flux_ratio[:, 0], dx[:, 0], dy[:, 0], weight)
    return Systems.from_companions(flux_ratio, dx, dy, weight)


def _filler(device: Device) -> Callable[..., None]:
    """The function that draws the stacks of a range on a device; numba.cuda is loaded only where it is needed."""
    if device not in ("cpu", "cuda"):
        raise ValueError(f"device must be cpu or cuda, got {device}")
    if device == "cpu":
        return _fill  # type: ignore[no-any-return]
    from porrima.gpu import fill

    return fill


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
        return np.full(last - first, (population.abundance * population.law.multiplicity_fraction).mean())
    if not 0 <= float(binary_fraction) <= 1:
        raise ValueError(f"binary_fraction must be in [0, 1], got {binary_fraction}")
    return np.full(last - first, float(binary_fraction))


@njit(cache=True)
def _uniform_fractions(seed, first, fractions):  # type: ignore[no-untyped-def]
    key_low, key_high = halves(seed)
    for s in range(fractions.size):
        low, high = halves(first + s)
        words = philox(key_low, key_high, 0, FRACTION_STAGE, low, high)
        fractions[s] = uniform_pair(words[0], words[1])


@njit(forceinline=True, _nrt=False, cache=True)
def _draw_stack(  # type: ignore[no-untyped-def]
    tables, member, screen, loss, block, room, seed, stack, n_stars, fraction, scale, sums, listed
):
    """Sum of the weights of one stack, with those of its moments, in the unit of length, in `sums`.

    Its systems are listed where `listed` has rows.

    The pairs of a stack are one stream.  As many are taken as the binomial draw says; for each that is resolved
    another star is drawn, which is a pair with the same probability, until none is.  So it is for each pair and each
    single star that a selection rejects.
    """
    key_low, key_high = halves(seed)
    low, high = halves(stack)
    stage, none = (
        uint32(COUNT_STAGE),
        int64(0),
    )  # no literals, for each of which functions would be compiled anew
    wanted, draw = binomial(n_stars, fraction, key_low, key_high, stage, low, high, none)
    resolved, lost_draw = lost_singles(n_stars - wanted, loss, key_low, key_high, low, high, none)
    n_blocks, kept, total, lane = 0, 0, 0.0, LANES
    while wanted > 0 or resolved > 0:
        if wanted == 0:
            places = resolved
            wanted, draw = binomial(places, fraction, key_low, key_high, stage, low, high, draw)
            resolved, lost_draw = lost_singles(places - wanted, loss, key_low, key_high, low, high, lost_draw)
            continue
        if lane == LANES:
            if n_blocks > 0:
                total += _add_block(tables.weight, member, block, room, sums, listed)
                if n_blocks % _BLOCKS_IN_FLOAT32 == 0:
                    flush(block, sums)
            if n_blocks * LANES > MOST_TRIES * (n_stars + 100):
                return np.nan
            draw_block(tables, block, scale, key_low, key_high, low, high, n_blocks * LANES)
            if screen.score.size > 0:
                reject_block(screen, block, key_low, key_high, low, high, n_blocks * LANES)
            if member.shape[0] > 0:
                draw_triples(tables, member, block, room, key_low, key_high, low, high, n_blocks * LANES)
            n_blocks, lane = n_blocks + 1, 0
        if lane == 0 and wanted >= LANES:
            n_valid, n_kept = keep_block(block)
            lane = LANES
        else:
            lane, n_valid, n_kept = keep_lanes(block, lane, wanted)
        wanted, resolved, kept = wanted - n_valid, resolved + n_valid - n_kept, kept + n_kept
    if n_blocks > 0:
        total += _add_block(tables.weight, member, block, room, sums, listed)
        flush(block, sums)
    if tables.weight.size == 0 and listed.shape[0] == 0:  # single stars cost nothing
        return float(n_stars)
    return total + _add_singles(tables, screen, key_low, key_high, low, high, n_stars, kept, scale, listed)


@njit(forceinline=True, _nrt=False)
def _add_block(weight, member, block, room, sums, listed):  # type: ignore[no-untyped-def]
    """Add the moments of the kept systems of a block and list them below the last one; their weight, where weighed."""
    total = weigh_block(weight, block) if weight.size > 0 else 0.0
    sum_block(block)
    if member.shape[0] > 0:
        add_triples(member, block, room, sums)
    if listed.shape[0] > 0:
        row = 0
        while row < listed.shape[0] and listed[row, 0] >= 0.0:
            row += 1
        first = row
        for lane in range(LANES):
            if block[KEPT + lane] > np.float32(0):
                listed[row, 0], listed[row, 3] = block[FLUX_RATIO + lane], block[KEPT + lane]
                listed[row, 1], listed[row, 2] = block[X + lane], block[Y + lane]
                row += 1
        if member.shape[0] > 0:
            list_triples(member, block, room, listed, first)
    return total


@njit(_nrt=False)
def _add_singles(tables, screen, key_low, key_high, low, high, n_stars, kept, scale, listed):  # type: ignore[no-untyped-def]
    """Total weight of the single stars of a stack, each listed where `listed` has rows."""
    total, draw = 0.0, int64(0)
    for single in range(kept, n_stars):
        weight = 1.0
        if tables.weight.size > 0:
            star, draw = kept_single(tables, screen, scale, key_low, key_high, low, high, draw)
            weight = float(tables.weight[star])
        total += weight
        if listed.shape[0] > 0:
            listed[single, 0], listed[single, 3] = 0.0, weight
    return total


@njit(cache=True, parallel=True)
def _fill(tables, member, screen, loss, seed, first, n_stars, fractions, scale, unit, sums):  # type: ignore[no-untyped-def]
    """Stacks of a range, a few at a time on each thread; `unit` turns lengths to arcsec."""
    n_batches = (fractions.size + _BATCH - 1) // _BATCH
    for batch in prange(n_batches):
        block = np.zeros(BLOCK_SIZE, np.float32)
        listed, room = np.empty((0, 7)), np.zeros(ROOM)
        for s in range(batch * _BATCH, min((batch + 1) * _BATCH, fractions.size)):
            total = _draw_stack(
                tables,
                member,
                screen,
                loss[s],
                block,
                room,
                seed,
                first + s,
                n_stars,
                fractions[s],
                scale[s],
                sums[s],
                listed,
            )
            norm = 1.0 / total
            for k in range(sums.shape[1]):
                sums[s, k] *= unit[k] * norm
