"""Peers are honest: the population of the engine, the shapes of the response, and a pixel effect that is stated."""

import numpy as np
import pytest

from porrima.moments import KernelMoments, moments_of_points
from porrima.multiplicity import DucheneKraus2013
from porrima.peers import PEERS, Companions, Pairs, convolved, hsm
from porrima.photometry import PHOTOMETRY
from porrima.prediction import integrate, population_moments, predict
from porrima.psf import psf_from_name
from porrima.response import response
from porrima.shapes import Adaptive
from porrima.systems import Population
from statistics_helpers import assert_within_sigma

FRACTION = 0.35
NO_PAIRS = Pairs(
    n_stacks=1, n_stars=1, **dict.fromkeys(("stack", "flux_ratio", "dx", "dy"), np.empty(0, int))
)


@pytest.fixture(scope="module")
def companions(population):
    return Companions.of(population, FRACTION)


@pytest.fixture(scope="module")
def expected(population):
    return population_moments(population, integrate(population), np.array([FRACTION]))


@pytest.fixture
def rng():
    return np.random.default_rng(7)


def moments_of(pairs, to_pixels=0.0):
    """Mean kernel moments of each stack; of the sources in the middle of the nearest pixel where one is given."""
    primary = 1 / (1 + pairs.flux_ratio)
    flux = np.stack([primary, pairs.flux_ratio * primary], axis=1)
    place = [np.stack([-flux[:, 1] * d, flux[:, 0] * d], axis=1) for d in (pairs.dx, pairs.dy)]
    if to_pixels:
        place = [to_pixels * np.rint(p / to_pixels) for p in place]
    each = moments_of_points(flux, *place)
    sums = np.zeros((pairs.n_stacks, each.shape[1]))
    np.add.at(sums, pairs.stack, each)
    return sums / pairs.n_stars


def size_changes(psf, values, n_stars=40):
    reply = response(psf, Adaptive())
    return reply.shapes(KernelMoments(values=values, n_stars=n_stars)).r2 / reply.shape0.r2 - 1


def test_companions_drawn_with_numpy_have_the_moments_of_quadrature(companions, expected, rng):
    n = 1_000_000
    pairs = companions.draw(1, n, rng)
    x = pairs.flux_ratio / (1 + pairs.flux_ratio) ** 2 * (pairs.dx**2 + pairs.dy**2)
    p = float(expected.unresolved_fraction[0])
    assert_within_sigma(x.size / n, p, np.sqrt(p * (1 - p) / n))
    for power, mean in ((1, expected.mean_x[0]), (2, expected.mean_x2[0])):
        assert_within_sigma((x**power).sum() / n, mean, np.sqrt((x ** (2 * power)).sum()) / n)
    values = moments_of(pairs)[0]
    assert abs(values[0] - values[2]) < 5 * np.sqrt((x**2).sum()) / n


@pytest.mark.parametrize(("n_stacks", "n_stars"), [(1, 1), (3, 40), (50, 7)])
def test_a_stack_has_exactly_its_stars_and_no_resolved_pair(companions, rng, n_stacks, n_stars):
    pairs = companions.draw(n_stacks, n_stars, rng)
    assert np.all(np.diff(pairs.stack) >= 0)
    assert np.all(np.bincount(pairs.stack, minlength=n_stacks) <= n_stars)
    assert np.all(np.hypot(pairs.dx, pairs.dy) < companions.cut)
    assert np.all((pairs.flux_ratio >= 0) & (pairs.flux_ratio <= 1))


@pytest.mark.parametrize("psf_name", ["psf1", "optical1"])
@pytest.mark.parametrize(("peer", "n_stacks"), [("galsim-stars", 3), ("galsim-sum", 20), ("fft", 100)])
def test_each_peer_measures_what_the_response_gives_for_its_own_pairs(
    companions, rng, psf_name, peer, n_stacks
):
    psf = psf_from_name(psf_name)
    pairs = companions.draw(n_stacks, 40, rng)
    without = PEERS[peer](psf, NO_PAIRS)[0, 2]
    measured = PEERS[peer](psf, pairs)[:, 2] / without - 1
    to_pixels = psf.scale if peer == "fft" else 0.0
    assert measured == pytest.approx(
        size_changes(psf, moments_of(pairs, to_pixels)), abs=2e-5
    )  # HSM stops there


@pytest.mark.parametrize("psf_name", ["psf1", "optical1"])
@pytest.mark.parametrize(("peer", "n_stacks"), [("galsim-stars", 20), ("galsim-sum", 150), ("fft", 600)])
def test_the_mean_size_bias_of_each_peer_is_that_of_the_prediction(
    companions, expected, rng, psf_name, peer, n_stacks
):
    psf = psf_from_name(psf_name)
    pairs = companions.draw(n_stacks, 40, rng)
    change = PEERS[peer](psf, pairs)[:, 2] / PEERS[peer](psf, NO_PAIRS)[0, 2] - 1
    predicted = predict(expected, response(psf, Adaptive()), 40).bias[2, 0]
    moved = np.zeros(n_stacks)
    if peer == "fft":  # what the nearest pixel does, of the very same pairs
        moved = size_changes(psf, moments_of(pairs, psf.scale)) - size_changes(psf, moments_of(pairs))
    assert_within_sigma(np.mean(change - moved), predicted, np.std(change - moved) / np.sqrt(n_stacks))


@pytest.mark.parametrize("psf_name", ["psf1", "optical1"])
def test_the_nearest_pixel_changes_the_size_bias_by_a_few_per_cent(companions, rng, psf_name):
    psf = psf_from_name(psf_name)
    n_stacks = 500
    pairs = companions.draw(n_stacks, 1000, rng)
    exact = size_changes(psf, moments_of(pairs), 1000)
    moved = size_changes(psf, moments_of(pairs, psf.scale), 1000)
    effect = moved.mean() / exact.mean() - 1
    stderr = np.std(moved - exact) / np.sqrt(n_stacks) / exact.mean()
    assert 5 * stderr < effect < 0.12


def test_an_image_by_fft_holds_every_star_and_has_the_shape_of_the_psf(rng):
    psf = psf_from_name("psf1")
    (image,) = (image for batch in convolved(psf, NO_PAIRS) for image in batch)
    assert image.sum() == pytest.approx(1.0, rel=1e-9)
    single = psf.profile.drawImage(nx=128, ny=128, scale=psf.scale, method="no_pixel", dtype=float)
    assert PEERS["fft"](psf, NO_PAIRS)[0] == pytest.approx(hsm(single), rel=2e-6, abs=2e-7)


def test_another_law_of_companions_is_refused(stars):
    model = DucheneKraus2013(a_max_factor=2.5)
    other = Population.of(stars, multiplicity=model, photometry=PHOTOMETRY["main-sequence"])
    with pytest.raises(ValueError, match="full log-normal"):
        Companions.of(other, FRACTION)
