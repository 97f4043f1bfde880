"""The averages over companions against a hundred million drawn pairs, and against far finer quadrature."""

from concurrent.futures import ThreadPoolExecutor

import numpy as np
import pytest

from data_files import data_file
from porrima import integrals
from porrima.averages import population_moments
from porrima.config import PopulationConfig, parse
from porrima.integrals import EVEN, PRODUCTS, coefficient_moments, integrate, separation_moments
from porrima.photometry import STEP
from porrima.sample import draw_stars, population_of

POPULATIONS = {
    "Galaxy, l = 180°, b = 45°": lambda: {"l": 180, "b": 45, "n_drawn": 2000},
    "Besançon, b = 90°": lambda: {"catalog": data_file("catalogues/besancon_l200_b90.dat")},
    "Besançon, b = 59°": lambda: {"catalog": data_file("catalogues/besancon_l200_b59.csv")},
}
N_PAIRS = 100_000_000
QUADRATURE = (
    "4f Averages over companions: a hundred million pairs, the same number for each star, drawn in plain numpy on the "
    "stars' own tracks (18-19 mag in i), against quadrature: relative difference and standard error of the mean x and "
    "of the mean moment of order 8, largest pull of the share unresolved, the 4 mean moments and the 16 mean products "
    "of moments; and largest relative error of all powers against rules with sixteen times the nodes, beside the "
    "estimate that comes with every answer."
)


def drawn_sums(population, star, n, rng):
    """Mean and squared standard error of unresolved, moments and products for the companion of one star."""
    law, tracks, mass = population.law, population.tracks, population.stars.mass[star]
    g, low = law.mass_ratio_exponent[star] + 1, law.mass_ratio_min[star]
    q = (low**g + rng.random(n) * (1 - low**g)) ** (1 / g)
    z = rng.standard_normal(n)
    top = (law.log_a_max[star] - law.log_a[star]) / law.log_a_sigma[star]
    while (wide := np.flatnonzero(z > top)).size:
        z[wide] = rng.standard_normal(wide.size)
    a = 10 ** (law.log_a[star] + law.log_a_sigma[star] * z)
    r = a * np.sqrt(1 - rng.random(n) ** 2) / population.stars.distance[star] / population.cut
    kept = r < 1
    q, r2 = q[kept], r[kept] ** 2
    magnitude = tracks.magnitude[:, tracks.index[star]] @ tracks.weight[star]
    grid = tracks.log_mass_min + STEP * np.arange(magnitude.size)
    difference = np.interp(np.log10(q * mass), grid, magnitude) - np.interp(np.log10(mass), grid, magnitude)
    f = np.where(q * mass < tracks.dark_below, 0.0, np.minimum(10 ** (-0.4 * difference), 1.0))
    near, far = -f / (1 + f), 1 / (1 + f)
    c = {k: near**k / (1 + f) + far**k * f / (1 + f) for k in range(2, 9)}
    columns = [np.ones(q.size), *(c[k] * r2 ** (k // 2) for k in EVEN)]
    columns += [c[k] * c[m] * r2 ** ((k + m) // 2) for k, m in PRODUCTS]
    first = np.array([v.sum() for v in columns]) / n
    second = np.array([v @ v for v in columns]) / n
    return first, (second - first**2) / n


def drawn(population, pair, seed, n_pairs):
    """Sums over the stars, each weighted with its probability of being a pair, and their standard errors."""
    n_stars = len(population.stars)
    n = n_pairs // n_stars + 1
    seeds = np.random.SeedSequence(seed).spawn(n_stars)
    with ThreadPoolExecutor(2) as pool:
        parts = list(
            pool.map(
                lambda star: drawn_sums(
                    population, star, n, np.random.Generator(np.random.PCG64(seeds[star]))
                ),
                range(n_stars),
            )
        )
    mean = sum(p * first for p, (first, _) in zip(pair, parts, strict=True))
    return mean, np.sqrt(sum(p**2 * variance for p, (_, variance) in zip(pair, parts, strict=True)))


def far_finer(population, monkeypatch):
    """Both factors by rules with many times the nodes."""
    with monkeypatch.context() as patch:
        nodes = integrals.projection_nodes
        patch.setattr(integrals, "_STEP", 0.004)
        patch.setattr(
            integrals, "projection_nodes", lambda projection, kink=None, **_: nodes(projection, kink, 300)
        )
        integrals._separation_table.cache_clear()
        separation = separation_moments(population)[0]
    integrals._separation_table.cache_clear()
    return coefficient_moments(population, 2048)[0], separation


@pytest.mark.parametrize(
    ("where", "model"), [*((where, "dk13") for where in POPULATIONS), (next(iter(POPULATIONS)), "dk13-kcm16")]
)
def test_every_average_agrees_with_drawn_pairs(record, full_size, monkeypatch, where, model):
    stars = POPULATIONS[where]() | {"mag": [18, 19]}
    config = parse(PopulationConfig, {"stars": stars, "multiplicity": model})
    stars = draw_stars(config)
    population = population_of(config, stars if full_size else stars.take(np.arange(0, len(stars), 12)))
    pair = population.law.multiplicity_fraction
    found = integrate(population)
    unit = population.cut ** np.array([0, *EVEN, *(n + m for n, m in PRODUCTS)])
    expected = pair @ np.column_stack([found.unresolved, found.mean, found.product]) / unit
    mean, error = drawn(population, pair, 20261125, N_PAIRS if full_size else N_PAIRS // 20)
    pull = (mean - expected) / error
    assert np.abs(pull).max() < 5
    coefficient, separation = far_finer(population, monkeypatch)
    fine, used = (
        np.einsum("i,ij,ik->jk", pair, c, s)[1:, 1:]
        for c, s in ((coefficient, separation), (found.coefficient[0], found.separation[0]))
    )
    true_error = np.abs(used / fine - 1).max()
    estimate = population_moments(population, found).relative_error[0]
    assert true_error < estimate < 1e-4
    columns = ["stars", "multiplicity", "mean x", "order 8", "largest pull", "true error", "estimate"]
    shown = [f"{mean[k] / expected[k] - 1:+.1e} ± {error[k] / expected[k]:.1e}" for k in (1, 4)]
    line = [where, model, *shown, f"{np.abs(pull).max():.1f}", f"{true_error:.1e}", f"{estimate:.1e}"]
    record(QUADRATURE, columns, line)
