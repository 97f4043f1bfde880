"""Stars rejected by their own shape: what a pair changes, and what noise makes of it."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.special import ndtr

from porrima.clip import Clip, Noise, OwnShape, own_shape, score, shape_grid
from porrima.errors import InputError
from porrima.integrals import _log_moments
from porrima.multiplicity import MULTIPLICITY
from porrima.photometry import PHOTOMETRY, flux_ratio
from porrima.prediction import integrate, population_moments
from porrima.psf import psf_from_name
from porrima.response import response
from porrima.shapes import Adaptive, Plain
from porrima.systems import Population
from statistics_helpers import assert_within_sigma

R = np.array([0.0, 0.01, 0.03, 0.05, 0.05])
F = np.array([1.0, 0.5, 0.2, 1.0, 0.0])


@pytest.fixture(scope="module")
def plain():
    return response(psf_from_name("psf0"), Plain())


@pytest.fixture(scope="module")
def adaptive():
    return response(psf_from_name("psf0"), Adaptive())


@pytest.fixture(scope="module")
def few(stars):
    models = {"multiplicity": MULTIPLICITY["dk13"], "photometry": PHOTOMETRY["main-sequence"]}
    return Population.of(stars.take(np.arange(60)), **models)


def moments(population, selection):
    chosen = replace(population, selection=selection)
    return population_moments(chosen, integrate(chosen), np.array([0.35]))


def test_the_plain_size_of_a_pair_grows_by_x(plain):
    own = own_shape(plain, "r2", R, F)
    assert own.mean == pytest.approx(F * R**2 / (1 + F) ** 2 / float(plain.shape0.r2), abs=1e-12)
    assert own.spread == pytest.approx(0, abs=1e-12)


def test_the_plain_ellipticity_of_a_pair_is_x_over_the_size_of_both(plain):
    x = F * R**2 / (1 + F) ** 2
    assert own_shape(plain, "e", R, F).mean == pytest.approx(x / (float(plain.shape0.r2) + x), abs=1e-12)


def test_behind_a_psf_that_is_not_round_the_change_depends_on_the_position_angle():
    own = own_shape(response(psf_from_name("psf1"), Adaptive()), "r2", np.array([0.04]), np.array([0.5]))
    assert 1e-4 < own.spread[0] / own.mean[0] < 0.05


def test_a_clip_without_noise_is_sharp_at_its_threshold(plain):
    t = 0.01
    edge = np.sqrt(4 * t * float(plain.shape0.r2))  # of equal stars
    clip = Clip(response=plain, threshold=t)
    r = edge * np.array([0.999, 0.99999, 1.00001, 1.001])
    assert clip.rejected(r, np.ones(4), np.full(4, 18.0)) == pytest.approx([0, 0, 1, 1])


def test_noise_blurs_the_edge_by_the_normal_law(plain):
    noise = Noise(magnitude=(18.0, 20.0), sigma=(0.001, 0.01))
    clip = Clip(response=plain, threshold=0.008, noise=noise)
    m = np.array([18.0, 19.0, 20.0, 20.0])
    f, r = np.array([0.5, 1.0, 0.3, 0.0]), np.array([0.02, 0.02, 0.03, 0.03])
    u = f * r**2 / (1 + f) ** 2 / float(plain.shape0.r2)
    expected = ndtr((u - 0.008) / np.array([0.001, 0.001 * np.sqrt(10), 0.01, 0.01]))
    assert clip.rejected(r, f, m) == pytest.approx(expected, rel=1e-6)


def test_the_length_of_a_noisy_ellipticity_follows_the_law_of_rice():
    rng = np.random.Generator(np.random.Philox(3))
    for length, sigma in ((0.0, 0.003), (0.004, 0.003), (0.009, 0.002), (0.0079, 0.0001)):
        own = OwnShape(np.array([length]), np.zeros(1))
        found = ndtr(score(own, "e", 0.008, np.array([sigma])))[0]
        drawn = np.hypot(*(np.array([[length], [0]]) + sigma * rng.standard_normal((2, 400_000)))) > 0.008
        assert_within_sigma(drawn.mean(), found, np.sqrt(found * (1 - found) / drawn.size))


@pytest.mark.parametrize("quantity", ["r2", "e"])
def test_a_little_noise_is_like_none(adaptive, few, quantity):
    sharp, blurred = (
        moments(few, Clip(response=adaptive, threshold=0.01, quantity=quantity, noise=Noise(sigma=(s,))))
        for s in (0.0, 1e-6)
    )
    assert blurred.mean_x == pytest.approx(sharp.mean_x, rel=1e-5)


def test_the_error_of_the_quadrature_is_as_large_as_it_says(plain, few):
    """Against pairs taken on a fine grid of mass ratio and orbit, for plain moments, whose edge is known in x."""
    some = replace(few, law=replace(few.law, log_a_max=np.full(60, np.inf)))
    t = 0.006
    found = moments(some, Clip(response=plain, threshold=t))
    direct = _by_brute_force(some, t * float(plain.shape0.r2))
    for name, power in (("mean_x", 1), ("mean_x2", 2)):
        expected = direct[power]
        assert getattr(found, name)[0] == pytest.approx(expected, rel=max(found.relative_error[0], 2e-5))
    assert found.relative_error[0] < 2e-3


def _by_brute_force(population, x_max, n_q=2048):
    """Means of the powers of x of the stars kept: a sharp edge in x, exact in the orbit for each orientation."""
    law, stars = population.law, population.stars
    pair = np.minimum(1, population.scale(np.array([0.35]))[0] * law.multiplicity_fraction)
    sums, kept = np.zeros(3), 0.0
    for s in range(len(stars)):
        g = law.mass_ratio_exponent[s] + 1
        u = (np.arange(n_q) + 0.5) / n_q
        q = (law.mass_ratio_min[s] ** g + u * (1 - law.mass_ratio_min[s] ** g)) ** (1 / g)
        one = replace(
            population.tracks, index=population.tracks.index[[s]], weight=population.tracks.weight[[s]]
        )
        f = flux_ratio(one, stars.mass[[s]], q[None, :])[0]
        y = f / (1 + f) ** 2
        r = np.minimum(np.sqrt(x_max / np.maximum(y, 1e-300)), population.cut)
        place = np.log10(r * stars.distance[s]) - law.log_a[s]
        below = np.exp(_log_moments(law.log_a_sigma[s], np.inf, "isotropic", place, 0)[:, :3])
        powers = np.array([np.mean(below[:, k] * (y * r**2) ** k) for k in range(3)])
        sums += pair[s] * powers
        kept += 1 - pair[s]
    return sums / (kept + sums[0])


@pytest.mark.parametrize(
    ("options", "message"),
    [({"threshold": 0.0}, "clip must be in"), ({"threshold": 0.3}, "clip must be in"),
     ({"threshold": 0.01, "quantity": "e3"}, "quantity must be r2 or e")],
)  # fmt: skip
def test_a_clip_out_of_range_is_refused(plain, options, message):
    with pytest.raises(ValueError, match=message):
        Clip(response=plain, **options)


@pytest.mark.parametrize(
    ("magnitude", "sigma"),
    [((18, 19), (0.1,)), ((19, 18), (0.1, 0.2)), ((18, 19), (0.1, 0)), ((), ()), ((1,), (-1,))],
)
def test_noise_that_does_not_fit_its_magnitudes_is_refused(magnitude, sigma):
    with pytest.raises(ValueError, match="noise must"):
        Noise(magnitude=magnitude, sigma=sigma)


def test_a_star_without_a_noise_of_its_own_is_refused():
    with pytest.raises(InputError, match=r"not from 18 to 19 alone, got a star of 19\.6"):
        Noise(magnitude=(18, 19), sigma=(0.1, 0.2)).at(np.array([18.5, 19.6]))


def test_a_cut_too_wide_for_kernel_moments_is_refused(adaptive):
    with pytest.raises(
        InputError, match="cut: is too wide to clip stars by their shape behind psf0: at most"
    ):
        shape_grid(adaptive, "r2", np.linspace(0, 0.3, 31), np.linspace(0, 1, 5))


def test_a_size_beyond_what_is_followed_grows_on(adaptive):
    grid = shape_grid(adaptive, "r2", np.linspace(0, 0.06, 13), np.array([0.0, 0.5, 1.0]))
    assert np.all(np.isfinite(grid.mean))
    assert np.all(np.diff(grid.mean[1:], axis=1) > 0)
