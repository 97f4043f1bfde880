from dataclasses import replace

import numba
import numpy as np
import pytest

from porrima.errors import InputError
from porrima.moments import INDICES
from porrima.multiplicity import DucheneKraus2013
from porrima.photometry import PHOTOMETRY, HabetsHeintze1981, flux_ratio
from porrima.prediction import integrate, population_moments
from porrima.stack import draw_stacks, draw_systems
from porrima.stars import Stars
from porrima.systems import Population
from statistics_helpers import assert_within_sigma

RUN = {"n_stars": 40, "binary_fraction": "uniform", "seed": 20261122}
XX, XY, YY = (INDICES.index(i) for i in ((2, 0), (1, 1), (0, 2)))


def test_chunks_and_threads_do_not_change_a_bit(population):
    whole = draw_stacks(population, first=0, last=1000, **RUN)
    numba.set_num_threads(1)
    try:
        parts = [draw_stacks(population, first=a, last=b, **RUN) for a, b in ((0, 1), (1, 333), (333, 1000))]
    finally:
        numba.set_num_threads(numba.config.NUMBA_NUM_THREADS)
    np.testing.assert_array_equal(whole.moments.values, np.concatenate([p.moments.values for p in parts]))
    np.testing.assert_array_equal(whole.binary_fraction, np.concatenate([p.binary_fraction for p in parts]))


def test_another_seed_gives_other_stacks(population):
    one = draw_stacks(population, first=0, last=100, **RUN)
    other = draw_stacks(population, first=0, last=100, **(RUN | {"seed": 2}))
    assert np.all(one.binary_fraction != other.binary_fraction)


def test_large_stack_numbers_and_seeds_have_streams_of_their_own(population):
    far = draw_stacks(population, first=2**32, last=2**32 + 50, **RUN)
    near = draw_stacks(population, first=0, last=50, **RUN)
    big_seed = draw_stacks(population, first=0, last=50, **(RUN | {"seed": RUN["seed"] + 2**32}))
    assert len({*near.binary_fraction, *far.binary_fraction, *big_seed.binary_fraction}) == 150
    fixed = RUN | {"binary_fraction": 0.9}  # so that it is the streams of the pairs that differ
    one = draw_stacks(population, first=0, last=50, **fixed).moments.values[:, XX]
    two = draw_stacks(population, first=2**32, last=2**32 + 50, **fixed).moments.values[:, XX]
    other = draw_stacks(
        population, first=0, last=50, **(fixed | {"seed": RUN["seed"] + 2**32})
    ).moments.values[:, XX]
    assert len({*one, *two, *other}) == 150


def test_listed_systems_have_the_moments_of_their_stack(population):
    stacks = draw_stacks(population, first=0, last=20, **RUN)
    for stack in (0, 7, 19):
        systems = draw_systems(population, stack=stack, **RUN)
        assert len(systems) == RUN["n_stars"]
        np.testing.assert_allclose(
            systems.kernel_moments().values[0], stacks.moments.values[stack], rtol=1e-5, atol=1e-18
        )


def test_no_kept_pair_is_resolved(population):
    run = {"n_stars": 5000, "binary_fraction": 1.0, "seed": 3}
    systems = draw_systems(population, stack=0, **run)
    separation = np.hypot(systems.x[:, 1] - systems.x[:, 0], systems.y[:, 1] - systems.y[:, 0])
    assert np.all((separation > 0) & (separation < population.cut))


def test_no_binaries_no_moments(population):
    stacks = draw_stacks(population, n_stars=40, binary_fraction=0.0, seed=1, first=0, last=50)
    assert not np.any(stacks.moments.values)


def test_fractions_are_uniform_fixed_or_the_model_s(population):
    uniform = draw_stacks(population, n_stars=1, binary_fraction="uniform", seed=1, first=0, last=20_000)
    fractions = uniform.binary_fraction
    assert_within_sigma(fractions.mean(), 0.5, np.sqrt(1 / 12 / fractions.size))
    fixed = draw_stacks(population, n_stars=1, binary_fraction=0.35, seed=1, first=0, last=3)
    assert fixed.binary_fraction.tolist() == [0.35] * 3
    model = draw_stacks(population, n_stars=1, binary_fraction="model", seed=1, first=0, last=1)
    assert model.binary_fraction[0] == population.law.multiplicity_fraction.mean()


def brute_force(population, photometry, rng, n):
    """Stars one by one in plain numpy: (x, y) second moments and whether each is a kept star."""
    law, stars = population.law, population.stars
    k = rng.integers(len(stars), size=n)
    pair = rng.random(n) < law.multiplicity_fraction[k]
    g = law.mass_ratio_exponent[k] + 1
    q_min = law.mass_ratio_min[k] ** g
    q = (q_min + rng.random(n) * (1 - q_min)) ** (1 / g)
    log_a = law.log_a[k] + law.log_a_sigma[k] * rng.standard_normal(n)
    if np.isfinite(law.log_a_max[0]):
        while np.any(high := log_a > law.log_a_max[k]):
            log_a[high] = law.log_a[k][high] + law.log_a_sigma[k][high] * rng.standard_normal(high.sum())
    direction = rng.standard_normal((n, 3))
    if population.projection != "isotropic":
        phase, tilt, node = 2 * np.pi * rng.random((3, n))
        u, v = np.cos(phase), np.sin(phase) * np.cos(tilt)
        direction = np.stack(
            [
                u * np.cos(node) - v * np.sin(node),
                u * np.sin(node) + v * np.cos(node),
                np.sin(phase) * np.sin(tilt),
            ],
            1,
        )
    direction /= np.linalg.norm(direction, axis=1)[:, None]
    x, y = (10**log_a / stars.distance[k] * direction[:, i] for i in (0, 1))
    tracks = photometry.tracks(stars.mass[k], stars.metallicity[k], stars.log_age[k], stars.band)
    f = flux_ratio(tracks, stars.mass[k], q[:, None])[:, 0] * pair
    kept = ~(pair & (np.hypot(x, y) >= population.cut))
    c2 = f / (1 + f) ** 2
    return np.stack([c2 * x * x, c2 * x * y, c2 * y * y], axis=1)[kept]


@pytest.mark.parametrize(
    "photometry", [PHOTOMETRY["main-sequence"], HabetsHeintze1981(branch="primary")], ids=["ms", "hh"]
)
@pytest.mark.parametrize(
    "options",
    [
        {},
        {"gap_rule": "solar", "a_max_factor": 2.5},
        {"projection": "inclination-uniform", "mass_ratio_min": 0.3},
        {"scatter_scale": 0.3},
    ],
    ids=["published", "kcm16", "literal", "narrow"],
)
def test_the_engine_draws_what_plain_numpy_draws(stars, options, photometry):
    population = Population.of(stars, multiplicity=DucheneKraus2013(**options), photometry=photometry)
    rng = np.random.Generator(np.random.Philox(5))
    expected = brute_force(population, photometry, rng, 400_000)
    n_stars = 100
    stacks = draw_stacks(population, n_stars=n_stars, binary_fraction="model", seed=5, first=0, last=20_000)
    drawn = stacks.moments.values[:, [XX, XY, YY]]
    both = np.sqrt(expected.var(axis=0) / len(expected) + drawn.var(axis=0) / len(drawn))
    assert_within_sigma(drawn.mean(axis=0), expected.mean(axis=0), both)
    # variance of a stack's mean is that of one star over N; errors from fourth moments
    variance, per_star = drawn.var(axis=0) * n_stars, expected.var(axis=0)
    error = [np.sqrt((((v - v.mean(0)) ** 4).mean(0) - v.var(0) ** 2) / len(v)) for v in (drawn, expected)]
    assert_within_sigma(variance, per_star, np.hypot(error[0] * n_stars, error[1]))


@pytest.mark.parametrize("fraction", [0.3, 0.9])
def test_stars_weighted_by_flux_are_what_plain_numpy_draws(stars, fraction):
    """Whole stacks with each star's own flux: sum of w m over sum of w, singles included."""
    models = {"multiplicity": DucheneKraus2013(), "photometry": PHOTOMETRY["main-sequence"]}
    population = Population.of(stars, stack_weight="flux", **models)
    run = {"n_stars": 30, "binary_fraction": fraction, "seed": 9}
    stacks = draw_stacks(population, first=0, last=20_000, **run)
    systems = draw_systems(population, stack=3, **run)
    np.testing.assert_allclose(
        systems.kernel_moments().values[0], stacks.moments.values[3], rtol=1e-5, atol=1e-18
    )
    # the weights of a stack are the fluxes of stars as the kept sample holds them
    weights = np.concatenate([draw_systems(population, stack=k, **run).weight for k in range(400)])
    p = np.minimum(1, population.scale(np.array([fraction]))[0] * population.law.multiplicity_fraction)
    kept = 1 - p * (1 - integrate(population).unresolved)
    expected = np.average(population.weight, weights=kept)
    assert_within_sigma(weights.mean(), expected, weights.std() / np.sqrt(weights.size))


def test_where_all_pairs_are_resolved_no_stack_can_be_drawn():
    near = Stars.from_columns(mass=[0.09], distance=[5.0], magnitude=[18.0])
    models = {"multiplicity": DucheneKraus2013(), "photometry": PHOTOMETRY["main-sequence"]}
    population = Population.of(near, cut=1e-6, **models)
    with pytest.raises(
        ValueError, match="cut must leave some pairs unresolved at this binary fraction, got 1e-06"
    ):
        draw_stacks(population, n_stars=3, binary_fraction=1.0, seed=1, first=0, last=2)
    with pytest.raises(InputError, match="cut: must leave some pairs unresolved"):
        population_moments(population, integrate(population), np.array([1.0]))


def test_any_law_of_multiplicity_can_be_drawn_from(stars):
    """A fraction of its own for each star, some of them none, and a flat law of log mass ratios."""
    population = Population.of(stars, multiplicity=DucheneKraus2013(), photometry=PHOTOMETRY["main-sequence"])
    rng = np.random.Generator(np.random.Philox(12))
    fraction = np.where(rng.random(len(stars)) < 0.1, 0.0, rng.random(len(stars)))
    law = replace(
        population.law, multiplicity_fraction=fraction, mass_ratio_exponent=np.full(len(stars), -1.0)
    )
    population = replace(population, law=law)
    for wanted in (0.3, 0.85):
        moments = population_moments(population, integrate(population), np.array([wanted]))
        drawn = draw_stacks(
            population, n_stars=400, binary_fraction=wanted, seed=2, first=0, last=5000
        ).moments.values
        assert_within_sigma(drawn.mean(axis=0), moments.mean[0], drawn.std(axis=0) / np.sqrt(5000))


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"n_stars": 0}, "n_stars must be at least 1, got 0"),
        ({"seed": -1}, r"seed must be in \[0, 2\^64\), got -1"),
        ({"binary_fraction": 1.2}, r"binary_fraction must be in \[0, 1\], got 1.2"),
    ],
)
def test_bad_arguments_are_named(population, changes, message):
    with pytest.raises(ValueError, match=message):
        draw_stacks(population, first=0, last=1, **(RUN | changes))
