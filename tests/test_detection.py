"""Detection of pairs: limits, scalings, and the best fit of one star found in another way."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.optimize import least_squares
from scipy.stats import ncx2

from porrima.detection import Detection, detection_probability, misfit, threshold
from porrima.exposure import EUCLID_VIS_WIDE
from porrima.pointings import dither_pattern, pointings
from porrima.psf import psf_from_name

ONE = np.ones(1)


@pytest.fixture(scope="module")
def psf():
    return psf_from_name("optical1", pixel=0.1, jitter=0.029)


@pytest.fixture(scope="module")
def star(psf):
    return pointings(psf, 0.1, dither_pattern(4))


@pytest.fixture(scope="module")
def detection(psf):
    return Detection.of(psf, EUCLID_VIS_WIDE, magnitudes=(16, 24))


def one(star, separation, flux_ratio, magnitude, angle=0.3, **options):
    found = misfit(
        star, EUCLID_VIS_WIDE, separation * ONE, flux_ratio * ONE, angle * ONE, magnitude * ONE, **options
    )
    return found[0, 0]


def test_a_single_star_passes_the_threshold_as_often_as_stated():
    assert detection_probability(np.zeros(1), 0.01) == pytest.approx(0.01)
    assert threshold(0.01, 3) == pytest.approx(11.345, abs=1e-3)


def test_probabilities_are_those_of_the_non_central_chi2():
    values = np.array([0.3, 4.0, 25.0, 60.0])
    expected = ncx2.sf(threshold(1e-3), 3, values)
    assert np.allclose(detection_probability(values), expected, atol=2e-5)
    assert detection_probability(np.array([1e9])) == pytest.approx(1)


def test_a_close_pair_has_the_misfit_of_its_second_moments(star):
    """Fourth power of the separation, square of f/(1+f)²."""
    close, closer = one(star, 0.01, 0.5, 20), one(star, 0.005, 0.5, 20)
    assert close / closer == pytest.approx(16, rel=0.02)
    assert one(star, 0.01, 1.0, 20) / close == pytest.approx((0.25 / (0.5 / 2.25)) ** 2, rel=0.02)


def test_the_misfit_grows_with_the_flux_of_bright_stars_and_its_square_for_faint_ones(star):
    assert one(star, 0.02, 1.0, 11) / one(star, 0.02, 1.0, 13.5) == pytest.approx(10, rel=0.03)
    assert one(star, 0.02, 1.0, 28) / one(star, 0.02, 1.0, 30.5) == pytest.approx(100, rel=0.03)


@pytest.mark.parametrize(("separation", "flux_ratio"), [(0.03, 0.3), (0.08, 1.0), (0.1, 0.2), (0.25, 0.05)])
def test_the_residuals_are_those_of_a_fit_by_least_squares(star, separation, flux_ratio):
    magnitude, share = 20.0, flux_ratio / (1 + flux_ratio)
    flux = EUCLID_VIS_WIDE.electrons(magnitude)
    dx, dy = separation * np.cos(0.3), separation * np.sin(0.3)
    # the pair where the fit of a first pass lies at the origin, as the dithers are those of the fitted star
    place = share * np.array([dx, dy])
    for _ in range(2):
        x, y = -place
        pair = star.images(x, y)[0] * (1 - share) + star.images(x + dx, y + dy)[0] * share
        root = np.sqrt(flux / (EUCLID_VIS_WIDE.background / flux + star.images(0, 0)[0]))

        def residual(p, pair=pair, root=root):
            return (pair - p[0] * star.images(p[1], p[2])[0]) * root

        fit = least_squares(residual, [1.0, 0.0, 0.0], x_scale=[1, 0.01, 0.01], xtol=1e-12, ftol=1e-12)
        place = place + fit.x[1:]
    found = one(star, separation, flux_ratio, magnitude, statistic="residuals")
    assert found == pytest.approx(2 * fit.cost, rel=0.01)


def test_nearly_all_of_the_misfit_of_a_close_pair_is_in_its_shape(star):
    assert 0.98 < one(star, 0.03, 1.0, 20) / one(star, 0.03, 1.0, 20, statistic="residuals") <= 1


def test_an_error_of_the_psf_hides_pairs_of_bright_stars_alone(star):
    bright, faint = ((one(star, 0.02, 1.0, m, r2_error=1e-5), one(star, 0.02, 1.0, m)) for m in (14, 22))
    assert bright[0] < 0.2 * bright[1]
    assert 0.95 * faint[1] < faint[0] < faint[1]


def test_exposures_add_up(psf, star):
    parts = [
        one(replace(star, place=star.place[k : k + 1], roll=star.roll[:1]), 0.02, 1.0, 20) for k in range(4)
    ]
    assert one(star, 0.02, 1.0, 20) == pytest.approx(sum(parts), rel=0.1)


def test_the_table_is_the_mean_over_angles_and_places(detection, star):
    rng = np.random.Generator(np.random.PCG64(3))
    separation, flux_ratio, magnitude = (
        v.ravel() for v in np.meshgrid([0.015, 0.04, 0.09], [0.02, 0.3], [18.3, 21.7])
    )
    mean = np.zeros(separation.size)
    for _ in range(40):
        here = replace(star, place=star.place + rng.uniform(-0.5, 0.5, 2))
        angle = rng.uniform(0, 2 * np.pi, separation.size)
        found = misfit(here, EUCLID_VIS_WIDE, separation, flux_ratio, angle, np.unique(magnitude))
        mean += detection_probability(np.where(magnitude == magnitude.min(), found[:, 0], found[:, 1])) / 40
    assert np.abs(detection.rejected(separation, flux_ratio, magnitude) - mean).max() < 0.03


def test_rejection_is_a_selection(detection):
    assert detection.rejected(0.0, 1.0, 20.0) == pytest.approx(1e-3)
    assert detection.rejected(0.04, 0.0, 20.0) == pytest.approx(1e-3)
    grid = detection.rejected(
        np.geomspace(0.003, 0.1, 30)[:, None, None], np.array([0.1, 0.5, 1.0])[:, None], np.arange(16.0, 25.0)
    )
    assert grid.shape == (30, 3, 9)
    assert np.all((grid >= 0) & (grid <= 1))
    assert np.all(np.diff(grid, axis=0) > -1e-4)
    assert np.all(np.diff(grid, axis=1) > -1e-4)
    assert np.all(np.diff(grid, axis=2) < 1e-4)


def test_more_exposures_see_more(psf, detection):
    single = Detection.of(psf, replace(EUCLID_VIS_WIDE, n_exposures=1), magnitudes=(16, 24))
    assert single.rejected(0.03, 0.3, 21.0) < detection.rejected(0.03, 0.3, 21.0)


@pytest.mark.parametrize("value", [0.0, 1.0, -0.1])
def test_a_rate_of_false_alarms_outside_its_range_is_refused(value):
    with pytest.raises(ValueError, match=r"false_alarm must be in \(0, 1\)"):
        threshold(value)
