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
    "each order, and the largest pull of all 42 means and of the 42 variances between stacks."
)
INDEPENDENCE = (
    "4c Independence of stacks: correlation of the size moment of a million stacks of 40 stars with that of other "
    "stacks, in standard errors: the next ones of the same run, those one batch, chunk and more later, and the same "
    "stacks of other seeds."
)
N_STARS, CHUNK = 10_000, 10_000


@pytest.mark.parametrize("model", ["dk13", "dk13-kcm16"])
def test_the_mean_of_every_moment_over_a_thousand_million_stars(record, full_size, model):
    n_stacks = 100_000 if full_size else CHUNK
    catalogue = {"catalog": data_file("catalogues/besancon_l200_b90.dat"), "mag": [18, 19]}
    config = parse(PopulationConfig, {"stars": catalogue, "multiplicity": model})
    population = population_of(config, draw_stars(config))
    expected = population_moments(population, integrate(population), np.array([0.35]))
    unit = np.array([0.05 ** (a + b) for a, b in INDICES])  # so that powers do not vanish
    powers = np.zeros((4, len(INDICES)))
    middle = expected.mean[0] / unit
    for first in range(0, n_stacks, CHUNK):
        run = {"n_stars": N_STARS, "binary_fraction": 0.35, "seed": 20261122}
        values = (
            draw_stacks(population, first=first, last=first + CHUNK, **run).moments.values / unit - middle
        )
        powers += [np.sum(values**k, axis=0) / n_stacks for k in (1, 2, 3, 4)]
    mean, second, third, fourth = powers
    variance = second - mean**2
    error = np.sqrt(variance / n_stacks)
    pull = mean / error
    assert np.abs(pull).max() < 5
    # the variance between stacks is that of one star over N, so stacks do not know of each other
    about_mean = fourth - 4 * mean * third + 6 * mean**2 * second - 3 * mean**4
    error_of_variance = np.sqrt((about_mean - variance**2) / n_stacks)
    predicted = np.diagonal(expected.covariance[0]) / N_STARS / unit**2
    pull_of_variance = (variance - predicted) / error_of_variance
    assert np.abs(pull_of_variance).max() < 5
    shown = []
    for n in range(2, ORDER + 1, 2):
        k = INDICES.index((n, 0))
        shown.append(f"{mean[k] / middle[k]:+.1e} ± {error[k] / middle[k]:.1e}")
    orders = [f"order {n}" for n in range(2, ORDER + 1, 2)]
    columns = ["multiplicity", *orders, "largest pull of means", "of variances"]
    record(ENGINE, columns, [model, *shown, *(f"{np.abs(p).max():.1f}" for p in (pull, pull_of_variance))])


def test_stacks_chunks_and_seeds_do_not_know_of_each_other(record, full_size):
    config = parse(PopulationConfig, {"stars": {"l": 180, "b": 45, "mag": [18, 19]}})
    population = population_of(config, draw_stars(config))

    def sizes(first, seed):
        run = {"n_stars": 40, "binary_fraction": 0.35, "seed": seed}
        values = draw_stacks(population, first=first, last=first + n, **run).moments.values
        x = np.log1p((values[:, 0] + values[:, 2]) / 1e-6)  # whose tail is not heavy
        return (x - x.mean()) / x.std()

    n = 1_000_000 if full_size else 200_000
    here = sizes(0, 5)
    others = {f"{lag} later": np.roll(here, -lag) for lag in (1, 2, 3, 64, 10_000)}
    others |= {f"2^{power} later": sizes(2**power, 5) for power in (20, 32)}
    others |= {f"seed + 2^{power}": sizes(0, 5 + 2**power) for power in (0, 1, 31, 32, 63)}
    pulls = {name: float(here @ other) / np.sqrt(n) for name, other in others.items()}
    record(INDEPENDENCE, list(pulls), [f"{pull:+.1f}" for pull in pulls.values()])
    assert max(abs(pull) for pull in pulls.values()) < 5
