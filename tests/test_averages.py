import dataclasses

import numpy as np
import pytest

from porrima.averages import population_moments
from porrima.integrals import integrate
from porrima.moments import INDICES
from porrima.multiplicity import DucheneKraus2013
from porrima.photometry import PHOTOMETRY, flux_ratio
from porrima.stack import draw_stacks
from porrima.stars import Stars
from porrima.systems import Population
from statistics_helpers import assert_within_sigma

MODELS = {
    "published": DucheneKraus2013(),
    "kcm16": DucheneKraus2013(gap_rule="solar", a_max_factor=2.5),
    "literal": DucheneKraus2013(projection="inclination-uniform"),
}


@pytest.mark.parametrize("fraction", [0.1, 0.35, 0.9, 1.0])
@pytest.mark.parametrize("model", MODELS)
def test_every_moment_of_every_order_against_the_engine(stars, model, fraction):
    population = Population.of(stars, multiplicity=MODELS[model], photometry=PHOTOMETRY["main-sequence"])
    moments = population_moments(population, integrate(population), np.array([fraction]))
    n_stars, n_stacks = 400, 5000
    drawn = draw_stacks(
        population, n_stars=n_stars, binary_fraction=fraction, seed=11, first=0, last=n_stacks
    ).moments.values
    assert_within_sigma(drawn.mean(axis=0), moments.mean[0], drawn.std(axis=0) / np.sqrt(n_stacks))
    variance = drawn.var(axis=0) * n_stars
    centred = drawn - drawn.mean(axis=0)
    error = n_stars * np.sqrt(((centred**4).mean(axis=0) - drawn.var(axis=0) ** 2) / n_stacks)
    low = [
        k for k, (a, b) in enumerate(INDICES) if a + b <= 4
    ]  # higher orders have tails too heavy for this N
    assert_within_sigma(variance[low], moments.covariance[0].diagonal()[low], error[low])


def test_fractions_are_those_of_the_sample_after_removal(population):
    integrals = integrate(population)
    moments = population_moments(population, integrals, np.array([0.0, 0.5, 1.0]))
    np.testing.assert_allclose(moments.binary_fraction, [0, 0.5, 1.0], atol=1e-14)
    assert moments.unresolved_fraction[0] == 0
    assert moments.removed_fraction[0] == 0
    assert moments.unresolved_fraction[2] == pytest.approx(1.0)  # all are pairs, and the kept ones unresolved
    assert moments.removed_fraction[2] == pytest.approx(1 - integrals.unresolved.mean())
    assert moments.mean_x[2] == pytest.approx(integrals.mean[:, 0].sum() / integrals.unresolved.sum())


def test_no_binary_fraction_means_the_model_s_own(population):
    integrals = integrate(population)
    own = population.law.multiplicity_fraction.mean()
    a, b = (population_moments(population, integrals, f) for f in (None, np.array([own])))
    for name in ("binary_fraction", "mean_x", "mean_x2", "removed_fraction"):
        np.testing.assert_allclose(getattr(a, name), getattr(b, name), rtol=1e-10)


def test_pairs_that_a_catalogue_has_made_keep_their_mass_ratio(stars):
    """Given mass ratios through engine and closed form; half of the stars single, a few left to the model."""
    rng = np.random.Generator(np.random.Philox(21))
    given = np.where(rng.random(len(stars)) < 0.5, 0.0, rng.uniform(0.7, 1.0, len(stars)))
    given[:30] = np.nan
    models = {"multiplicity": DucheneKraus2013(), "photometry": PHOTOMETRY["main-sequence"]}
    population = Population.of(dataclasses.replace(stars, mass_ratio=given), **models)
    own = population.law.multiplicity_fraction
    assert set(own[30:]) == {0.0, 1.0}
    np.testing.assert_array_equal(
        own[:30], DucheneKraus2013().companions(stars.mass[:30]).multiplicity_fraction
    )
    moments = population_moments(population, integrate(population))
    drawn = draw_stacks(
        population, n_stars=400, binary_fraction="model", seed=11, first=0, last=5000
    ).moments.values
    assert_within_sigma(drawn.mean(axis=0), moments.mean[0], drawn.std(axis=0) / np.sqrt(5000))
    one = Population.of(
        dataclasses.replace(stars, mass_ratio=np.full(len(stars), 0.9)).take(np.array([50])), **models
    )
    f = flux_ratio(one.tracks, one.stars.mass, np.array([[0.9]]))[0, 0]
    unresolved = integrate(one)
    second = unresolved.mean[0, 0] / (f / (1 + f) ** 2)  # E[r²; r < cut], the same for any mass ratio
    free = integrate(Population.of(stars.take(np.array([50])), **models))
    assert unresolved.unresolved[0] == pytest.approx(free.unresolved[0])
    assert 0 < second < 0.05**2


def test_equal_magnitudes_make_the_weights_equal():
    star = Stars.from_columns(mass=[0.3, 0.8], distance=[300, 700], magnitude=[18.5, 18.5])
    models = {"multiplicity": DucheneKraus2013(), "photometry": PHOTOMETRY["main-sequence"]}
    one, other = (
        population_moments(p, integrate(p), np.array([0.4]))
        for p in (Population.of(star, stack_weight=w, **models) for w in ("equal", "flux"))
    )
    np.testing.assert_allclose(one.covariance, other.covariance, rtol=1e-12)
    np.testing.assert_allclose(other.shift, 0, atol=1e-20)
    assert other.effective_share[0] == pytest.approx(1)


def test_the_size_moments_are_those_of_the_kernels(population):
    moments = population_moments(population, integrate(population), np.array([0.3, 0.9]))
    xx, yy = INDICES.index((2, 0)), INDICES.index((0, 2))
    np.testing.assert_allclose(moments.mean[:, xx] + moments.mean[:, yy], moments.mean_x, rtol=1e-12)
    c = moments.covariance
    variance = c[:, xx, xx] + c[:, yy, yy] + 2 * c[:, xx, yy]
    np.testing.assert_allclose(variance, moments.mean_x2 - moments.mean_x**2, rtol=1e-9)


def test_stars_with_many_multiplicity_fractions_are_those_with_few(population):
    """One group per star instead of three gives the same sums."""
    own = population.law.multiplicity_fraction
    spread = own * (1 + 1e-13 * np.arange(own.size))
    law = dataclasses.replace(population.law, multiplicity_fraction=spread)
    many = dataclasses.replace(population, law=law)
    one, other = (population_moments(p, integrate(p), np.array([0.35, 0.95])) for p in (population, many))
    np.testing.assert_allclose(one.covariance, other.covariance, rtol=1e-9, atol=1e-30)
