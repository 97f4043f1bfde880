import numpy as np
import pytest
from scipy.stats import binom

from porrima.multiplicity import MULTIPLICITY, ROW_ERRORS
from porrima.photometry import PHOTOMETRY
from porrima.psf import psf_from_name
from porrima.shapes import Adaptive
from porrima.systems import Population
from porrima.trials import coverage, draw_wrong, trials
from porrima.uncertainty import CUT_ERROR
from statistics_helpers import assert_within_sigma

MODEL = MULTIPLICITY["dk13"]


@pytest.fixture(scope="module")
def bins(stars):
    """The stars, and others twice as far away, which companions change less."""
    far = np.flatnonzero(stars.distance > np.median(stars.distance))
    return [((18.0, 19.0), stars), ((20.0, 21.0), stars.take(far))]


@pytest.fixture(scope="module")
def done(bins):
    return trials(bins, psf_from_name("psf1"), Adaptive(), MODEL, n_stars=500, n_trials=250, seed=11)


def test_figures_are_drawn_with_their_published_errors():
    rng = np.random.Generator(np.random.Philox(4))
    drawn = [draw_wrong(MODEL, rng) for _ in range(2000)]
    down, up = ROW_ERRORS[0].multiplicity_fraction
    values = np.array([w.figures[0, "multiplicity_fraction"] for w in drawn])
    for part, sd in ((values[values < 0], down), (values[values > 0], up)):
        assert_within_sigma(np.mean(part**2), sd**2, np.sqrt(2 / part.size) * sd**2)
    assert_within_sigma(np.std([w.cut for w in drawn]), CUT_ERROR, CUT_ERROR / np.sqrt(4000))


def test_a_wrong_figure_is_applied_to_its_row_alone(population):
    wrong = draw_wrong(MODEL, np.random.Generator(np.random.Philox(4)))
    other = wrong.applied(population, MODEL)
    row = MODEL.rows(population.stars.mass)
    for number in np.unique(row):
        change = (other.law.log_a - population.law.log_a)[row == number]
        assert change == pytest.approx(wrong.figures[number, "log_a"])
    assert other.cut == pytest.approx(population.cut * wrong.cut)


def test_corrections_end_within_their_forecast_error_in_95_of_100_cases(done):
    """Binomial test of each quantity and range: fewer or more than 1e-5 of honest forecasts would be."""
    found = coverage(done)
    n = done.sizes["trial"]
    low, high = binom.ppf([1e-5, 1 - 1e-5], n, 0.95) / n
    for inside in (found["inside"], found["extrapolated_inside"]):
        assert np.all(inside >= low)
        assert np.all(inside <= max(high, 0.99))


def test_a_correction_takes_off_the_bias_and_forecasts_what_is_left(done):
    size = done.sel(quantity="r2")
    before, after = size["before"], size["after"]
    assert np.all(abs(after.mean("trial")) < 0.15 * before.mean("trial"))
    found = coverage(done).sel(quantity="r2")
    assert np.all(found["after"] < 0.6 * found["before"])
    assert found["forecast"].to_numpy() == pytest.approx(found["after"].to_numpy(), rel=0.15)
    assert np.all(size["model"] ** 2 + size["scatter"] ** 2 <= 1.5 * size["up"] ** 2)


def test_drawn_images_give_the_residuals_of_kernel_moments(bins):
    options = {"n_stars": 60, "n_trials": 2, "seed": 3}
    psf = psf_from_name("psf1")
    moments, images = (
        trials(bins, psf, Adaptive(), MODEL, method=m, **options) for m in ("moments", "images")
    )
    for name in ("before", "after", "extrapolated"):
        assert images[name].to_numpy() == pytest.approx(moments[name].to_numpy(), abs=2e-6)
    assert images.attrs["method"] == "images"


def test_trials_that_are_told_of_are_counted(bins):
    told = []
    trials(
        bins[:], psf_from_name("psf0"), Adaptive(), MODEL, n_stars=5, n_trials=3, seed=1, progress=told.append
    )
    assert told == [1, 1, 1]


def test_populations_of_the_trials_are_those_of_the_model(stars):
    population = Population.of(stars, multiplicity=MODEL, photometry=PHOTOMETRY["main-sequence"])
    assert draw_wrong(MODEL, np.random.default_rng(1)).applied(population, MODEL).stars is population.stars
