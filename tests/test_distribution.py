import numpy as np
import pytest

from porrima.distribution import pair_density, size_distribution
from porrima.errors import InputError
from porrima.integrals import integrate
from porrima.multiplicity import MULTIPLICITY
from porrima.photometry import PHOTOMETRY
from porrima.psf import psf_from_name
from porrima.response import response
from porrima.shapes import estimator_from_name
from porrima.stack import draw_stacks
from porrima.stars import Stars
from porrima.systems import Population
from statistics_helpers import assert_within_sigma

PROBABILITIES = np.array([0.05, 0.16, 0.5, 0.84, 0.95, 0.99, 0.999])
MODELS = {"multiplicity": MULTIPLICITY["dk13"], "photometry": PHOTOMETRY["main-sequence"]}


def reply(psf="psf1", estimator="plain"):
    return response(psf_from_name(psf), estimator_from_name(estimator))


@pytest.mark.parametrize(("n_stars", "n_stacks"), [(1, 200_000), (5, 100_000), (40, 100_000), (750, 20_000)])
def test_quantiles_against_simulated_stacks(population, n_stars, n_stacks):
    """The share of simulated stacks below each predicted quantile, within its binomial error."""
    stacks = draw_stacks(population, n_stars=n_stars, binary_fraction=0.35, seed=17, first=0, last=n_stacks)
    integrals = integrate(population)
    for psf, estimator in (("psf1", "plain"), ("psf1", "adaptive"), ("optical1", "adaptive")):
        answer = reply(psf, estimator)
        found = size_distribution(population, answer, n_stars, 0.35, integrals)
        value = found.quantile(PROBABILITIES) + 1e-13  # stacks without companions are 0 but for rounding
        size = answer.shapes(stacks.moments).r2 / answer.shape0.r2 - 1
        below = np.mean(size[:, None] <= value, axis=0)
        expected = found.probability(value)
        error = np.sqrt(expected * (1 - expected) / n_stacks)
        assert_within_sigma(below, expected, error)
        atom = found.probability(np.array([1e-13]))[0]
        np.testing.assert_allclose(expected, np.maximum(PROBABILITIES, atom), atol=2e-4)


@pytest.mark.parametrize("n_stars", [1, 2, 40, 10_000])
def test_mean_and_variance_are_those_of_the_prediction(population, n_stars):
    found = size_distribution(population, reply(), n_stars, 0.35)
    mass = np.diff(found.cumulative, prepend=0.0)
    middle = 0.5 * (found.value + np.append(0.0, found.value[:-1]))
    assert mass.sum() + found.none == pytest.approx(1, abs=1e-9)
    mean = mass @ middle
    assert mean == pytest.approx(found.prediction.bias[2, 0], rel=1e-3)
    sd = np.sqrt(mass @ middle**2 - mean**2)
    assert sd == pytest.approx(found.prediction.sd[2, 0], rel=2e-3)


def test_stacks_without_companions_have_no_error(population):
    integrals, law = integrate(population), population.law
    shining = pair_density(population, integrals, 0.35).share.sum()
    pair = population.scale(np.array([0.35]))[0] * law.multiplicity_fraction
    power = law.mass_ratio_exponent + 1
    light = (1 - np.clip(0.08 / population.stars.mass, 0.1, 1.0) ** power) / (1 - 0.1**power)
    kept = 1 - pair * (1 - integrals.unresolved)
    assert shining == pytest.approx(np.sum(pair * integrals.unresolved * light) / kept.sum(), rel=1e-4)
    found = size_distribution(population, reply(), 3, 0.35, integrals)
    assert found.none == pytest.approx((1 - shining) ** 3)
    assert found.quantile(np.array([0.5 * found.none]))[0] == pytest.approx(0, abs=1e-12)
    assert found.probability(np.array([-1e-9, 0.0]))[0] == 0
    empty = size_distribution(population, reply(), 3, 0.0, integrals)
    assert empty.none == 1
    np.testing.assert_allclose(empty.probability(np.array([-1.0, 0.0, 1.0])), [0, 1, 1])


def test_one_star_of_given_pairs_has_the_distribution_of_its_orbit():
    """One kind of star and one mass ratio: x < X where r is below a limit, which the engine's moments also say."""
    star = Stars.from_columns(mass=[0.4], distance=[400.0], magnitude=[18.5], mass_ratio=[0.8])
    population = Population.of(star, **MODELS)
    integrals = integrate(population)
    found = size_distribution(population, reply(), 1, None, integrals)
    y = integrals.coefficient[0, 0, 1] / 4
    for cut in (0.01, 0.03, 0.045):
        below = integrate(Population.of(star, cut=cut, **MODELS)).unresolved / integrals.unresolved
        limit = y * cut**2 / float(reply().shape0.r2)
        assert found.probability(np.array([limit]))[0] == pytest.approx(below[0], abs=3e-3)


def test_a_heavy_tail_is_farther_out_than_a_gaussian_one(population):
    found = size_distribution(population, reply(), 40, 0.35)
    reach = (found.quantile(np.array([0.999]))[0] - found.prediction.bias[2, 0]) / found.prediction.sd[2, 0]
    assert reach > 4.5  # 3.1 for a Gaussian


def test_what_has_no_distribution_is_told(population, stars):
    weighted = Population.of(stars, stack_weight="flux", **MODELS)
    with pytest.raises(InputError, match="stack_weight: must be equal for a distribution, got flux"):
        size_distribution(weighted, reply(), 5, 0.35)
    with pytest.raises(ValueError, match="n_stars must be at least 1, got 0"):
        size_distribution(population, reply(), 0, 0.35)
    found = size_distribution(population, reply(), 5, 0.35)
    with pytest.raises(ValueError, match=r"probability must be in \[0, 1\], got 1.2"):
        found.quantile(np.array([0.5, 1.2]))
