"""What is kept between two nodes of separation, against integrals taken in numpy."""

import itertools

import numpy as np
import pytest
from scipy.integrate import quad
from scipy.special import ndtr

from porrima.kept import cell_moments, coarse_nodes, kept_cells, row_of_scores


def kept(normal, scores, mean, lean):
    kept_cells(normal, np.asarray(scores), mean, lean)
    return mean, lean


def moments_of(function):
    """Mean over s from 0 to 1 and the first moment about the middle."""
    mean = quad(function, 0, 1, epsabs=1e-12, limit=200)[0]
    return mean, quad(lambda s: function(s) * (s - 0.5), 0, 1, epsabs=1e-12, limit=200)[0]


@pytest.mark.parametrize(
    ("z0", "z1"),
    [(-1.0, 2.0), (2.0, -0.5), (0.3, 0.33), (-0.2, -0.11), (-5.0, 5.0), (1.0, 1.0), (-9.0, -8.5)],
)
def test_what_a_normal_law_keeps_of_a_cell_is_its_integral(z0, z1):
    mean, lean = kept(True, [z0, z1], np.ones(1), np.zeros(1))
    expected = moments_of(lambda s: 1 - ndtr(z0 + (z1 - z0) * s))
    assert (mean[0], lean[0]) == pytest.approx(expected, abs=1e-6)


def test_an_edge_without_width_splits_a_cell_where_it_lies():
    mean, lean = kept(True, [-3e6, 1e6], np.ones(1), np.zeros(1))
    assert mean[0] == pytest.approx(0.75, abs=1e-6)
    assert lean[0] == pytest.approx(0.75**2 / 2 - 0.75 / 2, abs=1e-6)


def test_a_probability_is_kept_as_it_stands():
    mean, lean = kept(False, [0.2, 0.6], np.ones(1), np.zeros(1))
    assert (mean[0], lean[0]) == pytest.approx(moments_of(lambda s: 1 - 0.2 - 0.4 * s), abs=1e-12)


def test_layers_that_keep_all_or_nothing_leave_what_was_kept_before():
    mean, lean = kept(True, [-20.0, -20.0, 20.0, 20.0], np.full(3, 0.4), np.full(3, 0.01))
    assert mean[[0, 2]] == pytest.approx([0.4, 0.0])
    assert lean[[0, 2]] == pytest.approx([0.01, 0.0])


def test_moments_between_nodes_are_those_of_the_law():
    """A separation squared that is even from 0 to 1: E[v^k; v < t] = t^(k+1)/(k+1)."""
    square = np.array([0.0, 0.2, 0.5, 1.0])
    power = np.arange(4)
    below = square[1:, None] ** (power + 1) / (power + 1) / square[1:, None] ** power
    content, lean = cell_moments(below[None], square)[0]
    for c, (low, high) in enumerate(itertools.pairwise(square)):
        for k in power[:-1]:
            v = np.polynomial.legendre.leggauss(8)[0] * (high - low) / 2 + (high + low) / 2
            w = np.polynomial.legendre.leggauss(8)[1] * (high - low) / 2
            assert content[c, k] == pytest.approx(w @ v**k, rel=1e-12)
            assert lean[c, k] == pytest.approx(12 * w @ (v**k * ((v - low) / (high - low) - 0.5)), abs=1e-12)


def test_scores_are_linear_between_flux_ratios_and_go_on_beyond():
    score, row = np.array([[0.0, 4.0], [1.0, 2.0], [3.0, 0.0]]), np.empty(2)
    for value, expected in ((0.0, [0.0, 4.0]), (0.05, [0.5, 3.0]), (0.55, [2.0, 1.0]), (1.0, [3.0, 0.0])):
        row_of_scores(score, np.array([0.0, 0.1, 1.0]), value, row)
        assert row == pytest.approx(expected)


def test_the_coarser_rule_keeps_both_ends():
    for n in (4, 10, 102):
        node = coarse_nodes(n)
        assert node[0] == 0
        assert node[-1] == n - 1
        assert np.all(np.diff(node[1:]) == 2)
