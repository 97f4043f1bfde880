import numpy as np
import pytest

from porrima.moments import INDICES, KernelMoments, angular_mean
from porrima.psf import psf_from_name
from porrima.response import response
from porrima.shapes import estimator_from_name
from porrima.singles import ANGLES, added_to_shape, node_weights, pair_moments
from porrima.systems import Systems


def powers_of(four_y, square):
    """Powers of stars that are all the same pair, (1, 9, 9)."""
    return (four_y ** np.arange(9.0))[None, :, None] * (square ** np.arange(9.0))


@pytest.mark.parametrize(("four_y", "square"), [(1.0, 1.0), (0.3, 0.7), (0.02, 0.9), (0.9, 0.01)])
def test_one_pair_is_its_own_average(four_y, square):
    """All stars the same pair: the average over the nodes is that pair's own, turned to every side.

    To 1e-4, the error of the second order by which small changes are measured.
    """
    cut = 0.05
    for psf in ("psf1", "optical1"):
        reply = response(psf_from_name(psf), estimator_from_name("adaptive"))
        added = added_to_shape(reply, cut, 1)
        angle = 2 * np.pi * (np.arange(360) + 0.5) / 360
        kernel = pair_moments(np.full(360, four_y), np.full(360, cut * np.sqrt(square)), angle)
        shape, zero = reply.shapes(KernelMoments(values=kernel, n_stars=1)), reply.shape0
        size = shape.r2 / zero.r2 - 1
        change = np.stack([shape.e1 - zero.e1, shape.e2 - zero.e2, size, np.log1p(size)])
        weight = node_weights(powers_of(four_y, square))[0]
        np.testing.assert_allclose(weight @ added.mean, change.mean(axis=1), rtol=2e-4, atol=1e-9)
        square_mean = np.einsum("n,nab->ab", weight, added.product)
        np.testing.assert_allclose(square_mean, change @ change.T / 360, rtol=4e-4, atol=1e-9)


def test_weights_are_exact_for_polynomials():
    rng = np.random.Generator(np.random.Philox(3))
    y, v = rng.random((2, 50))
    powers = np.einsum("nj,nk->jk", y[:, None] ** np.arange(9), v[:, None] ** np.arange(9))[None] / 50
    node = np.sin(0.5 * np.pi * np.arange(1, 9) / 8) ** 2
    for j, k in ((1, 1), (3, 2), (8, 8)):
        at_nodes = np.multiply.outer(node**j, node**k).ravel()
        assert node_weights(powers)[0] @ at_nodes == pytest.approx(np.mean(y**j * v**k), rel=1e-8)


def test_pair_moments_are_those_of_two_points():
    f, r, angle = 0.37, 0.031, 0.8
    pair = Systems.from_pairs(np.array([f]), np.array([r * np.cos(angle)]), np.array([r * np.sin(angle)]))
    found = pair_moments(np.array([4 * f / (1 + f) ** 2]), np.array([r]), np.array([angle]))
    np.testing.assert_allclose(found, pair.kernel_moments().values, rtol=1e-12)


def test_angles_average_products_of_the_highest_moments():
    angle = 2 * np.pi * (np.arange(ANGLES) + 0.5) / ANGLES
    for a, b in INDICES:
        for c, d in INDICES:
            mean = np.mean(np.cos(angle) ** (a + c) * np.sin(angle) ** (b + d))
            assert mean == pytest.approx(angular_mean(a + c, b + d), abs=1e-15)
