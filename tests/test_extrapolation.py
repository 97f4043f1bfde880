import itertools

import numpy as np
import pytest

from porrima.errors import InputError
from porrima.extrapolation import best_split, extrapolate, forecast, sample_covariance
from porrima.moments import INDICES
from porrima.multiplicity import MULTIPLICITY
from porrima.photometry import PHOTOMETRY
from porrima.prediction import integrate, population_moments, predict
from porrima.psf import psf_from_name
from porrima.response import response
from porrima.samples import clipped
from porrima.shapes import Adaptive, Plain
from porrima.stack import draw_stacks
from porrima.systems import Population
from statistics_helpers import assert_within_sigma

LIGHT = PHOTOMETRY["main-sequence"]
CHANGE = np.array([[-4e-5, 1e-5, 5e-6], [-3e-5, 1e-5, 4e-6], [-1e-5, 0.0, 1e-6]])
TRUE = np.array([0.05, -0.01, 6.8e-3])


def covariance(rng, k=3, q=3):
    root = rng.normal(size=(k * q, 2 * k * q)) * 1e-6
    return root @ root.T


def test_shapes_made_of_a_true_one_and_changes_give_it_back():
    found = extrapolate(TRUE + 0.7 * CHANGE, CHANGE, covariance(np.random.default_rng(1)))
    assert found.shape == pytest.approx(TRUE, rel=1e-9)
    assert found.amplitude == pytest.approx(0.7, rel=1e-6)
    assert found.chi2 == pytest.approx(0.0, abs=1e-6)
    assert found.n_dof == 5
    assert found.residual == pytest.approx(np.zeros((3, 3)), abs=1e-11)


def test_two_samples_are_a_straight_line():
    """Written out: y0 = (s2 y1 - s1 y2)/(s2 - s1), with its error."""
    (s1, s2), (y1, y2), (v1, v2) = (4e-6, 1e-6), (6.8046e-3, 6.8009e-3), (1e-12, 3e-12)
    found = extrapolate(np.array([[y1], [y2]]), np.array([[s1], [s2]]), np.diag([v1, v2]))
    assert found.shape[0] == pytest.approx((s2 * y1 - s1 * y2) / (s2 - s1), rel=1e-12)
    assert found.amplitude == pytest.approx((y1 - y2) / (s1 - s2))
    assert found.error[0] == pytest.approx(np.sqrt(s2**2 * v1 + s1**2 * v2) / abs(s2 - s1))
    assert found.amplitude_error == pytest.approx(np.sqrt(v1 + v2) / abs(s1 - s2))


def test_an_error_that_is_a_factor_on_all_changes_goes_to_the_amplitude_alone():
    spread = covariance(np.random.default_rng(2))
    without, with_error = (forecast(CHANGE, spread, error) for error in (None, 0.4 * CHANGE[None]))
    assert with_error[:3, :3] == pytest.approx(without[:3, :3], rel=1e-6)
    assert with_error[3, 3] == pytest.approx(without[3, 3] + 0.4**2, rel=1e-6)


def test_any_other_error_of_the_model_costs_precision():
    spread = covariance(np.random.default_rng(3))
    one_sample_wrong = np.array([[[0.0, 0.0, 1e-5], [0.0, 0.0, 0.0], [0.0, 0.0, 0.0]]])
    assert forecast(CHANGE, spread, one_sample_wrong)[2, 2] > 1.01 * forecast(CHANGE, spread)[2, 2]


@pytest.mark.parametrize("n", [1, 3])
def test_the_best_split_is_better_than_any_other(n):
    rng = np.random.default_rng(n)
    change, sd = rng.uniform(1, 5, 3), rng.uniform(1, 3, 3)
    best = best_split(change, sd)
    assert best.share.sum() == pytest.approx(1)
    errors = []
    for i, j in itertools.product(range(1, 40), repeat=2):
        if i + j < 40:
            share = np.array([i, j, 40 - i - j]) / 40
            errors.append(forecast(change[:, None], np.diag(sd**2 / share))[0, 0] ** 0.5)
    assert best.error <= min(errors) * (1 + 1e-9)
    used = best.share > 0
    own = forecast(change[used][:, None], np.diag(sd[used] ** 2 / best.share[used]))[0, 0] ** 0.5
    assert own == pytest.approx(best.error, rel=1e-9)


def test_what_cannot_be_extrapolated_is_said():
    with pytest.raises(InputError, match="at least 2"):
        extrapolate(TRUE[None], CHANGE[:1], np.eye(3))
    with pytest.raises(InputError, match="must differ in the predicted change"):
        extrapolate(np.ones((2, 1)), np.full((2, 1), 3e-6), np.eye(2))
    with pytest.raises(InputError, match="must differ"):
        best_split(np.full(3, 2.0), np.ones(3))
    with pytest.raises(InputError, match="n_stars"):
        sample_covariance(np.ones((2, 1, 1)), np.array([0, 3]))


@pytest.fixture(scope="module")
def reply():
    return response(psf_from_name("psf1"), Plain())


def test_clipped_samples_that_share_stars_have_the_covariance_and_the_fit_its_forecast(stars, reply):
    """Brute force: a million and a half stars drawn one by one, clipped by their own size, in stacks of 500."""
    n_stars, n_stacks = 500, 3000
    population = Population.of(stars, multiplicity=MULTIPLICITY["dk13"], photometry=LIGHT, cut=0.05)
    thresholds = np.array([0.004, 0.012, np.inf])
    law = clipped(population, reply, thresholds)
    r2 = float(reply.shape0.r2)
    each = draw_stacks(
        population, n_stars=1, binary_fraction="model", seed=5, first=0, last=n_stars * n_stacks
    )
    xx, yy = (each.moments.values[:, INDICES.index(powers)] for powers in ((2, 0), (0, 2)))
    added = ((xx + yy) / r2).reshape(n_stacks, n_stars)
    kept = added[None] <= thresholds[:, None, None]
    number = kept.sum(axis=2)
    means = np.where(kept, added, 0.0).sum(axis=2) / number  # (threshold, stack)
    share = kept.mean(axis=(1, 2))
    assert_within_sigma(
        1 - share, law.removed, np.sqrt(law.removed + 1e-7) / np.sqrt(n_stars * n_stacks) + 2e-4
    )
    assert means.mean(axis=1) == pytest.approx(law.eta, rel=0.02)  # cells of the law cut x to some per cent
    drawn = np.array([added[k].mean() for k in kept]), np.array([added[k].var() for k in kept])
    assert np.sqrt(drawn[1]) == pytest.approx(law.sd, rel=0.03)
    n = np.round(n_stars * share).astype(int)
    closed = sample_covariance(drawn[1][:, None, None], n, nested=True)
    moved = means - means.mean(axis=1)[:, None]
    products = moved[:, None] * moved[None]
    assert_within_sigma(products.mean(axis=2), closed, products.std(axis=2) / np.sqrt(n_stacks))
    # and the fit: the true size without bias, with the scatter of the forecast
    change = drawn[0][:, None]
    fitted = np.array([extrapolate(1.0 + y[:, None], change, closed).shape[0] for y in means.T]) - 1.0
    expected = forecast(change, closed)[0, 0]
    assert_within_sigma(fitted.mean(), 0.0, np.sqrt(expected / n_stacks))
    squares = (fitted - fitted.mean()) ** 2
    assert_within_sigma(squares.mean(), expected, squares.std() / np.sqrt(n_stacks))


def test_samples_of_three_magnitudes_give_the_true_shape_with_the_forecast_error(stars):
    """Brute force: the engine's stacks of three samples, each star once, fitted stack by stack."""
    reply, n_stacks = response(psf_from_name("psf1"), Adaptive()), 3000
    n_stars = np.array([300, 200, 500])
    parts = [
        stars.take(np.flatnonzero((stars.mass >= lo) & (stars.mass < lo + 0.4))) for lo in (0.08, 0.4, 0.8)
    ]
    true = np.array([float(v) for v in (reply.shape0.e1, reply.shape0.e2, reply.shape0.r2)])
    measured = np.empty((n_stacks, 3, 3))
    change, per_star, unit = np.empty((3, 3)), np.empty((3, 3, 3)), np.array([1.0, 1.0, true[2]])
    for k, part in enumerate(parts):
        population = Population.of(part, multiplicity=MULTIPLICITY["dk13"], photometry=LIGHT)
        drawn = draw_stacks(
            population, n_stars=int(n_stars[k]), binary_fraction="model", seed=k, first=0, last=n_stacks
        )
        found = predict(population_moments(population, integrate(population)), reply, int(n_stars[k]))
        change[k] = found.bias[:, 0] * unit
        per_star[k] = found.covariance[:, :, 0] * np.outer(unit, unit) * n_stars[k]
        shape = reply.shapes(drawn.moments)
        measured[:, k] = np.stack([shape.e1, shape.e2, shape.r2], axis=1)
    spread = sample_covariance(per_star, n_stars)
    fits = [extrapolate(y, change, spread) for y in measured]
    expected = forecast(change, spread)
    found = np.array([[*fit.shape, fit.amplitude] for fit in fits])
    assert_within_sigma(found.mean(axis=0), [*true, 1.0], np.sqrt(np.diag(expected) / n_stacks))
    squares = (found - found.mean(axis=0)) ** 2
    assert_within_sigma(squares.mean(axis=0), np.diag(expected), squares.std(axis=0) / np.sqrt(n_stacks))
    chi2 = np.array([fit.chi2 for fit in fits])
    assert fits[0].n_dof == 5
    assert_within_sigma(chi2.mean(), 5, chi2.std() / np.sqrt(n_stacks))
