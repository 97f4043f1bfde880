"""A star with several classes of companions: splitting a law changes nothing, a mixture is the mean of its parts."""

from dataclasses import dataclass, fields, replace

import numpy as np
import pytest

from porrima.averages import population_moments
from porrima.distribution import pair_density
from porrima.integrals import integrate
from porrima.moments import INDICES
from porrima.multiplicity import CompanionLaw, DucheneKraus2013, multiplicity_scale
from porrima.photometry import PHOTOMETRY
from porrima.stack import draw_stacks, draw_systems
from porrima.stars import Stars
from porrima.systems import Population
from statistics_helpers import assert_within_sigma

MODEL = DucheneKraus2013()
LIGHT = PHOTOMETRY["main-sequence"]
SHARES = np.array([0.5, 0.3, 0.2])
FRACTIONS = np.array([0.2, 0.35, 0.9])


@dataclass(frozen=True, kw_only=True)
class Mixture:
    """Classes of companions that differ by given changes of the columns of a law; none differ where there are none."""

    changes: tuple[dict, ...] = ({}, {}, {})
    shares: tuple[float, ...] = tuple(SHARES)
    projection = "isotropic"

    def companions(self, mass, metallicity=None):
        law = MODEL.companions(mass)
        return mixture([replace(law, **change) for change in self.changes], self.shares)


def mixture(laws, shares):
    """Laws of the same stars as classes, star by star."""
    columns = {
        f.name: np.stack([getattr(law, f.name) for law in laws], axis=1).ravel() for f in fields(CompanionLaw)
    }
    share = np.tile(shares, laws[0].star.size)
    return CompanionLaw(**columns | {"share": share})


def orbits(n, log_a, sigma, q_min, q_max, exponent):
    values = {"log_a": log_a, "log_a_sigma": sigma, "mass_ratio_min": q_min, "mass_ratio_max": q_max}
    return {name: np.full(n, value) for name, value in (values | {"mass_ratio_exponent": exponent}).items()}


def parts(n):
    """Three classes: close twins, a narrow range of wide orbits, light companions."""
    return (
        orbits(n, 0.5, 0.3, 0.95, 1.0, 0.0),
        orbits(n, 1.7, 1.2, 0.3, 0.9, -1.0),
        orbits(n, 1.0, 0.8, 0.1, 0.3, 0.3),
    )


@pytest.fixture(scope="module", params=["equal", "flux"])
def weight(request):
    return request.param


def of(stars, model, weight="equal"):
    return Population.of(stars, multiplicity=model, photometry=LIGHT, stack_weight=weight)


def test_a_law_in_equal_classes_predicts_the_same(stars, weight):
    whole, split = of(stars, MODEL, weight), of(stars, Mixture(), weight)
    assert len(split.stars) == 3 * len(stars)
    np.testing.assert_array_equal(split.primaries.mass, stars.mass)
    for fraction in (None, FRACTIONS):
        one, other = (population_moments(p, integrate(p), fraction) for p in (whole, split))
        for field in (f for f in fields(one) if f.name != "triples"):  # there are none
            values = np.asarray(getattr(one, field.name))
            near = 1e-12 * (1.0 if field.name == "relative_error" else np.max(np.abs(values)))
            np.testing.assert_allclose(getattr(other, field.name), values, rtol=1e-12, atol=near)
    one, other = (pair_density(p, integrate(p), 0.35) for p in (whole, split))
    np.testing.assert_allclose(other.share, one.share, rtol=1e-10, atol=1e-20)


def test_one_class_counts_as_one_star(stars):
    population = of(stars, MODEL)
    assert np.all(population.abundance == 1.0)
    assert population.primaries is population.stars


def test_a_mixture_predicts_the_mean_of_its_parts_weighted_by_their_shares(stars):
    n = len(stars)
    population = of(stars, Mixture(changes=parts(n)))
    mixed = population_moments(population, integrate(population))
    found = [
        population_moments(p, integrate(p))
        for p in (of(stars, Mixture(changes=(c,), shares=(1.0,))) for c in parts(n))
    ]
    pairs = MODEL.companions(stars.mass).multiplicity_fraction.mean()
    removed = np.array([one.removed_fraction[0] for one in found])
    kept = 1 - pairs * removed
    powers = np.array([one.powers[0] for one in found])  # sums over kept stars, so of each part over its own
    expected = np.einsum("c,cjk->jk", SHARES * kept, powers) / (SHARES @ kept)
    np.testing.assert_allclose(mixed.powers[0], expected, rtol=1e-12)
    assert mixed.removed_fraction[0] == pytest.approx(SHARES @ removed, rel=1e-12)
    assert mixed.binary_fraction[0] == pytest.approx(pairs, rel=1e-12)


@pytest.mark.parametrize("fraction", [0.35, 0.9])
def test_the_engine_draws_the_classes_as_often_as_they_are(stars, weight, fraction):
    population = of(stars, Mixture(changes=parts(len(stars))), weight)
    n_stars, n_stacks = 400, 3000
    drawn = draw_stacks(
        population, n_stars=n_stars, binary_fraction=fraction, seed=11, first=0, last=n_stacks
    ).moments.values
    known = population_moments(population, integrate(population), np.array([fraction]))
    even = [k for k, (a, b) in enumerate(INDICES) if a + b in (2, 4)]
    mean = known.mean[0] + known.shift[0] / n_stars
    error = np.sqrt(np.diag(known.covariance[0]) / n_stars / n_stacks)
    assert_within_sigma(drawn.mean(axis=0)[even], mean[even], error[even])
    batches = drawn.reshape(30, -1, drawn.shape[1])
    variance = batches.var(axis=1, ddof=1)
    expected = np.diag(known.covariance[0]) / n_stars
    second = [k for k, (a, b) in enumerate(INDICES) if a + b == 2]
    error = variance.std(axis=0, ddof=1) / np.sqrt(30)
    slack = (
        0.01 * expected if weight == "flux" else 0.0
    )  # the covariance of weighted stacks is first order in 1/N
    assert np.all(np.abs(variance.mean(axis=0) - expected)[second] < (5 * error + slack)[second])


def test_single_stars_of_a_mixture_weigh_what_those_of_the_whole_law_do(stars):
    """Single stars only: the mean weight of the systems drawn is that of the stars, whatever the shares."""
    changes = parts(len(stars))
    population = of(stars, Mixture(changes=changes, shares=(0.9, 0.05, 0.05)), "flux")
    weight = draw_systems(population, n_stars=200_000, binary_fraction=0.0, seed=3, stack=0).weight
    assert_within_sigma(weight.mean(), 1.0, weight.std() / np.sqrt(weight.size))


def test_a_catalogue_s_own_pairs_keep_their_mass_ratio_in_every_class():
    columns = {"mass": [0.5, 0.8, 0.9], "distance": [300.0] * 3, "magnitude": [18.5] * 3}
    stars = Stars.from_columns(**columns, mass_ratio=[0.0, 0.7, np.nan])
    law = of(stars, Mixture(changes=parts(3))).law
    np.testing.assert_array_equal(law.mass_ratio, [*[np.nan] * 3, *[0.7] * 3, *[np.nan] * 3])
    np.testing.assert_array_equal(law.multiplicity_fraction, [*[0.0] * 3, *[1.0] * 3, *[0.44] * 3])


def test_scaling_weighs_stars_by_their_abundance():
    fraction, abundance = np.array([0.2, 0.5, 0.8]), np.array([1.5, 1.0, 0.5])
    wanted = np.linspace(0, 1, 21)
    scale = multiplicity_scale(fraction, wanted, abundance)
    np.testing.assert_allclose(np.minimum(1, np.outer(scale, fraction)) @ abundance / 3, wanted, atol=1e-14)
