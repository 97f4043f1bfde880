import numpy as np
import pytest

from porrima.moments import (
    INDICES,
    N_MOMENTS,
    ORDER,
    KernelMoments,
    angular_mean,
    moments_of_points,
    pair_coefficient,
)
from porrima.systems import Systems


def test_indices_run_through_all_orders_from_two():
    assert len(INDICES) == N_MOMENTS == sum(n + 1 for n in range(2, ORDER + 1))
    assert INDICES[:5] == ((2, 0), (1, 1), (0, 2), (3, 0), (2, 1))


def test_coefficients_are_the_closed_forms():
    f = np.linspace(0, 1, 11)
    np.testing.assert_allclose(pair_coefficient(f, 2), f / (1 + f) ** 2, atol=1e-15)
    np.testing.assert_allclose(pair_coefficient(f, 3), f * (1 - f) / (1 + f) ** 3, atol=1e-15)
    np.testing.assert_allclose(pair_coefficient(f, 4), f * (1 - f + f**2) / (1 + f) ** 4, atol=1e-15)
    np.testing.assert_array_equal(pair_coefficient(f, 1), 0.0)


def test_moments_of_a_pair_are_coefficient_times_powers():
    rng = np.random.Generator(np.random.Philox(1))
    f, dx, dy = rng.random(50), rng.normal(0, 0.03, 50), rng.normal(0, 0.03, 50)
    systems = Systems.from_pairs(f, dx, dy)
    moments = moments_of_points(systems.flux, systems.x, systems.y)
    for k, (a, b) in enumerate(INDICES):
        np.testing.assert_allclose(moments[:, k], pair_coefficient(f, a + b) * dx**a * dy**b, atol=1e-16)


def test_angular_means_against_a_ring():
    theta = 2 * np.pi * np.arange(64) / 64
    for a in range(9):
        for b in range(9):
            assert angular_mean(a, b) == pytest.approx(
                np.mean(np.cos(theta) ** a * np.sin(theta) ** b), abs=1e-15
            )


def test_a_wrong_axis_is_refused():
    with pytest.raises(ValueError, match=r"values must have shape \(n_stack, 42\), got \(3, 5\)"):
        KernelMoments(values=np.zeros((3, 5)), n_stars=1)
