import itertools

import numpy as np
import pytest
from scipy.integrate import quad
from scipy.special import beta, betainc

from porrima import integrals
from porrima.averages import population_moments
from porrima.integrals import coefficient_moments, coefficient_polynomial, integrate, separation_moments
from porrima.moments import ORDER, pair_coefficient
from porrima.multiplicity import DucheneKraus2013
from porrima.photometry import PHOTOMETRY, HabetsHeintze1981
from porrima.stars import Stars
from porrima.systems import Population

MODELS = {
    "published": DucheneKraus2013(),
    "kcm16": DucheneKraus2013(gap_rule="solar", a_max_factor=2.5),
    "literal": DucheneKraus2013(projection="inclination-uniform"),
    "literal and truncated": DucheneKraus2013(projection="inclination-uniform", a_max_factor=2.5),
}


def of(stars, model, **options):
    return Population.of(stars, multiplicity=MODELS[model], photometry=PHOTOMETRY["main-sequence"], **options)


@pytest.mark.parametrize("options", [{}, {"a_max_factor": 2.5}], ids=["published", "truncated"])
def test_integrals_against_adaptive_quadrature(options):
    """One star with the analytic relation: f is q^(0.4 x 12.47), so scipy can do the integrals as they stand."""
    star = Stars.from_columns(mass=[1.0], distance=[700.0], magnitude=[18.0])
    model = DucheneKraus2013(**options)
    population = Population.of(
        star, multiplicity=model, photometry=HabetsHeintze1981(branch="primary"), cut=0.05
    )
    law = population.law
    g, q_min = law.mass_ratio_exponent[0] + 1, law.mass_ratio_min[0]

    def c2(q):
        f = q ** (0.4 * 12.47)
        return f / (1 + f) ** 2

    def over_mass_ratio(function):
        return quad(lambda q: function(q) * q ** (g - 1) * g / (1 - q_min**g), q_min, 1, epsrel=1e-12)[0]

    top = min((law.log_a_max[0] - law.log_a[0]) / law.log_a_sigma[0], 9.0)

    def seen_closer(power, limit):
        """Mean of rho^power over isotropic orientations with rho < limit, by the incomplete beta function."""
        return 0.5 * beta(power / 2 + 1, 0.5) * betainc(power / 2 + 1, 0.5, limit**2)

    def over_separation(power):
        def integrand(z):
            a = 10 ** (law.log_a[0] + law.log_a_sigma[0] * z) / 700.0
            return a**power * seen_closer(power, min(1.0, 0.05 / a)) * np.exp(-0.5 * z * z)

        kink = (np.log10(0.05 * 700) - law.log_a[0]) / law.log_a_sigma[0]
        edges = [-9, *([kink] if kink < top else []), top]
        norm = quad(lambda z: np.exp(-0.5 * z * z), -9, top, epsrel=1e-12)[0]
        pieces = itertools.pairwise(edges)
        return sum(quad(integrand, a, b, epsrel=1e-10)[0] for a, b in pieces) / norm

    integrals = integrate(population)
    assert integrals.unresolved[0] == pytest.approx(over_separation(0), rel=2e-6)
    assert integrals.mean[0, 0] == pytest.approx(over_mass_ratio(c2) * over_separation(2), rel=2e-6)
    assert integrals.product[0, 0] == pytest.approx(
        over_mass_ratio(lambda q: c2(q) ** 2) * over_separation(4), rel=2e-6
    )


@pytest.mark.parametrize("n", range(2, ORDER + 1))
def test_moments_are_polynomials_in_y(n):
    f = np.linspace(0, 1, 11)
    powers = (4 * f / (1 + f) ** 2)[:, None] ** np.arange(ORDER + 1)
    if n % 2 == 0:
        np.testing.assert_allclose(powers @ coefficient_polynomial(n), pair_coefficient(f, n), atol=1e-15)
    for m in range(n, ORDER + 1, 2):
        product = pair_coefficient(f, n) * pair_coefficient(f, m)
        np.testing.assert_allclose(powers @ coefficient_polynomial(n, m), product, atol=1e-15)


def far_finer(population, monkeypatch):
    """Both factors by rules with many times the nodes."""
    with monkeypatch.context() as patch:
        nodes = integrals.projection_nodes
        patch.setattr(integrals, "_STEP", 0.005)
        patch.setattr(
            integrals, "projection_nodes", lambda projection, kink=None, **_: nodes(projection, kink, 160)
        )
        integrals._separation_table.cache_clear()
        separation = separation_moments(population)[0]
    integrals._separation_table.cache_clear()
    return coefficient_moments(population, 2048)[0], separation


@pytest.mark.parametrize("model", MODELS)
def test_the_error_of_the_quadrature_is_small_and_its_estimate_honest(stars, model, monkeypatch):
    population = of(stars, model)
    found = integrate(population)
    coefficient, separation = far_finer(population, monkeypatch)
    assert np.abs(found.separation[0] / separation - 1).max() < 1e-5  # of every star
    estimate = population_moments(population, found, np.array([0.35])).relative_error[0]
    powers = [
        np.einsum("ij,ik->jk", c, s)[1:, 1:]
        for c, s in ((found.coefficient[0], found.separation[0]), (coefficient, separation))
    ]
    error = np.abs(powers[0] / powers[1] - 1).max()
    assert error < estimate < 1e-4


@pytest.mark.parametrize("model", ["kcm16", "literal and truncated"])
def test_a_star_whose_widest_orbit_just_fits_below_the_cut(model):
    """Where a truncated law meets the cut its moments have a kink: each star by a sum over a million orientations."""
    place = np.array([-0.3, -0.01, -0.001, 0.0, 0.001, 0.3])
    distance = 2.5 * 45 * 10**place / 0.05
    star = Stars.from_columns(mass=[1.0] * 6, distance=distance, magnitude=[18.5] * 6)
    population = of(star, model)
    law = population.law
    m = (np.arange(1_000_000) + 0.5) / 1_000_000
    if model != "kcm16":
        sine = np.sin(0.5 * np.pi * (np.arange(1000) + 0.5) / 1000)
        m = np.outer(sine, sine).ravel()
    rho = np.sqrt(1 - m**2)
    rng = np.random.Generator(np.random.Philox(5))
    z = rng.standard_normal(m.size)
    found = separation_moments(population)[0]
    for k, d in enumerate(distance):
        a = 10 ** (law.log_a[0] + law.log_a_sigma[0] * z)
        a = a[a < 10 ** law.log_a_max[0]]
        u = a * rng.permutation(rho)[: a.size] / d / 0.05
        for n in (0, 1, 4):
            drawn = np.where(u < 1, u ** (2 * n), 0.0)
            assert abs(drawn.mean() - found[k, n]) <= 5 * drawn.std() / np.sqrt(a.size) + 1e-12


def test_the_separation_depends_on_the_cut_over_the_orbit_alone(stars):
    near, far = (
        of(Stars.from_columns(mass=[0.4], distance=[d], magnitude=[18.5]), "published", cut=cut)
        for d, cut in ((400.0, 0.05), (1000.0, 0.02))
    )
    np.testing.assert_allclose(separation_moments(near), separation_moments(far), rtol=1e-12)


def test_companions_that_do_not_shine_add_nothing():
    star = Stars.from_columns(mass=[0.08], distance=[100], magnitude=[18.5])
    found = integrate(of(star, "published"))
    np.testing.assert_array_equal(found.coefficient[:, 0, 1:], 0)
    assert found.mean[0, 0] == 0
