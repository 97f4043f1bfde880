"""Random numbers of the engine: one counter-based stream per stage of each stack, and what is drawn from it.

Philox 4x32-10 (Salmon et al. 2011) turns a key (the seed) and a counter (draw, stage, stack) into four
32-bit words, so any stack can be drawn alone, in any order, by any worker, with the same numbers.  It passes
TestU01's BigCrush (Salmon et al. 2011, Sect. 6).  All functions here are compiled scalar functions.
"""

from __future__ import annotations

import math

from numba import int32, njit, uint32, uint64

__all__ = [
    "ALONE_STAGE", "COUNT_STAGE", "FRACTION_STAGE", "LOST_STAGE", "PAIR_STAGE", "PHASE_STAGE", "SCREEN_STAGE",
    "SINGLE_STAGE", "TRIPLE_STAGE", "binomial", "halves", "philox", "uniform_pair",
]  # fmt: skip

FRACTION_STAGE, COUNT_STAGE, PAIR_STAGE, SINGLE_STAGE, PHASE_STAGE, LOST_STAGE, ALONE_STAGE, SCREEN_STAGE = (
    range(8)
)
"""Stages of a stack, each with a stream of its own; every layer of a selection has another from the last on."""

TRIPLE_STAGE = 1 << 16
"""First stage of the hierarchies of triples: one for their directions, and two more for each that is tried."""

_LOW = uint64(0xFFFFFFFF)


@njit(inline="always")
def halves(number):  # type: ignore[no-untyped-def]
    """Low and high 32 bits of a number."""
    return uint32(uint64(number) & _LOW), uint32(uint64(number) >> uint64(32))


@njit(inline="always")
def _round(x0, x1, x2, x3, k0, k1):  # type: ignore[no-untyped-def]
    """One round on words in the lower halves of uint64: what is above them is never read."""
    p0 = (x0 & _LOW) * uint64(0xD2511F53)
    p1 = (x2 & _LOW) * uint64(0xCD9E8D57)
    return (p1 >> uint64(32)) ^ x1 ^ uint64(k0), p1, (p0 >> uint64(32)) ^ x3 ^ uint64(k1), p0


@njit(inline="always")
def _two_rounds(x0, x1, x2, x3, k0, k1):  # type: ignore[no-untyped-def]
    """Two rounds, each after the key of the last was raised by the generator's constants."""
    k0, k1 = uint32(k0 + uint32(0x9E3779B9)), uint32(k1 + uint32(0xBB67AE85))
    x0, x1, x2, x3 = _round(x0, x1, x2, x3, k0, k1)
    k0, k1 = uint32(k0 + uint32(0x9E3779B9)), uint32(k1 + uint32(0xBB67AE85))
    x0, x1, x2, x3 = _round(x0, x1, x2, x3, k0, k1)
    return x0, x1, x2, x3, k0, k1


@njit(inline="always")
def philox(key_low, key_high, c0, c1, c2, c3):  # type: ignore[no-untyped-def]
    """Four 32-bit words of Philox 4x32-10 for one key and counter (all uint32)."""
    k0, k1 = uint32(key_low), uint32(key_high)
    x0, x1, x2, x3 = _round(uint64(c0), uint64(c1), uint64(c2), uint64(c3), k0, k1)
    x0, x1, x2, x3, k0, k1 = _two_rounds(x0, x1, x2, x3, k0, k1)  # written out: a loop would not vectorise
    x0, x1, x2, x3, k0, k1 = _two_rounds(x0, x1, x2, x3, k0, k1)
    x0, x1, x2, x3, k0, k1 = _two_rounds(x0, x1, x2, x3, k0, k1)
    x0, x1, x2, x3, k0, k1 = _two_rounds(x0, x1, x2, x3, k0, k1)
    k0, k1 = uint32(k0 + uint32(0x9E3779B9)), uint32(k1 + uint32(0xBB67AE85))
    x0, x1, x2, x3 = _round(x0, x1, x2, x3, k0, k1)
    return uint32(x0), uint32(x1), uint32(x2), uint32(x3)


@njit(inline="always")
def uniform_pair(high, low):  # type: ignore[no-untyped-def]
    """Number in (0, 1), never either end, with 52 random bits from two 32-bit words."""
    bits = (uint64(high) << uint64(20)) | (uint64(low) >> uint64(12))
    return (bits + 0.5) * 2.220446049250313e-16


_FEW = 128
"""Most trials made one by one (count)."""


@njit
def _trials(n, p, key_low, key_high, stage, stack_low, stack_high, draw):  # type: ignore[no-untyped-def]
    """Binomial count for a few trials, and the next free draw number: a trial succeeds where its word is below p."""
    below, count, calls = uint64(p * 4294967296.0), int32(0), int32((n + 3) // 4)
    for call in range(calls):
        words = philox(key_low, key_high, uint32(draw + call), stage, stack_low, stack_high)
        left = int32(n - 4 * call)
        count += int32((left > 0) & (uint64(words[0]) < below)) + int32(
            (left > 1) & (uint64(words[1]) < below)
        )
        count += int32((left > 2) & (uint64(words[2]) < below)) + int32(
            (left > 3) & (uint64(words[3]) < below)
        )
    return int(count), draw + calls


@njit
def binomial(n, p, key_low, key_high, stage, stack_low, stack_high, draw):  # type: ignore[no-untyped-def]
    """Binomial count for n trials of probability p, and the next free draw number of the stream.

    A few trials are made one by one, four to a call of the generator; of many, small means come by inversion, large
    ones by transformed rejection (BTRS, Hoermann 1993).  All are exact to the resolution of the uniforms.
    """
    if n <= _FEW:
        return _trials(n, p, key_low, key_high, stage, stack_low, stack_high, draw)
    flipped = p > 0.5
    p = 1.0 - p if flipped else p
    if n * p < 10.0:
        words = philox(key_low, key_high, draw, stage, stack_low, stack_high)
        draw += 1
        count = _inversion(n, p, uniform_pair(words[0], words[1]))
    else:
        spread = math.sqrt(n * p * (1.0 - p))
        b = 1.15 + 2.53 * spread
        a = -0.0873 + 0.0248 * b + 0.01 * p
        centre = n * p + 0.5
        v_r = 0.92 - 4.2 / b
        count = -1
        while count < 0:
            words = philox(key_low, key_high, draw, stage, stack_low, stack_high)
            draw += 1
            u = uniform_pair(words[0], words[1]) - 0.5
            v = uniform_pair(words[2], words[3])
            us = 0.5 - abs(u)
            k = math.floor((2.0 * a / us + b) * u + centre)
            if k < 0 or k > n:
                continue
            if us >= 0.07 and v <= v_r:
                count = int(k)
            else:
                scaled = math.log(v * (2.83 + 5.1 / b) * spread / (a / (us * us) + b))
                if scaled <= _log_ratio_to_mode(n, p, k):
                    count = int(k)
    return (n - count if flipped else count), draw


@njit
def _inversion(n, p, u):  # type: ignore[no-untyped-def]
    term = (1.0 - p) ** n
    odds = p / (1.0 - p)
    k = 0
    while u > term and k < n:
        u -= term
        k += 1
        term *= odds * (n - k + 1) / k
    return k


@njit
def _log_ratio_to_mode(n, p, k):  # type: ignore[no-untyped-def]
    """Log of the binomial probability of k over that of the mode."""
    mode = math.floor((n + 1) * p)
    return (
        math.lgamma(mode + 1.0)
        + math.lgamma(n - mode + 1.0)
        - math.lgamma(k + 1.0)
        - math.lgamma(n - k + 1.0)
        + (k - mode) * math.log(p / (1.0 - p))
    )
