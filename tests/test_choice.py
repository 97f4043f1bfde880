"""The choice of stars: stars drawn, measured with noise, clipped and stacked one by one, and limits that must hold."""

from dataclasses import replace

import numpy as np
import pytest

from porrima.choice import THRESHOLDS, Plan, StarBin, choose, row_of, stacked
from porrima.clip import Noise
from porrima.clipping import clip_curve, count_pairs
from porrima.instruments import KCM16
from porrima.multiplicity import MULTIPLICITY
from porrima.own_sizes import _spread, own_sizes, sorting, together
from porrima.photometry import PHOTOMETRY
from porrima.prediction import integrate, population_moments, predict
from porrima.psf import psf_from_name
from porrima.response import response
from porrima.shapes import Adaptive
from porrima.stack import draw_stacks
from porrima.systems import Population
from porrima.truncation import kept_shapes
from statistics_helpers import assert_within_sigma

MAGNITUDE = (18.0, 19.0)
N_DRAWN = 1_000_000
COVARIANCE = np.array([[9.0, 0.0, 2.4], [0.0, 9.0, -1.2], [2.4, -1.2, 16.0]]) * 1e-6
PLAN = Plan(requirement=KCM16, area=0.5, exposures=(4,), threshold=THRESHOLDS)


@pytest.fixture(scope="module")
def reply():
    return response(psf_from_name("psf1"), Adaptive())


@pytest.fixture(scope="module")
def sorted_by(reply, population):
    return sorting(reply, population.cut)


@pytest.fixture(scope="module")
def sizes(population, sorted_by):
    return own_sizes(count_pairs(population), sorted_by, MAGNITUDE)


@pytest.fixture(scope="module")
def drawn(reply, population):
    """Stars one by one: own change of size, and what each adds to e1, e2 and R² over R0² of a stack."""
    moments = draw_stacks(
        population, n_stars=1, binary_fraction="model", seed=5, first=0, last=N_DRAWN
    ).moments
    own = reply.shapes(moments).r2 / float(reply.shape0.r2) - 1
    return own, moments.values @ (reply.first / [[1], [1], [float(reply.shape0.r2)]]).T


def noise_of(n, seed=1):
    rng = np.random.Generator(np.random.Philox(seed))
    return rng.multivariate_normal(np.zeros(3), COVARIANCE, n, method="cholesky")


def alike(sizes, covariance=COVARIANCE):
    return np.repeat(covariance[None], sizes.magnitude.size, axis=0)


def bin_of(sizes, covariance=COVARIANCE, magnitude=MAGNITUDE, per_deg2=1000.0):
    return StarBin(
        magnitude=magnitude, per_deg2=per_deg2, parts=(sizes,), covariance=alike(sizes, covariance)[None]
    )


def without_pairs(sizes):
    """The same stars, all single."""
    number = np.zeros_like(sizes.number)
    number[:, 0] = sizes.number.sum(axis=1)
    nothing = {name: np.zeros_like(getattr(sizes, name)) for name in ("added", "squared", "spread", "x")}
    return replace(sizes, number=number, **nothing)


def test_without_a_clip_or_noise_a_stack_is_as_predicted(population, reply, sizes):
    found = kept_shapes(sizes, alike(sizes, np.zeros((3, 3))), np.array([np.inf]))
    expected = predict(population_moments(population, integrate(population)), reply, 10_000)
    assert found.binaries[0] == pytest.approx(expected.bias[:, 0], rel=2e-3)
    assert np.sqrt(found.scatter[0] / 10_000) == pytest.approx(expected.sd[:, 0], rel=3e-3)


@pytest.mark.parametrize("model", ["dk13-kcm16", "offner23"])
def test_sizes_that_hardly_a_pair_has_are_numbers(stars, sorted_by, model):
    few = stars.take(np.arange(40))
    laws = {"multiplicity": MULTIPLICITY[model], "photometry": PHOTOMETRY["main-sequence"]}
    found = own_sizes(count_pairs(Population.of(few, **laws)), sorted_by, MAGNITUDE)
    squares = np.full(3, -1e-30), np.array([1e-20, 0.0, 1.0]), np.array([0.0, 0.1, 0.2])
    assert np.all((_spread(*squares) >= 0) & (_spread(*squares) <= squares[2]))
    assert np.all((found.spread >= 0) & (found.spread <= found.change))
    assert np.all(np.isfinite(stacked([bin_of(found)], PLAN).merit(KCM16)))


def test_a_clip_from_above_keeps_what_the_curve_of_clips_says(population, reply, sizes):
    t = np.array([0.005, 0.02, np.inf])
    found = kept_shapes(sizes, alike(sizes), t, "upper")
    expected = clip_curve(count_pairs(population), reply, t, noise=Noise(sigma=(4e-3,)))
    assert found.mean_x == pytest.approx(expected.mean_x, rel=2e-3)
    assert found.false_rejections == pytest.approx(expected.false_rejection_fraction, rel=2e-3, abs=1e-6)
    kept = found.share * sizes.total / sizes.number.sum()
    assert 1 - kept == pytest.approx(expected.rejected_fraction, rel=2e-3, abs=1e-9)


@pytest.mark.parametrize("independent", [False, True])
@pytest.mark.parametrize("sides", ["both", "upper"])
@pytest.mark.parametrize("threshold", [0.004, 0.012])
def test_stars_clipped_one_by_one_have_the_mean_and_scatter(sizes, drawn, sides, threshold, independent):
    own, added = drawn
    noise = noise_of(own.size)
    seen = own + (noise_of(own.size, 2) if independent else noise)[:, 2]
    kept = (seen <= threshold) & ((seen >= -threshold) | (sides == "upper"))
    found = kept_shapes(sizes, alike(sizes), np.array([threshold]), sides, independent)
    share = found.share[0] * sizes.total / sizes.number.sum()
    assert_within_sigma(kept.mean(), share, np.sqrt(share * (1 - share) / own.size))
    stars = (added + noise)[kept]
    error = stars.std(axis=0) / np.sqrt(len(stars))
    assert_within_sigma(stars.mean(axis=0), (found.binaries + found.clip)[0], error)
    assert_within_sigma(
        noise[kept].mean(axis=0), found.clip[0], noise[kept].std(axis=0) / np.sqrt(len(stars))
    )
    variance = (stars - stars.mean(axis=0)) ** 2
    error = variance.std(axis=0) / np.sqrt(len(stars))
    assert_within_sigma(
        variance.mean(axis=0), (found.scatter + found.noise)[0], error + 3e-3 * variance.mean(axis=0) / 5
    )


def iterated(own, added, noise, threshold):
    """Mean size of each stack (a row) of those of its stars that are within a threshold of that mean, solved for."""
    centre = np.zeros(len(own))
    for _ in range(60):
        kept = np.abs(own + noise - centre[:, None]) <= threshold
        new = (kept * (added + noise)).sum(axis=1) / kept.sum(axis=1)
        if np.max(np.abs(new - centre)) < 1e-8:
            break
        centre = new
    return new


@pytest.mark.parametrize("threshold", [0.006, 0.012])
def test_stacks_clipped_about_their_own_mean_have_the_bias_and_the_scatter(sizes, drawn, threshold):
    """500 stacks of 2000 stars, clipped again and again about what they give: 1/(1 - M') and its square."""
    own, added = (values.reshape(500, 2000, *values.shape[1:]) for values in drawn)
    noise = noise_of(N_DRAWN).reshape(500, 2000, 3)[..., 2]
    size = iterated(own, added[..., 2], noise, threshold)
    per_deg2 = 2000 / 0.5 * sizes.total / sizes.number.sum()
    one = stacked([bin_of(sizes, per_deg2=per_deg2)], replace(PLAN, threshold=np.array([threshold])))
    bias, sd = (one.binaries + one.clip)[0, 0, 0, 2], one.sd[0, 0, 0, 2]
    assert_within_sigma(size.mean(), bias, size.std() / np.sqrt(size.size) + 0.01 * abs(bias) / 5)
    assert_within_sigma(size.std(), sd, size.std() / np.sqrt(2 * size.size))
    fixed = stacked(
        [bin_of(sizes, per_deg2=per_deg2)], replace(PLAN, threshold=np.array([threshold]), centre="known")
    )
    assert fixed.sd[0, 0, 0, 2] < 0.97 * sd


def test_without_pairs_no_clip_is_best_and_the_merit_is_that_of_noise(sizes):
    choice = choose([bin_of(without_pairs(sizes))], PLAN)
    row = row_of(choice, choice.best)
    assert row["clip"] is None
    noise = np.sqrt(np.diag(COVARIANCE) / row["n_stars"]) / [KCM16.sigma_e, KCM16.sigma_e, KCM16.sigma_r2]
    assert row["merit"] == pytest.approx(noise.max(), rel=1e-3)
    assert np.all(choice.merit >= row["merit"] * (1 - 1e-9))


def test_a_known_centre_would_make_a_clip_into_the_noise_look_good(sizes):
    """What a clip about the stars' own mean is there for: the truncated noise has a smaller variance."""
    one = bin_of(without_pairs(sizes), np.diag([1e-12, 1e-12, 16e-6]))
    assert np.isinf(THRESHOLDS[choose([one], PLAN).best.clip])
    assert np.isfinite(THRESHOLDS[choose([one], replace(PLAN, centre="known")).best.clip])


def test_without_noise_the_tightest_clip_is_best(sizes):
    choice = choose([bin_of(sizes, np.zeros((3, 3)), per_deg2=1e6)], PLAN)
    assert choice.best.clip == THRESHOLDS.size - 1


def test_more_stars_never_hurt(sizes):
    merits = [choose([bin_of(sizes, per_deg2=n)], PLAN).merit for n in (100.0, 1000.0, 10_000.0)]
    assert np.all(merits[0] > merits[1])
    assert np.all(merits[1] > merits[2])
    choice = choose([bin_of(sizes, per_deg2=n) for n in (1000.0, 1000.0)], PLAN)
    assert choice.merit[1] == pytest.approx(choose([bin_of(sizes, per_deg2=2000.0)], PLAN).merit[0])


def test_two_alike_samples_are_as_good_as_one(sizes):
    both = together([sizes, sizes])
    assert both.number == pytest.approx(2 * sizes.number)
    assert both.spread == pytest.approx(sizes.spread)
    assert stacked([bin_of(both)], PLAN).merit(KCM16) == pytest.approx(
        stacked([bin_of(sizes)], PLAN).merit(KCM16)
    )


def test_inverse_variances_are_never_worse_where_there_is_noise_alone(sizes):
    single = without_pairs(sizes)
    bins = [bin_of(single, COVARIANCE * f, (m, m + 1), 1000) for m, f in ((18, 1), (19, 4), (20, 20))]
    plain, weighted = (choose(bins, replace(PLAN, weights=w)) for w in ("equal", "inverse-variance"))
    assert weighted.merit[..., 0].min() < plain.merit[..., 0].min()
    assert weighted.magnitude(weighted.best.stars) == (18, 21)
    expected = 1 / np.sqrt(sum(500 * single.number.sum() / single.total / f for f in (1, 4, 20)))
    assert weighted.stacks.sd[2, 0, 0, 0] == pytest.approx(3e-3 * expected, rel=1e-3)


def test_noise_that_is_too_large_for_a_clip_finds_nothing(sizes):
    loud = bin_of(sizes, COVARIANCE * 1e4)
    merit = choose([loud], PLAN).merit[0, 0]
    assert merit[0] < 100
    assert np.all(merit[-3:] > 100)
