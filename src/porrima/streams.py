"""Random numbers of the engine: one counter-based stream per stage of each stack, and what is drawn from it.

Philox 4x32-10 (Salmon et al. 2011) turns a key (the seed) and a counter (draw, stage, stack) into four
32-bit words, so any stack can be drawn alone, in any order, by any worker, with the same numbers.  It passes
TestU01's BigCrush (Salmon et al. 2011, Sect. 6).  All functions here are compiled scalar functions.
"""

from __future__ import annotations

import math

from numba import njit, uint32, uint64

__all__ = ["binomial", "inverse_normal", "philox", "uniform", "uniform_pair"]


@njit(inline="always")
def philox(key_low, key_high, c0, c1, c2, c3):  # type: ignore[no-untyped-def]
    """Four 32-bit words of Philox 4x32-10 for one key and counter (all uint32)."""
    k0, k1 = uint32(key_low), uint32(key_high)
    x0, x1, x2, x3 = uint32(c0), uint32(c1), uint32(c2), uint32(c3)
    for _ in range(10):
        p0 = uint64(0xD2511F53) * uint64(x0)
        p1 = uint64(0xCD9E8D57) * uint64(x2)
        x0, x1, x2, x3 = (
            uint32(uint32(p1 >> uint64(32)) ^ x1 ^ k0),
            uint32(p1),
            uint32(uint32(p0 >> uint64(32)) ^ x3 ^ k1),
            uint32(p0),
        )
        k0 = uint32(k0 + uint32(0x9E3779B9))
        k1 = uint32(k1 + uint32(0xBB67AE85))
    return x0, x1, x2, x3


@njit(inline="always")
def uniform(word):  # type: ignore[no-untyped-def]
    """Number in (0, 1), never either end, from one 32-bit word."""
    return (word + 0.5) * 2.3283064365386963e-10


@njit(inline="always")
def uniform_pair(high, low):  # type: ignore[no-untyped-def]
    """Number in (0, 1), never either end, with 52 random bits from two 32-bit words."""
    bits = (uint64(high) << uint64(20)) | (uint64(low) >> uint64(12))
    return (bits + 0.5) * 2.220446049250313e-16


@njit(inline="always")
def inverse_normal(p):  # type: ignore[no-untyped-def]
    """Standard normal deviate with cumulative probability p in (0, 1): AS 241, PPND16 (Wichura 1988)."""
    q = p - 0.5
    if abs(q) <= 0.425:
        r = 0.180625 - q * q
        # fmt: off
        a = (((((((2509.0809287301226727 * r + 33430.575583588128105) * r + 67265.770927008700853) * r
            + 45921.953931549871457) * r + 13731.693765509461125) * r + 1971.5909503065514427) * r
            + 133.14166789178437745) * r + 3.387132872796366608)
        b = (((((((5226.495278852545925 * r + 28729.085735721942674) * r + 39307.89580009271061) * r
            + 21213.794301586595867) * r + 5394.1960214247511077) * r + 687.1870074920579083) * r
            + 42.313330701600911252) * r + 1.0)
        # fmt: on
        return q * a / b
    tail = p if q < 0 else 1.0 - p
    r = math.sqrt(-math.log(tail))
    # fmt: off
    if r <= 5.0:
        r -= 1.6
        a = (((((((7.7454501427834140764e-4 * r + 0.0227238449892691845833) * r + 0.24178072517745061177) * r
            + 1.27045825245236838258) * r + 3.64784832476320460504) * r + 5.7694972214606914055) * r
            + 4.6303378461565452959) * r + 1.42343711074968357734)
        b = (((((((1.05075007164441684324e-9 * r + 5.475938084995344946e-4) * r + 0.0151986665636164571966) * r
            + 0.14810397642748007459) * r + 0.68976733498510000455) * r + 1.6763848301838038494) * r
            + 2.05319162663775882187) * r + 1.0)
    else:
        r -= 5.0
        a = (((((((2.01033439929228813265e-7 * r + 2.71155556874348757815e-5) * r
            + 0.0012426609473880784386) * r + 0.026532189526576123093) * r + 0.29656057182850489123) * r
            + 1.7848265399172913358) * r + 5.4637849111641143699) * r + 6.6579046435011037772)
        b = (((((((2.04426310338993978564e-15 * r + 1.4215117583164458887e-7) * r
            + 1.8463183175100546818e-5) * r + 7.868691311456132591e-4) * r + 0.0148753612908506148525) * r
            + 0.13692988092273580531) * r + 0.59983220655588793769) * r + 1.0)
    # fmt: on
    return -a / b if q < 0 else a / b


@njit
def binomial(n, p, key_low, key_high, stage, stack_low, stack_high, draw):  # type: ignore[no-untyped-def]
    """Binomial count for n trials of probability p, and the next free draw number of the stream.

    Small means by inversion, large ones by transformed rejection (BTRS, Hoermann 1993); both exact to the
    resolution of the uniforms.
    """
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
