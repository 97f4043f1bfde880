import numpy as np
import pytest
from numba import njit
from scipy import stats

from porrima.streams import binomial, philox, uniform_pair


@njit
def words(k0, k1, c0, c1, c2, c3):
    return philox(k0, k1, c0, c1, c2, c3)


@njit
def counts(n, p, size):
    out = np.empty(size, np.int64)
    for i in range(size):
        out[i], _ = binomial(n, p, 20261122, 0, 1, i, 0, 0)
    return out


@njit
def many(size):
    out = np.empty((size, 4))
    for i in range(size):
        w = philox(5, 6, i, 2, 3, 4)
        for k in range(4):
            out[i, k] = w[k] * 2.0**-32
    return out


FULL = 0xFFFFFFFF


@pytest.mark.parametrize(
    ("arguments", "expected"),
    [  # the known-answer tests published with Random123 (Salmon et al. 2011)
        ((0, 0, 0, 0, 0, 0), (0x6627E8D5, 0xE169C58D, 0xBC57AC4C, 0x9B00DBD8)),
        ((FULL,) * 6, (0x408F276D, 0x41C83B0E, 0xA20BC7C6, 0x6D5451FD)),
        (
            (0xA4093822, 0x299F31D0, 0x243F6A88, 0x85A308D3, 0x13198A2E, 0x03707344),
            (0xD16CFE09, 0x94FDCCEB, 0x5001E420, 0x24126EA1),
        ),
    ],
)
def test_philox_gives_the_published_answers(arguments, expected):
    assert words(*arguments) == expected


def test_uniforms_never_reach_their_ends():
    assert uniform_pair.py_func(np.uint32(0), np.uint32(0)) > 0
    assert uniform_pair.py_func(np.uint32(FULL), np.uint32(FULL)) < 1


def test_uniforms_are_uniform_and_uncorrelated():
    u = many(250_000)
    for k in range(4):
        assert stats.kstest(u[:, k], "uniform").pvalue > 1e-6
    correlation = np.corrcoef(u.T) - np.eye(4)
    assert np.abs(correlation).max() < 5 / np.sqrt(u.shape[0])


@pytest.mark.parametrize(
    ("n", "p"), [(1, 0.5), (40, 0.1), (40, 0.35), (40, 0.93), (750, 0.35), (10_000, 0.35), (10_000, 0.9995)]
)
def test_binomial_counts_follow_their_law(n, p):
    drawn = counts(n, p, 200_000)
    expected = stats.binom.pmf(np.arange(n + 1), n, p) * drawn.size
    seen = np.bincount(drawn, minlength=n + 1)
    often = expected > 10
    statistic = ((seen - expected)[often] ** 2 / expected[often]).sum()
    rest, rest_expected = seen[~often].sum(), expected[~often].sum()
    statistic += (rest - rest_expected) ** 2 / max(rest_expected, 1.0)
    assert stats.chi2.sf(statistic, often.sum()) > 1e-6


@pytest.mark.parametrize(("p", "expected"), [(0.0, 0), (1.0, 40)])
def test_certain_counts(p, expected):
    assert set(counts(40, p, 100)) == {expected}
