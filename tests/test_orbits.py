import numpy as np
import pytest
from numba import njit

from porrima.orbits import projection_factor, projection_nodes
from statistics_helpers import assert_within_sigma


@njit
def factor_of(isotropic, u, v):
    return projection_factor(isotropic, u, v)


MEAN_SQUARE = {"isotropic": 2 / 3, "inclination-uniform": 3 / 4}
MEAN_FOURTH = {"isotropic": 8 / 15, "inclination-uniform": 1 - 2 / 4 + 9 / 64}


@pytest.mark.parametrize("projection", MEAN_SQUARE)
def test_quadrature_over_orientations_is_exact_for_powers(projection):
    factor, weight = projection_nodes(projection)
    assert weight.sum() == pytest.approx(1)
    assert np.all((factor > 0) & (factor <= 1))
    assert factor**2 @ weight == pytest.approx(MEAN_SQUARE[projection], rel=1e-14)
    assert factor**4 @ weight == pytest.approx(MEAN_FOURTH[projection], rel=1e-14)


@pytest.mark.parametrize("projection", MEAN_SQUARE)
def test_nodes_on_either_side_of_a_kink(projection):
    kink = np.array([0.2, 0.7, 1.0])
    factor, weight = projection_nodes(projection, kink)
    u = (np.arange(1000) + 0.5) / 1000
    sine = np.sin(0.5 * np.pi * u)
    m = np.outer(sine, sine).ravel() if projection != "isotropic" else (np.arange(1_000_000) + 0.5) / 1e6
    for k, f, w in zip(kink, factor, weight, strict=True):
        expected = np.minimum(np.sqrt(1 - m**2), k).mean()
        assert np.minimum(f, k) @ w == pytest.approx(expected, rel=3e-6)


@pytest.mark.parametrize("projection", MEAN_SQUARE)
def test_quadrature_resolves_a_cut(projection):
    # share of orbits whose projection is below rho, smoothed over 0.2 dex as the log-normal does
    factor, weight = projection_nodes(projection)
    u = (np.arange(400) + 0.5) / 400
    fine = np.array(
        [factor_of(projection == "isotropic", np.float32(x), np.float32(y)) for x in u for y in u]
    )
    smooth = lambda rho: 1 / (1 + (rho / 0.6) ** 8)  # noqa: E731
    assert smooth(factor) @ weight == pytest.approx(smooth(fine).mean(), abs=2e-5)


@pytest.mark.parametrize("projection", MEAN_SQUARE)
def test_drawn_orientations_against_points_on_an_orbit(projection):
    """An orbit turned at random in three dimensions, positions projected: written without the module."""
    rng = np.random.Generator(np.random.Philox(7))
    n = 200_000
    cosine = rng.random(n) if projection == "isotropic" else np.cos(0.5 * np.pi * rng.random(n))
    phase = 2 * np.pi * rng.random(n)
    x, y = np.cos(phase), np.sin(phase) * cosine
    square = x**2 + y**2
    drawn = (
        np.array(
            [factor_of(projection == "isotropic", *rng.random(2).astype(np.float32)) for _ in range(20_000)]
        )
        ** 2
    )
    for power in (1, 2):
        assert_within_sigma(
            (square**power).mean(),
            (drawn**power).mean(),
            np.hypot((square**power).std() / n**0.5, (drawn**power).std() / drawn.size**0.5),
        )
    assert_within_sigma(square.mean(), MEAN_SQUARE[projection], square.std() / n**0.5)
