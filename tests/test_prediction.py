import dataclasses
import itertools

import numpy as np
import pytest
from scipy.integrate import quad
from scipy.special import beta, betainc

from porrima import prediction
from porrima.moments import INDICES
from porrima.multiplicity import DucheneKraus2013
from porrima.photometry import PHOTOMETRY, HabetsHeintze1981, flux_ratio
from porrima.prediction import integrate, population_moments, predict
from porrima.psf import psf_from_name
from porrima.response import response
from porrima.shapes import estimator_from_name
from porrima.stack import draw_stacks
from porrima.stars import Stars
from porrima.systems import Population
from statistics_helpers import assert_within_sigma

MODELS = {
    "published": DucheneKraus2013(),
    "kcm16": DucheneKraus2013(gap_rule="solar", a_max_factor=2.5),
    "literal": DucheneKraus2013(projection="inclination-uniform"),
}


def plain(psf="psf1"):
    return response(psf_from_name(psf), estimator_from_name("plain"))


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
    assert integrals.unresolved[0] == pytest.approx(over_separation(0), rel=3e-5)
    assert integrals.mean[0, 0] == pytest.approx(over_mass_ratio(c2) * over_separation(2), rel=3e-5)
    assert integrals.product[0, 0] == pytest.approx(
        over_mass_ratio(lambda q: c2(q) ** 2) * over_separation(4), rel=3e-5
    )


@pytest.mark.parametrize("model", MODELS)
def test_the_quadrature_has_converged(stars, model, monkeypatch):
    population = Population.of(stars, multiplicity=MODELS[model], photometry=PHOTOMETRY["main-sequence"])
    coarse = integrate(population)
    nodes = np.polynomial.legendre.leggauss(1500)
    t = 0.25 * np.pi * (nodes[0] + 1)
    if model != "literal":
        monkeypatch.setattr(
            prediction, "projection_nodes", lambda _: (np.cos(t), 0.25 * np.pi * nodes[1] * np.cos(t))
        )
    monkeypatch.setattr(prediction, "_MASS_RATIO_PANELS", 2000)
    monkeypatch.setattr(prediction, "_DISTANCE_STEP", 0.002)
    fine = integrate(population)
    bright = stars.mass > 0.1  # below, hardly any companion shines
    np.testing.assert_allclose(coarse.unresolved, fine.unresolved, rtol=2e-5)
    np.testing.assert_allclose(coarse.mean[bright], fine.mean[bright], rtol=5e-4)
    for name in ("mean", "product"):
        a, b = (getattr(i, name).sum(axis=0) for i in (coarse, fine))
        np.testing.assert_allclose(a, b, rtol=1e-4)


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


def test_plain_predictions_are_the_closed_forms(population):
    """Eqs. 7-12 of the paper and the closed form at finite N, with the second order of the bias written out."""
    moments = population_moments(population, integrate(population), np.array([0.2, 0.6]))
    reply = plain()
    e, r2 = np.array([reply.shape0.e1, reply.shape0.e2]), float(reply.shape0.r2)
    mean, square = moments.mean_x, moments.mean_x2
    variance = square - mean**2
    for n in (1, 40, None):
        found = predict(moments, reply, n)
        per = 0 if n is None else 1 / n
        eta = mean / r2
        np.testing.assert_allclose(found.eta, eta, rtol=1e-12)
        np.testing.assert_allclose(found.bias[2], eta, rtol=1e-9)
        np.testing.assert_allclose(found.sd[2], np.sqrt(variance * per) / r2, rtol=1e-9)
        second = eta**2 + variance * per / r2**2
        np.testing.assert_allclose(found.bias[:2], -e[:, None] * (eta - second), rtol=1e-7)
        sd = np.sqrt((square / 2 + e[:, None] ** 2 * variance) * per) / r2
        np.testing.assert_allclose(found.sd[:2], sd, rtol=4 * eta.max(), atol=1e-12)
        np.testing.assert_allclose(found.sigma, np.hypot(found.bias, found.sd))


def test_a_round_psf_stays_round(population):
    moments = population_moments(population, integrate(population), np.array([0.35]))
    for estimator in ("plain", "adaptive"):
        found = predict(moments, response(psf_from_name("psf0"), estimator_from_name(estimator)), 40)
        np.testing.assert_allclose(found.bias[:2], 0, atol=1e-12)
        assert found.sd[0] == pytest.approx(found.sd[1], rel=1e-9)


def test_the_scatter_falls_as_the_root_of_n(population):
    moments = population_moments(population, integrate(population), np.array([0.35]))
    sd = [predict(moments, plain(), n).sd for n in (10, 1000)]
    np.testing.assert_allclose(sd[0], 10 * sd[1], rtol=1e-12)
    assert np.all(predict(moments, plain(), None).sd == 0)


@pytest.mark.parametrize("estimator", ["plain", "adaptive", "gaussian:0.1"])
@pytest.mark.parametrize("n_stars", [40, 1000])
def test_bias_and_scatter_against_simulated_stacks(population, estimator, n_stars):
    fraction, n_stacks = 0.35, 20_000
    moments = population_moments(population, integrate(population), np.array([fraction]))
    stacks = draw_stacks(
        population, n_stars=n_stars, binary_fraction=fraction, seed=4, first=0, last=n_stacks
    )
    for psf in ("psf0", "psf1", "psf2"):
        reply = response(psf_from_name(psf), estimator_from_name(estimator))
        found = predict(moments, reply, n_stars)
        shape = reply.shapes(stacks.moments)
        for q, name in enumerate(("e1", "e2", "r2")):
            zero = float(getattr(reply.shape0, name))
            change = (np.asarray(getattr(shape, name)) - zero) / (zero if name == "r2" else 1)
            centred = change - change.mean()
            assert_within_sigma(change.mean(), found.bias[q, 0], change.std() / np.sqrt(n_stacks))
            error = np.sqrt(((centred**4).mean() - change.var() ** 2) / n_stacks) / (2 * change.std())
            assert_within_sigma(change.std(), found.sd[q, 0], error)


@pytest.mark.parametrize("fraction", [0.35, 0.9])
def test_stacks_weighted_by_flux_against_simulated_ones(stars, fraction):
    models = {"multiplicity": DucheneKraus2013(), "photometry": PHOTOMETRY["main-sequence"]}
    population = Population.of(stars, stack_weight="flux", **models)
    moments = population_moments(population, integrate(population), np.array([fraction]))
    assert 0.8 < moments.effective_share[0] < 1
    n_stars, n_stacks = 200, 20_000
    stacks = draw_stacks(
        population, n_stars=n_stars, binary_fraction=fraction, seed=4, first=0, last=n_stacks
    )
    found = predict(moments, plain(), n_stars)
    change = stacks.moments.values[:, 0] + stacks.moments.values[:, 2]
    assert_within_sigma(change.mean(), found.bias[2, 0] * found.r2_0, change.std() / np.sqrt(n_stacks))
    error = np.sqrt((((change - change.mean()) ** 4).mean() - change.var() ** 2) / n_stacks) / (
        2 * change.std()
    )
    assert_within_sigma(change.std(), found.sd[2, 0] * found.r2_0, error)


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


def test_stars_integrated_in_parts_are_the_same(population, monkeypatch):
    whole = integrate(population)
    monkeypatch.setattr(prediction, "_CHUNK", 7)
    for field in dataclasses.fields(whole):
        np.testing.assert_allclose(
            getattr(integrate(population), field.name), getattr(whole, field.name), rtol=1e-14
        )


def test_a_cut_beyond_the_series_gives_no_number(stars):
    models = {"multiplicity": DucheneKraus2013(), "photometry": PHOTOMETRY["main-sequence"]}
    wide = Population.of(stars, cut=0.3, **models)
    moments = population_moments(wide, integrate(wide), np.array([0.35]))
    adaptive = response(psf_from_name("psf1"), estimator_from_name("adaptive"))
    assert np.all(np.isnan(predict(moments, adaptive, 40).bias))
    assert np.all(np.isfinite(predict(moments, plain(), 40).sd))


def test_a_stack_needs_a_star(population):
    moments = population_moments(population, integrate(population), np.array([0.35]))
    with pytest.raises(ValueError, match="n_stars must be at least 1, got 0"):
        predict(moments, plain(), 0)
