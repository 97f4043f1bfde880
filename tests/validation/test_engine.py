"""A thousand million stars of the engine against quadrature: float32, the generator and the draws at once."""

import numpy as np
import pytest

from data_files import data_file
from porrima.config import PopulationConfig, parse
from porrima.moments import INDICES, ORDER
from porrima.prediction import integrate, population_moments
from porrima.sample import draw_stars, population_of
from porrima.stack import draw_stacks

ENGINE = (
    "4b A thousand million stars: mean kernel moments of the engine (float32, one stream per stack) against quadrature "
    "in float64, 35 % binaries, 18-19 mag in i.  Relative difference and its standard error for the largest moment of "
    "each order, and the largest pull of all 42 moments."
)
N_STARS, N_STACKS, CHUNK = 10_000, 100_000, 10_000


@pytest.mark.parametrize("model", ["dk13", "dk13-kcm16"])
def test_the_mean_of_every_moment_over_a_thousand_million_stars(record, model):
    catalogue = {"catalog": data_file("catalogues/besancon_l200_b90.dat"), "mag": [18, 19]}
    config = parse(PopulationConfig, {"stars": catalogue, "multiplicity": model})
    population = population_of(config, draw_stars(config))
    expected = population_moments(population, integrate(population), np.array([0.35]))
    sums, squares = np.zeros(len(INDICES)), np.zeros(len(INDICES))
    unit = np.array([0.05 ** (a + b) for a, b in INDICES])  # so that squares do not vanish
    for first in range(0, N_STACKS, CHUNK):
        run = {"n_stars": N_STARS, "binary_fraction": 0.35, "seed": 20261122}
        values = draw_stacks(population, first=first, last=first + CHUNK, **run).moments.values / unit
        sums += values.sum(axis=0)
        squares += (values**2).sum(axis=0)
    mean = sums / N_STACKS
    error = np.sqrt((squares / N_STACKS - mean**2) / N_STACKS)
    pull = (mean - expected.mean[0] / unit) / error
    assert np.abs(pull).max() < 5
    shown = []
    for n in range(2, ORDER + 1, 2):
        k = INDICES.index((n, 0))
        truth = expected.mean[0, k] / unit[k]
        shown.append(f"{mean[k] / truth - 1:+.1e} ± {error[k] / truth:.1e}")
    columns = ["multiplicity", *(f"order {n}" for n in range(2, ORDER + 1, 2)), "largest pull"]
    record(ENGINE, columns, [model, *shown, f"{np.abs(pull).max():.1f}"])
    # the variance between stacks is that of one star over N, so stacks do not know of each other
    variance = error[0] ** 2 * N_STACKS * N_STARS / (expected.covariance[0, 0, 0] / unit[0] ** 2)
    assert abs(variance - 1) < 5 * np.sqrt(2 / N_STACKS)
