"""The engine on a GPU: one stack to a thread, drawn by the scalar steps that the blocks of a CPU are made of.

The steps of `pairs` are put into the kernel as they stand in the source, so none brings compiler options of its own:
products and sums may fuse, nothing else of IEEE is relaxed.  Streams and order of draws are those of `stack`, so a
stack has the same pairs on both; its moments differ by what rounding makes of fused products and another order of sums.
"""

from __future__ import annotations

import warnings
from typing import TYPE_CHECKING

import numpy as np
from numba import config, cuda, float32, float64, int32, njit, uint32
from numba.core.errors import NumbaPerformanceWarning

from porrima.elementary import bits, normal
from porrima.errors import InputError
from porrima.moments import N_MOMENTS
from porrima.pairs import (
    BASE,
    CUT,
    DIMMING,
    FRACTION,
    MASS,
    MOST_TRIES,
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
    Tables,
    add_moments,
    axis_argument,
    companion_mass,
    direction,
    flux_ratio,
    is_too_many,
    light,
    phase_word,
    place_on_track,
    primary,
    random_words,
    separation,
    single_star,
)
from porrima.streams import COUNT_STAGE, binomial, halves

if TYPE_CHECKING:
    from numpy.typing import NDArray

    FloatArray = NDArray[np.float64]

__all__ = ["fill"]

_THREADS = 128  # of a block
_MOST_STACKS = 2**18  # on the device at once: 100 MB
_PAIRS_IN_FLOAT32 = 128  # sums of more pairs than these go on in float64, as on a CPU

_REGISTERS = 96  # of a thread: the loop over pairs spills none, and five blocks share a multiprocessor

_OPTIONS = {} if config.ENABLE_CUDASIM else {"max_registers": _REGISTERS}  # the simulator has none

_step = njit(inline="always", error_model="numpy")


def fill(
    tables: Tables,
    seed: int,
    first: int,
    n_stars: int,
    fractions: FloatArray,
    scale: FloatArray,
    unit: FloatArray,
    sums: FloatArray,
) -> None:
    """Draw the stacks of a range on the GPU.

    Parameters
    ----------
    tables : Tables
        The population.
    seed, first, n_stars : int
        Of the run, the number of the first stack, and stars in each stack (count).
    fractions, scale : (n_stack,) float array
        Binary fraction of each stack, in [0, 1], and the factor of its multiplicity fractions.
    unit : (n_moment,) float array
        Unit of each moment, in arcsec^(a+b).
    sums : (n_stack, n_moment) float array
        Becomes the mean moments of each stack, in arcsec^(a+b); NaN where all pairs are resolved.

    Returns
    -------
    nothing : None
        The result is in `sums`.

    Raises
    ------
    InputError
        If there is no GPU to use.

    Notes
    -----
    Stacks with like numbers of pairs go together, since the threads of a warp wait for the slowest.
    """
    if not cuda.is_available():
        raise InputError(
            "no CUDA device found: it takes an NVIDIA GPU, its driver and the CUDA toolkit", key="device"
        )
    on_device, stacks = _on_device(tables), first + np.arange(fractions.size)
    order = np.argsort(-fractions, kind="stable")
    for start in range(0, order.size, _MOST_STACKS):
        part = order[start : start + _MOST_STACKS]
        drawn = cuda.device_array((N_MOMENTS + 1, part.size))
        columns = (cuda.to_device(column[part]) for column in (stacks, fractions, scale))
        with warnings.catch_warnings():  # few stacks are no mistake
            warnings.simplefilter("ignore", NumbaPerformanceWarning)
            _kernel[-(-part.size // _THREADS), _THREADS](on_device, np.uint64(seed), n_stars, *columns, drawn)
        *moments, weight = drawn.copy_to_host()
        sums[part] = np.transpose(moments / weight) * unit


def _on_device(tables: Tables) -> Tables:
    """The same tables in the memory of the GPU."""
    arrays = {name: part for name, part in tables._asdict().items() if isinstance(part, np.ndarray)}
    return tables._replace(**{name: cuda.to_device(part) for name, part in arrays.items()})


@cuda.jit(cache=True, **_OPTIONS)
def _kernel(tables, seed, n_stars, stacks, fractions, scale, drawn):  # type: ignore[no-untyped-def]
    """Sums of the moments of each stack, and in the last row that of the weights: NaN where it cannot be filled.

    As in `stack`, but all pairs of one binomial draw before the next, so that the threads of a warp stay together.
    """
    sums = cuda.local.array(N_MOMENTS, float32)
    key_low, key_high = halves(seed)
    for s in range(cuda.grid(1), stacks.size, cuda.gridsize(1)):
        low, high = halves(stacks[s])
        places, draw, pair, kept, in_sums, total = n_stars, 0, 0, 0, 0, 0.0
        for k in range(N_MOMENTS):
            sums[k], drawn[k, s] = 0.0, 0.0
        while places > 0:
            wanted, draw = binomial(places, fractions[s], key_low, key_high, COUNT_STAGE, low, high, draw)
            places = 0  # those that resolved pairs leave
            while wanted > 0:
                before, missing = pair, wanted
                pair, wanted, n_kept, weight = _draw_pairs(
                    tables, scale[s], key_low, key_high, low, high, pair, wanted, sums
                )
                places += missing - wanted - n_kept
                kept, total, in_sums = kept + n_kept, total + weight, in_sums + pair - before
                if in_sums >= _PAIRS_IN_FLOAT32:
                    in_sums = 0
                    for k in range(N_MOMENTS):
                        drawn[k, s] += sums[k]
                        sums[k] = 0.0
                if pair > MOST_TRIES * (n_stars + 100):
                    places, wanted, total = 0, 0, np.nan
        for k in range(N_MOMENTS):
            drawn[k, s] += sums[k]
        drawn[N_MOMENTS, s] = total + _weigh_singles(
            tables, scale[s], key_low, key_high, low, high, n_stars, kept
        )


@_step
def _draw_pairs(tables, scale, key_low, key_high, low, high, pair, wanted, sums):  # type: ignore[no-untyped-def]
    """Add the moments of so many pairs as are wanted, or `_PAIRS_IN_FLOAT32` of them.

    The number of the next pair, how many are wanted still, how many were kept and the weight of these.
    """
    end, kept, total = pair + _PAIRS_IN_FLOAT32, 0, 0.0
    while wanted > 0 and pair < end:
        star, f, x, y, is_valid, is_kept = _draw_pair(
            tables, scale, key_low, key_high, low, high, uint32(pair)
        )
        weight = float32(is_kept)
        if tables.weight.size > 0:
            weight *= tables.weight[star]
            total += weight
        add_moments(sums, 0, 1, weight, f, x, y)
        pair, wanted, kept = pair + 1, wanted - int32(is_valid), kept + int32(is_kept)
    return pair, wanted, kept, total


@_step
def _weigh_singles(tables, scale, key_low, key_high, low, high, n_stars, kept):  # type: ignore[no-untyped-def]
    """Total weight of the single stars of a stack, or of all its stars where they count alike."""
    if tables.weight.size == 0:
        return float64(n_stars)
    total, draw = 0.0, 0
    for _ in range(kept, n_stars):
        star, draw = single_star(tables, scale, key_low, key_high, low, high, draw)
        total += tables.weight[star]
    return total


@_step
def _draw_pair(tables, scale, key_low, key_high, low, high, pair):  # type: ignore[no-untyped-def]
    """Number of the star, flux ratio and offset of one pair; whether its star may have one, and whether it is kept."""
    words = random_words(key_low, key_high, low, high, pair)
    star = primary(words[0], tables.alias)
    deviate = normal(axis_argument(words[2], tables.star[star, TRUNCATION]))
    phase = uint32(0) if tables.isotropic else phase_word(key_low, key_high, low, high, pair)
    log_a = tables.star[star, A] + tables.star[star, SIGMA] * deviate
    r = separation(tables.isotropic, log_a, words[3], phase)
    cosine, sine = direction(words[3])
    mass = companion_mass(
        words[1],
        tables.star[star, MASS],
        tables.star[star, Q_SLOPE],
        tables.star[star, Q_START],
        tables.star[star, Q_FLAT],
    )
    k, t = place_on_track(mass, tables.grid_start, tables.grid_per_unit, tables.n_grid)
    row = bits(tables.star[star, BASE]) + k
    left, right = _light(tables, star, row, 0), _light(tables, star, row, 4)
    f = flux_ratio(left, right, t, mass < tables.log_dark)
    is_capped = scale * tables.largest_fraction > 1.0
    is_valid = not (is_capped and is_too_many(words[1], words[2], scale, tables.star[star, FRACTION]))
    return star, f, r * cosine, r * sine, is_valid, is_valid and r < float32(CUT)


@_step
def _light(tables, star, row, column):  # type: ignore[no-untyped-def]
    """Light on the tracks of a star, from four columns of a row."""
    own, track = tables.star, tables.track
    return light(
        own[star, W0], own[star, W1], own[star, W2], own[star, W3],
        track[row, column], track[row, column + 1], track[row, column + 2], track[row, column + 3],
        own[star, DIMMING],
    )  # fmt: skip
