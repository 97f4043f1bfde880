"""Moe & Di Stefano (2017) and Moe et al. (2019) against the numbers of their papers."""

import numpy as np
import pytest
from scipy.special import ndtr

from porrima.moe import Metallicity, MoeDiStefano2017, narrowed
from porrima.multiplicity import MULTIPLICITY
from porrima.published import Offner2023

SUN = np.array([1.0])
MODEL = MoeDiStefano2017(eccentricity="circular")


def test_companions_to_a_solar_type_star():
    """0.50 +- 0.04 companions with q > 0.1; a multiplicity fraction of 0.40."""
    assert MODEL.counts(SUN).sum() == pytest.approx(0.50, abs=0.04)
    assert MODEL.companions(SUN).multiplicity_fraction[0] == 0.40


def test_frequencies_per_dex_of_period():
    """The anchors of Eqs. 20 to 23 for 1 M_sun, and that the pieces meet."""
    at = np.array([0.5, 2.7, 5.5, 0.1, 8.1])
    np.testing.assert_allclose(MODEL.frequency(SUN, at)[0], [0.020, 0.039, 0.078, 0, 0], atol=1e-12)
    for period in (1.0, 2.0, 3.4, 5.5):
        left, right = MODEL.frequency(SUN, period + np.array([-1e-9, 1e-9]))[0]
        assert left == pytest.approx(right, abs=1e-8)
    assert MODEL.frequency(np.array([10.0]), np.array([0.5]))[0, 0] == pytest.approx(0.13)


def test_classes_of_period_hold_the_companions_of_the_density():
    """The number within the range, and the median period, from the density summed on a fine grid."""
    period = np.linspace(0.15, 8.0, 20_001)
    density = MODEL.frequency(SUN, period)[0]
    assert MODEL.counts(SUN)[:, 1:].sum() == pytest.approx(np.trapezoid(density, period), rel=2e-3)
    law = MODEL.companions(SUN)
    large = law.mass_ratio_min >= 0.3
    total = np.cumsum(density) / density.sum()
    mean_log_a = np.average(law.log_a[large], weights=law.share[large])
    mean_period = np.sum(period * density) / density.sum()
    expected = (2 * (mean_period - np.log10(365.25)) + np.log10(1.6)) / 3
    assert mean_log_a == pytest.approx(expected, abs=0.01)
    assert period[np.searchsorted(total, 0.5)] == pytest.approx(5.0, abs=0.3)


def test_twins():
    """30 % at short periods, falling to none at log P = 8 - M (Eqs. 5 to 7), of mass ratios above 0.95."""
    np.testing.assert_allclose(
        MODEL.twin_fraction(SUN, np.array([0.5, 1.0, 4.0, 7.0, 7.5]))[0], [0.3, 0.3, 0.15, 0, 0]
    )
    counts = MODEL.counts(SUN)[0]
    short = counts[2, 0] / counts[1:, 0].sum()
    assert short == pytest.approx(0.30)
    law = MODEL.companions(SUN)
    assert set(law.mass_ratio_min[law.mass_ratio_exponent == 0]) == {0.95}


def test_mass_ratios_join_at_their_break():
    """The density of q is continuous at 0.3 but for twins, whatever the exponents on either side."""
    law = MODEL.companions(SUN)
    small, large = law.mass_ratio_max == 0.3, (law.mass_ratio_min == 0.3)

    def density(mine):
        g, low, high = (getattr(law, f"mass_ratio_{n}")[mine] for n in ("exponent", "min", "max"))
        norm = (high ** (g + 1) - low ** (g + 1)) / (g + 1)
        return law.share[mine] * 0.3**g / norm

    np.testing.assert_allclose(density(small), density(large), rtol=1e-9)


def test_close_fractions_against_metallicity():
    """53, 40, 24 and 10 % at [Fe/H] -3, -1, -0.2 and +0.5, relative to field stars."""
    factor = Metallicity().factor(np.array([-3.0, -1.0, -0.2, 0.5, 1.0]))
    np.testing.assert_allclose(factor * 0.24, [0.53, 0.40, 0.24, 0.10, 0.10])


def test_a_close_fraction_follows_metallicity_and_wide_pairs_do_not():
    """The number of pairs far within, and far beyond, 10 au; field stars keep their own law."""
    field = Offner2023().companions(np.full(3, 1.0))
    found = Metallicity().applied(field, np.full(3, 1.0), np.array([-1.0, -0.2, 0.5]))
    number = found.share * found.multiplicity_fraction
    for star, factor in enumerate((0.40 / 0.24, 1.0, 0.10 / 0.24)):
        mine = found.star == star
        middle = found.star == 1
        close = number[mine & (found.log_a < -0.5)].sum() / number[middle & (found.log_a < -0.5)].sum()
        wide = number[mine & (found.log_a > 3.0)].sum() / number[middle & (found.log_a > 3.0)].sum()
        assert close == pytest.approx(factor, rel=0.01)
        assert wide == pytest.approx(1.0, rel=0.01)
    assert found.multiplicity_fraction[found.first][1] == field.multiplicity_fraction[1]


def test_narrow_classes_make_up_the_log_normal_they_come_from():
    law = Offner2023().companions(SUN)
    many = narrowed(law, np.array([True]))
    assert many.star.size > 10
    at = np.linspace(-2, 5, 50)[:, None]
    np.testing.assert_allclose(
        ndtr((at - many.log_a) / many.log_a_sigma) @ many.share,
        ndtr((at[:, 0] - law.log_a) / law.log_a_sigma),
        atol=2e-3,
    )


def test_stars_of_no_measured_relation_are_left_alone():
    light = np.array([0.2, 0.4])
    law = MULTIPLICITY["modern"].companions(light, np.array([-2.0, 0.3]))
    field = MULTIPLICITY["modern"].companions(light)
    np.testing.assert_array_equal(law.share, field.share)
    np.testing.assert_array_equal(law.multiplicity_fraction, field.multiplicity_fraction)
