"""Elementary functions in float32 for the engine: compiled, without branches, so that loops over them vectorise.

Polynomials were fitted on Chebyshev nodes.  Their largest errors are stated with each function and held by a
test; they are near the rounding of float32 and the resolution of the uniform numbers that go in.
"""

from __future__ import annotations

import math

import numpy as np
from llvmlite import ir
from numba import float32, int32, njit, types, uint32
from numba.extending import intrinsic

__all__ = [
    "TAIL", "bits", "centred", "exp2", "floor", "from_bits", "larger", "log2", "normal", "normal_argument",
    "normal_centre", "normal_tail", "sine_cosine", "smaller", "unit",
]  # fmt: skip

TAIL = 5.0
"""Argument from which a normal deviate is in the tail: beyond 2.93 on either side, one of three hundred."""

_CONTRACT = {"contract"}  # a product and a sum may fuse; nothing else of IEEE is relaxed


@intrinsic
def bits(_context, _x):  # type: ignore[no-untyped-def]
    """Bits of a float32 as an int32."""
    return types.int32(types.float32), lambda _c, builder, _s, a: builder.bitcast(a[0], ir.IntType(32))


@intrinsic
def from_bits(_context, _x):  # type: ignore[no-untyped-def]
    """Float32 with the bits of an int32."""
    return types.float32(types.int32), lambda _c, builder, _s, a: builder.bitcast(a[0], ir.FloatType())


@intrinsic
def floor(_context, _x):  # type: ignore[no-untyped-def]
    """Largest whole number not above a float32, itself a float32."""

    def code(_context, builder, _signature, arguments):  # type: ignore[no-untyped-def]
        function = builder.module.declare_intrinsic("llvm.floor", [ir.FloatType()])
        return builder.call(function, arguments)

    return types.float32(types.float32), code


@njit(inline="always")
def larger(a, b):  # type: ignore[no-untyped-def]
    """The larger of two numbers (the built-in function is not compiled for every GPU target)."""
    return b if b > a else a


@njit(inline="always")
def smaller(a, b):  # type: ignore[no-untyped-def]
    """The smaller of two numbers."""
    return b if b < a else a


def _polynomial(*coefficients: float):  # type: ignore[no-untyped-def]
    """Compiled polynomial in float32 with the given coefficients, from the constant up."""
    c = tuple(np.float32(value) for value in coefficients)
    if len(c) == 9:

        def value(x):  # type: ignore[no-untyped-def]
            return (
                (((((((c[8] * x + c[7]) * x + c[6]) * x + c[5]) * x + c[4]) * x + c[3]) * x + c[2]) * x)
                + c[1]
            ) * x + c[0]

    elif len(c) == 7:

        def value(x):  # type: ignore[no-untyped-def]
            return (((((c[6] * x + c[5]) * x + c[4]) * x + c[3]) * x + c[2]) * x + c[1]) * x + c[0]

    else:

        def value(x):  # type: ignore[no-untyped-def]
            return (((c[4] * x + c[3]) * x + c[2]) * x + c[1]) * x + c[0]

    return njit(inline="always", fastmath=_CONTRACT)(value)


_log2_over_z = _polynomial(
    1.442695,
    -0.721347333,
    0.48091061,
    -0.360704828,
    0.287918324,
    -0.23892034,
    0.215669859,
    -0.207421035,
    0.126148466,
)  # log2(1 + z)/z for 1 + z from 1/sqrt(2) to sqrt(2)
_exp2_near_0 = _polynomial(
    1, 0.693147207, 0.240226512, 0.0555032721, 0.0096180256, 0.00134004322, 0.00015469732
)
_sine = _polynomial(3.14159264, -5.16771008, 2.55007752, -0.598291286, 0.0776576603)  # sin(pi t)/t in t²
_cosine = _polynomial(0.999999953, -4.93479283, 4.05841135, -1.33187657, 0.219689611)  # cos(pi t) in t²
_erfinv_centre = _polynomial(
    1.50140941, 0.246640727, -0.00417768164, -0.00125372503, 0.00021858087, -4.39150654e-06, -3.5233877e-06,
    3.43273939e-07, 2.81022636e-08,
)  # fmt: skip
_erfinv_tail = _polynomial(
    2.83297682, 1.00167406, 0.00943887047, -0.0076224613, 0.00573950773, -0.00367342844, 0.00134934322,
    0.000100950558, -0.000200214257,
)  # fmt: skip


@njit(inline="always", fastmath=_CONTRACT)
def log2(x):  # type: ignore[no-untyped-def]
    """Binary logarithm of a positive normal float32; absolute error below 1e-6 for x in (2^-24, 2)."""
    word = bits(x)
    exponent = int32((word - int32(0x3F3504F3)) >> int32(23))
    z = from_bits(int32(word - (exponent << int32(23)))) - float32(1)
    return float32(exponent) + z * _log2_over_z(z)


@njit(inline="always", fastmath=_CONTRACT)
def exp2(x):  # type: ignore[no-untyped-def]
    """Two to the power of a float32 up to 127, at least 2^-126; relative error below 2e-7 where x is exact."""
    x = larger(x, float32(-126.0))
    whole = floor(x + float32(0.5))
    return _exp2_near_0(x - whole) * from_bits(int32((int32(whole) + int32(127)) << int32(23)))


@njit(inline="always", fastmath=_CONTRACT)
def sine_cosine(t):  # type: ignore[no-untyped-def]
    """Sine and cosine of pi t for a float32 t in [-1/2, 1/2]; absolute error below 3e-7."""
    square = t * t
    return t * _sine(square), _cosine(square)


@njit(inline="always", fastmath=_CONTRACT)
def normal_argument(x):  # type: ignore[no-untyped-def]
    """-ln(1 - x^2), which the normal deviate of x is a function of; from `TAIL` on it is in the tail."""
    return float32(-0.6931471805599453) * log2((float32(1) - x) * (float32(1) + x))


@njit(inline="always", fastmath=_CONTRACT)
def normal_centre(x, w):  # type: ignore[no-untyped-def]
    """Standard normal deviate with cumulative probability (1 + x)/2 and w = `normal_argument` below `TAIL`."""
    return float32(1.4142135623730951) * x * _erfinv_centre(w - float32(2.5))


@njit(inline="always", fastmath=_CONTRACT)
def normal_tail(x, w):  # type: ignore[no-untyped-def]
    """The same for w from `TAIL` on."""
    return float32(1.4142135623730951) * x * _erfinv_tail(math.sqrt(w) - float32(3))


@njit(inline="always", fastmath=_CONTRACT)
def normal(x):  # type: ignore[no-untyped-def]
    """Standard normal deviate with cumulative probability (1 + x)/2, x a float32 in (-1, 1).

    The inverse error function of Giles (2010), single precision: relative error below 1e-6 where x itself is exact.
    """
    w = normal_argument(x)
    return normal_centre(x, w) if w < float32(TAIL) else normal_tail(x, w)


@njit(inline="always")
def unit(word):  # type: ignore[no-untyped-def]
    """Float32 in (0, 1), never either end, from the upper 23 bits of a 32-bit word."""
    return (float32(int32(word >> uint32(9))) + float32(0.5)) * float32(2.0**-23)


@njit(inline="always")
def centred(word):  # type: ignore[no-untyped-def]
    """Float32 in (-1, 1), never either end nor 0, from the upper 24 bits of a 32-bit word."""
    return (float32(int32(int32(word) >> int32(8))) + float32(0.5)) * float32(2.0**-23)
