"""Elementary functions of the engine against numpy and scipy in float64, over all that can go in."""

import numpy as np
import pytest
from numba import njit
from scipy.special import ndtri

from porrima.elementary import centred, exp2, log2, normal, sine_cosine, unit

ENDS = np.array([0, 1, 255, 256, 511, 512, 2**31 - 1, 2**31, 2**32 - 2, 2**32 - 1], dtype=np.uint32)


@njit
def apply(words, x, out):
    for k in range(words.size):
        out[0, k] = unit(words[k])
        out[1, k] = centred(words[k])
        out[2, k] = log2(out[0, k])
        out[3, k] = exp2(x[k])
        out[4, k], out[5, k] = sine_cosine(out[0, k] - np.float32(0.5))
        out[6, k] = normal(out[1, k])


@pytest.fixture(scope="module")
def values():
    rng = np.random.Generator(np.random.Philox(1))
    words = np.concatenate([ENDS, rng.integers(0, 2**32, 500_000, dtype=np.uint32)])
    x = np.linspace(-126, 127, words.size).astype(np.float32)
    out = np.empty((7, words.size), np.float32)
    apply(words, x, out)
    return words, x.astype(float), out.astype(float)


def test_uniforms_never_reach_their_ends(values):
    words, _, (u, c, *_) = values
    assert 0 < u.min() < u.max() < 1
    assert -1 < c.min() < c.max() < 1
    np.testing.assert_allclose(u, (words + 0.5) / 2**32, atol=2**-23)
    np.testing.assert_allclose(c, (words.astype(np.int32) + 0.5) / 2**31, atol=2**-23)


def test_logarithm(values):
    u, logarithm = values[2][0], values[2][2]
    assert np.abs(logarithm - np.log2(u)).max() < 1e-6


def test_power(values):
    assert np.abs(values[2][3] / 2.0 ** values[1] - 1).max() < 2e-7


def test_sine_and_cosine(values):
    t = values[2][0] - 0.5
    assert np.abs(values[2][4] - np.sin(np.pi * t)).max() < 3e-7
    assert np.abs(values[2][5] - np.cos(np.pi * t)).max() < 3e-7


def test_normal_deviate(values):
    c, deviate = values[2][1], values[2][6]
    expected = np.where(c < 0, ndtri(0.5 * (1 + c)), -ndtri(0.5 * (1 - c)))
    assert np.abs(deviate / expected - 1).max() < 1e-6


def test_powers_below_the_smallest_float_are_the_smallest(values):
    out = np.empty((7, 1), np.float32)
    apply(np.zeros(1, np.uint32), np.full(1, -1000, np.float32), out)
    assert out[3, 0] == np.float32(2.0**-126)
