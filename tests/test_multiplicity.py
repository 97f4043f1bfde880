import numpy as np
import pytest

from data_files import data_file
from porrima.catalogs import read_catalog
from porrima.multiplicity import MULTIPLICITY, DucheneKraus2013, multiplicity_scale

# Mean multiplicity fraction, i = 16 ... 23, with the solar gap rule and with the lower one, at the pole:
# of the Besancon catalogue, computed by others.
SOLAR = [0.397, 0.373, 0.341, 0.327, 0.327, 0.339, 0.345]
LOWER = [0.332, 0.321, 0.295, 0.289, 0.288, 0.298, 0.295]


def test_the_rows_of_the_paper_s_table_are_half_open():
    law = DucheneKraus2013().companions(np.array([0.0999, 0.1, 0.4999, 0.7, 1.2999]))
    assert law.multiplicity_fraction.tolist() == [0.22, 0.26, 0.26, 0.44, 0.44]
    assert law.mass_ratio_exponent.tolist() == [4.2, 0.4, 0.4, 0.3, 0.3]
    np.testing.assert_allclose(10**law.log_a, [4.5, 5.3, 5.3, 45, 45])
    np.testing.assert_allclose(law.log_a_sigma, np.array([0.5, 1.3, 1.3, 2.3, 2.3]) * 2 / 3)


def test_gaps_take_the_lower_row_or_the_solar_one():
    gaps = np.array([0.5, 0.6999, 1.3, 1.5])
    assert DucheneKraus2013().companions(gaps).multiplicity_fraction.tolist() == [0.26, 0.26, 0.44, 0.44]
    assert MULTIPLICITY["dk13-kcm16"].companions(gaps).multiplicity_fraction.tolist() == [0.44] * 4


def test_the_truncated_variant_ends_at_two_and_a_half_means():
    law = MULTIPLICITY["dk13-kcm16"].companions(np.array([0.3, 1.0]))
    np.testing.assert_allclose(10**law.log_a_max, [2.5 * 5.3, 2.5 * 45])
    assert np.all(np.isinf(MULTIPLICITY["dk13"].companions(np.array([0.3])).log_a_max))


@pytest.mark.parametrize(("rule", "expected"), [("solar", SOLAR), ("lower", LOWER)])
def test_mean_multiplicity_of_the_real_catalogue(rule, expected):
    stars = read_catalog(data_file("catalogues/besancon_l200_b90.dat")).stars.select(mass_max=1.5)
    # these figures count the catalogue's rounded 0.50 M_sun as below the gap; the rule as stated counts it in
    law = DucheneKraus2013(gap_rule=rule).companions(np.where(stars.mass == 0.5, 0.499, stars.mass))
    mean = [
        law.multiplicity_fraction[(stars.magnitude >= m) & (stars.magnitude < m + 1)].mean()
        for m in range(16, 23)
    ]
    np.testing.assert_allclose(mean, expected, atol=0.001)


@pytest.mark.parametrize(
    ("option", "value"),
    [
        ("gap_rule", "upper"),
        ("a_max_factor", 0.0),
        ("scatter_scale", -1.0),
        ("projection", "none"),
        ("mass_ratio_min", 1.0),
    ],
)
def test_bad_options_are_named(option, value):
    with pytest.raises(ValueError, match=f"{option} must be .* got {value}"):
        DucheneKraus2013(**{option: value})


def test_masses_beyond_the_table_are_refused():
    with pytest.raises(ValueError, match=r"mass must be in \[0.0, 1.5\] M_sun for Duchene & Kraus"):
        DucheneKraus2013().companions(np.array([1.51]))


def test_scaling_reaches_every_binary_fraction():
    fraction = np.array([0.22, 0.26, 0.26, 0.44, 0.44, 0.44])
    wanted = np.linspace(0, 1, 41)
    scale = multiplicity_scale(fraction, wanted)
    np.testing.assert_allclose(np.minimum(1, np.outer(scale, fraction)).mean(axis=1), wanted, atol=1e-14)


def test_scaling_works_for_as_many_fractions_as_stars():
    fraction = np.random.Generator(np.random.Philox(3)).random(1000)
    wanted = np.array([0.0, 0.1, 0.5, 0.9, 1.0])
    scale = multiplicity_scale(fraction, wanted)
    np.testing.assert_allclose(np.minimum(1, np.outer(scale, fraction)).mean(axis=1), wanted, atol=1e-12)


def test_impossible_binary_fractions_are_refused():
    with pytest.raises(ValueError, match=r"binary_fraction must be in \[0, 1\], got 1.2"):
        multiplicity_scale(np.array([0.3]), np.array([0.5, 1.2]))
    with pytest.raises(ValueError, match=r"binary_fraction must be at most 0.5 for these stars, got 0.6"):
        multiplicity_scale(np.array([0.0, 0.3]), np.array([0.6]))
