import numpy as np
import pytest

from porrima.distribution import pair_density
from porrima.integrals import integrate
from porrima.multiplicity import MULTIPLICITY, DucheneKraus2013
from porrima.photometry import PHOTOMETRY
from porrima.prediction import population_moments, predict
from porrima.psf import psf_from_name
from porrima.response import response
from porrima.samples import Fractions, clipped, one_choice_made, samples_of
from porrima.shapes import Plain
from porrima.systems import Population
from porrima.uncertainty import NAMES, uncertainty
from statistics_helpers import assert_within_sigma

MODEL, LIGHT = MULTIPLICITY["dk13"], PHOTOMETRY["main-sequence"]


@pytest.fixture(scope="module")
def reply():
    return response(psf_from_name("psf1"), Plain())


def predicted(stars, reply, n_stars=400, fraction=None):
    population = Population.of(stars, multiplicity=MODEL, photometry=LIGHT)
    return predict(population_moments(population, integrate(population), fraction), reply, n_stars)


def test_a_sample_changes_as_predicted_and_the_errors_of_the_model_add_to_its_scatter(stars, reply):
    n = np.array([400, 900])
    found = samples_of([stars, stars], reply, n, multiplicity=MODEL)
    own = predicted(stars, reply)
    r2 = float(reply.shape0.r2)
    assert found.change[:, 2] == pytest.approx(own.bias[2, 0] * r2, rel=0.1)  # but for the mean of the errors
    assert found.change[0] == pytest.approx(found.change[1], rel=1e-3)
    assert np.all(found.per_star[:, 2, 2] > own.covariance[2, 2, 0] * r2**2 * 400)
    assert found.per_star[0] == pytest.approx(found.per_star[1], rel=0.02)


def test_the_errors_of_one_sample_are_those_of_the_uncertainty(stars, reply):
    found = samples_of([stars], reply, np.array([400]), multiplicity=MODEL, choices=False)
    known = uncertainty(stars, reply, multiplicity=MODEL, photometry=LIGHT, n_stars=400)
    k = NAMES.index("bias_r2")
    parts = [(s.high[k] - s.low[k]) / 2 for s in known.sources if s.kind == "error"]
    linear = found.model_error[::2, 0, 2] / float(reply.shape0.r2)
    assert np.sqrt(np.sum(linear**2)) == pytest.approx(np.sqrt(np.sum(np.square(parts))), rel=0.05)


def test_an_error_of_the_model_moves_samples_alike_and_an_error_of_a_fraction_one_alone(stars, reply):
    fractions = Fractions(value=np.array([0.2, 0.5]), error=np.array([0.02, 0.03]))
    with_error, without = (
        samples_of(
            [stars, stars], reply, np.array([400, 400]), multiplicity=MODEL,
            fractions=Fractions(value=fractions.value, error=error),
        )
        for error in (fractions.error, np.zeros(2))
    )  # fmt: skip
    n = len(without.model_error) - 2
    assert np.all(without.model_error[n:] == 0)
    last = with_error.model_error[n:, :, 2]
    assert last[0, 1] == last[1, 0] == 0
    slope = [
        predicted(stars, reply, fraction=np.array([f + e])).bias[2, 0]
        - predicted(stars, reply, fraction=np.array([f - e])).bias[2, 0]
        for f, e in zip(fractions.value, fractions.error, strict=True)
    ]
    assert np.diag(last) == pytest.approx(0.5 * np.array(slope) * float(reply.shape0.r2), rel=1e-3)
    both = without.model_error[:n:2, :, 2]
    large = np.abs(both).max(axis=1) > 1e-8
    assert np.all(both[large, 0] * both[large, 1] > 0)


def test_each_choice_is_made_the_other_way_once():
    model = DucheneKraus2013()
    made = one_choice_made(model, LIGHT)
    changed = [(m.projection != model.projection, m.gap_rule != model.gap_rule, p != LIGHT) for m, p in made]
    assert changed == [(True, False, False), (False, True, False), (False, False, True)]


def test_without_a_threshold_a_clip_keeps_all_and_with_none_the_single_stars(population, reply):
    found = clipped(population, reply, np.array([1e-12, np.inf]))
    own = predict(population_moments(population, integrate(population)), reply, 1)
    assert found.removed[1] == pytest.approx(0.0, abs=1e-12)
    assert found.eta[1] == pytest.approx(own.bias[2, 0], rel=5e-3)
    assert found.sd[1] == pytest.approx(own.sd[2, 0], rel=1e-2)
    assert found.eta[0] == pytest.approx(0.0, abs=1e-12)


def test_clipped_means_are_those_of_pairs_drawn_from_the_same_cells(population, reply):
    threshold = np.array([0.004, 0.02])
    density = pair_density(population, integrate(population))
    rng = np.random.Generator(np.random.Philox(3))
    share = density.share.ravel()
    scale = population.cut**2 / (4 * float(reply.shape0.r2))
    size = scale * np.outer(density.four_y, density.square).ravel()
    n = 2_000_000
    pairs = rng.binomial(n, share.sum())
    drawn = np.concatenate([rng.choice(size, pairs, p=share / share.sum()), np.zeros(n - pairs)])
    found = clipped(population, reply, threshold)
    for k, limit in enumerate(threshold):
        kept = drawn[drawn <= limit]
        assert_within_sigma(1 - kept.size / n, found.removed[k], np.sqrt(found.removed[k] / n))
        assert_within_sigma(kept.mean(), found.eta[k], kept.std() / np.sqrt(kept.size))
