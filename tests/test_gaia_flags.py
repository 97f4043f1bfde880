"""Gaia's flags: which pairs they can see, and which orbits."""

import numpy as np
import pytest

from porrima.gaia_flags import YEARS, GaiaFlags, along_scan_error, orbital_excess


def test_single_stars_and_close_pairs_are_kept():
    flags = GaiaFlags()
    assert flags.rejected(0.3, 0.0, 17.0) == 0
    assert np.all(flags.rejected(np.array([0.0, 0.01, 0.03]), 1.0, 17.0) == 0)
    assert GaiaFlags(false_alarm=0.02).rejected(0.0, 1.0, 17.0) == pytest.approx(0.02)


def test_wide_pairs_of_bright_stars_are_flagged():
    assert np.all(GaiaFlags().rejected(np.array([0.15, 0.3, 0.5]), 0.5, 17.0) > 0.99)


def test_two_peaks_need_the_along_scan_resolution_and_more_for_a_faint_companion():
    flags, separation = GaiaFlags(ruwe_max=np.inf), np.linspace(0.02, 0.4, 191)
    first = [
        separation[np.argmax(flags.rejected(separation, 10 ** (-0.4 * dm), 16.0) > 0.5)] for dm in (0, 2, 3)
    ]
    assert first == sorted(first)
    assert 0.07 < first[0] < 0.11  # FWHM of 0.1 arcsec
    assert first[2] < 0.25


def test_ruwe_sees_blends_of_unequal_stars_where_the_place_is_good():
    ruwe = GaiaFlags(multi_peak=False)
    assert ruwe.rejected(0.1, 0.3, 16.0) == 1
    assert ruwe.rejected(0.1, 0.3, 20.5) == 0
    assert ruwe.rejected(0.05, 1.0, 16.0) == 0


def test_a_colour_moves_the_magnitude():
    assert np.array_equal(
        GaiaFlags(colour=-1.0).rejected(0.12, 0.4, np.arange(16.0, 21)),
        GaiaFlags().rejected(0.12, 0.4, np.arange(17.0, 22)),
    )


def test_the_error_along_scan_grows_with_magnitude():
    assert np.all(np.diff(along_scan_error(np.linspace(13, 21, 30))) > 0)


@pytest.mark.parametrize("period", [0.7, 5.0, 30.0])
def test_what_a_straight_line_leaves_of_an_orbit(period):
    t = np.linspace(-0.5, 0.5, 4001)
    left = []
    for phase in 2 * np.pi * np.arange(8) / 8:
        y = np.sin(2 * np.pi * t * YEARS / period + phase)
        left.append(np.mean((y - np.polyval(np.polyfit(t, y, 1), t)) ** 2))
    assert orbital_excess(period) == pytest.approx(2 * np.mean(left), rel=2e-3)


def test_the_flags_on_a_grid_are_those_of_each_pair():
    flags = GaiaFlags()
    separation, flux_ratio, magnitude = np.linspace(0, 0.2, 5), np.linspace(0, 1, 4), np.array([17.0, 19.0])
    kept = np.prod(
        [1 - layer.probability for layer in flags.layers(separation, flux_ratio, magnitude)], axis=0
    )
    assert kept.shape == (2, 4, 5)
    each = flags.rejected(separation, flux_ratio[:, None], magnitude[:, None, None])
    np.testing.assert_allclose(kept, 1 - each, rtol=1e-12)
