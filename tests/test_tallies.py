from itertools import pairwise

import numpy as np
import pytest

from porrima import prediction
from porrima.tallies import FINE, QUANTITIES, STATISTICS, Tally, changes, fine_bins, merged, tally

N_PSF = 2
TAILS = {  # laws of a change
    "normal": lambda rng, size: 3.0 + rng.normal(size=size),
    "Student, 3 degrees": lambda rng, size: 1e-3 * rng.standard_t(3, size=size),
    "squares of Pareto": lambda rng, size: 1e-4 * rng.pareto(1.5, size=size) ** 2,
}


def sample(law, n=5000):
    rng = np.random.Generator(np.random.Philox(11))
    return rng.uniform(size=n), TAILS[law](rng, (N_PSF, 3, n))


def parts(fraction, change, lengths, bins=FINE):
    edges = np.cumsum([0, *lengths])
    pieces = [tally(fraction[a:b], change[:, :, a:b], bins).to_array() for a, b in pairwise(edges)]
    assert edges[-1] == fraction.size
    return Tally.from_array(np.stack(pieces))


def in_plain_numpy(fraction, change, bins):
    """Each range on its own, in extended precision."""
    out = np.zeros((N_PSF, 3, len(STATISTICS), bins))
    for k in range(bins):
        here = (fraction >= k / bins) & ((fraction < (k + 1) / bins) | (k == bins - 1))
        for p, q in np.ndindex(N_PSF, 3):
            x = change[p, q, here].astype(np.longdouble)
            measured = np.isfinite(x)
            f = fraction[here][measured].astype(np.longdouble)
            x = x[measured]
            out[p, q, :2, k] = here.sum(), x.size
            if x.size:
                d = x - x.mean()
                out[p, q, 2:, k] = x.mean(), *((d**n).sum() for n in (2, 3, 4)), f.mean(), f.var() * f.size
    return out


def assert_same(found, expected):
    """To 1e-12 of each sum; of third powers, which cancel, of the size that their terms have."""
    scale = np.abs(expected)
    scale[:, :, 4] = np.sqrt(expected[:, :, 3] * expected[:, :, 5])
    assert np.all(np.abs(found.to_array() - expected) <= 1e-12 * scale + 1e-300)


@pytest.mark.parametrize("law", TAILS)
@pytest.mark.parametrize("bins", [1, 7])
def test_parts_together_are_plain_numpy_on_all_stacks(law, bins):
    fraction, change = sample(law)
    found = merged(parts(fraction, change, [1, 999, 0, 2500, 1500], bins))
    assert_same(found, in_plain_numpy(fraction, change, bins))


def test_a_small_scatter_about_a_large_mean_is_not_lost():
    """Raw sums of fourth powers would lose 24 digits here; the mean itself is known to 1e-10 of the scatter."""
    fraction, _ = sample("normal")
    change = 1.0 + 1e-6 * np.random.Generator(np.random.Philox(12)).exponential(size=(N_PSF, 3, 5000))
    found = merged(parts(fraction, change, [2000, 3000], 1)).to_array()
    np.testing.assert_allclose(found, in_plain_numpy(fraction, change, 1), rtol=1e-9)


@pytest.mark.parametrize("law", TAILS)
@pytest.mark.parametrize("bins", [1, 10, 20, 100])
def test_fine_ranges_make_the_wider_ones(law, bins):
    fraction, change = sample(law)
    fraction[:4] = 0.35, 0.3, 0.0, 1.0  # edges
    assert_same(
        merged(parts(fraction, change, [1000] * 5)).rebinned(bins), in_plain_numpy(fraction, change, bins)
    )


def test_what_was_not_measured_is_counted_and_left_out():
    fraction, change = sample("normal")
    change[0, :, 10:40] = np.nan
    change[1, 2, :5] = np.inf
    found = merged(parts(fraction, change, [25, 4975], bins=1))
    assert found.n_stacks.ravel().tolist() == [5000.0] * 6
    assert found.count[:, :, 0].tolist() == [[4970.0] * 3, [5000.0, 5000.0, 4995.0]]
    assert_same(found, in_plain_numpy(fraction, change, 1))


def test_a_tally_of_nothing_changes_nothing():
    fraction, change = sample("normal", 10)
    alone = tally(fraction, change)
    np.testing.assert_array_equal(merged(parts(fraction, change, [10, 0])).to_array(), alone.to_array())


def test_an_array_keeps_a_tally():
    fraction, change = sample("normal", 100)
    one = tally(fraction, change)
    assert one.to_array().shape == (N_PSF, 3, len(STATISTICS), FINE)
    for name in STATISTICS:
        np.testing.assert_array_equal(getattr(Tally.from_array(one.to_array()), name), getattr(one, name))


def test_ranges_to_count_in_are_a_multiple_of_those_asked_for():
    usual = (1, 2, 4, 5, 10, 20, 25, 30, 50, 60, 75, 100, 150, 300)
    assert {fine_bins(bins) for bins in usual} == {FINE}
    assert (fine_bins(7), fine_bins(301), fine_bins(1000)) == (301, 301, 1000)
    for bins in range(1, 400):
        assert fine_bins(bins) % bins == 0


def test_changes_are_against_the_psf_and_of_the_size_relative():
    shapes = np.array([[[0.1, 0.2]], [[0.0, -0.1]], [[2.0, 3.0]]])
    found = changes(shapes, np.array([[0.1], [0.1], [2.0]]))
    np.testing.assert_allclose(found, [[[0, 0.1], [-0.1, -0.2], [0, 0.5]]])


def test_quantities_are_those_of_the_prediction():
    assert QUANTITIES == prediction.QUANTITIES
