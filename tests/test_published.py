"""Each model against its paper's own numbers."""

import dataclasses

import numpy as np
import pytest
from scipy.special import ndtr

from porrima.companions import MassRangeWarning, RowErrors
from porrima.integrals import integrate
from porrima.multiplicity import COMPILATIONS, MULTIPLICITY
from porrima.photometry import PHOTOMETRY
from porrima.published import Offner2023, Raghavan2010, SusemiehlMeyer2022, Winters2019
from porrima.systems import Population

MASSES = np.geomspace(0.08, 1.5, 60)
NAMES = list(MULTIPLICITY)
every_model = pytest.mark.parametrize("name", NAMES)
silent = pytest.mark.filterwarnings("ignore::porrima.companions.MassRangeWarning")


def mean_mass_ratio(law, star=0):
    """Mean of q over the classes of a star, by integrals of its power laws."""
    mine = law.star == star
    g, low, high = (getattr(law, f"mass_ratio_{n}")[mine] for n in ("exponent", "min", "max"))
    means = []
    for exponent, a, b in zip(g, low, high, strict=True):
        q = np.linspace(a, b, 20_001)
        means.append(np.trapezoid(q ** (exponent + 1), q) / np.trapezoid(q**exponent, q))
    return law.share[mine] @ means


def quantile_of_axis(law, probability=0.5):
    """log10 of the axis below which a share of the companions of the first star is, by bisection."""
    mine, low, high = law.star == 0, -6.0, 8.0
    for _ in range(60):
        middle = 0.5 * (low + high)
        below = law.share[mine] @ ndtr((middle - law.log_a[mine]) / law.log_a_sigma[mine])
        low, high = (middle, high) if below < probability else (low, middle)
    return low


@silent
@every_model
def test_the_law_of_every_model_is_whole(name):
    model = MULTIPLICITY[name]
    law = model.companions(MASSES, np.linspace(-2, 0.3, MASSES.size))
    assert law.star[0] == 0
    assert set(np.diff(law.star)) <= {0, 1}
    np.testing.assert_allclose(np.bincount(law.star, law.share), 1.0)
    assert np.all((law.multiplicity_fraction > 0) & (law.multiplicity_fraction <= 1))
    assert np.all(law.multiplicity_fraction == law.multiplicity_fraction[law.first][law.star])
    assert np.all((law.mass_ratio_min > 0) & (law.mass_ratio_min < law.mass_ratio_max))
    assert np.all(law.mass_ratio_max <= 1)
    assert np.all(law.log_a_sigma > 0)
    assert len(model.row_errors) > model.rows(MASSES).max()
    assert all(isinstance(row, RowErrors) for row in model.row_errors)
    for option, other in model.choices.items():
        assert getattr(dataclasses.replace(model, **{option: other}), option) == other


@silent
@every_model
def test_every_model_makes_pairs_that_shine(stars, name):
    population = Population.of(stars, multiplicity=MULTIPLICITY[name], photometry=PHOTOMETRY["main-sequence"])
    found = integrate(population)
    assert np.all(np.isfinite(found.mean))
    assert np.all(found.mean[:, 0] >= 0)
    assert found.mean[:, 0].max() > 0


@pytest.mark.parametrize(
    ("mass", "fraction", "frequency", "exponent"),
    [
        (0.10, 0.19, 0.21, 1.7), (0.20, 0.23, 0.27, 0.7), (0.45, 0.30, 0.38, 0.1),
        (1.00, 0.46, 0.60, 0.2), (2.00, 0.68, 0.99, -1.3),
    ],
)  # fmt: skip
def test_bins_of_offner(mass, fraction, frequency, exponent):
    model, here = Offner2023(), np.array([mass])
    law = model.companions(here)
    assert law.multiplicity_fraction == [fraction]
    assert model.table[model.rows(here)[0]].companion_frequency == frequency
    assert mean_mass_ratio(law) == pytest.approx(
        (exponent + 1) / (exponent + 2) * (1 - 0.1 ** (exponent + 2)) / (1 - 0.1 ** (exponent + 1)), rel=1e-6
    )


@pytest.mark.parametrize(("mass", "axis", "sigma"), [(0.1, 4, 0.7), (0.45, 25, 1.3), (1.0, 40, 1.5)])
def test_log_normals_of_offner(mass, axis, sigma):
    law = Offner2023().companions(np.array([mass]))
    assert 10 ** quantile_of_axis(law) == pytest.approx(axis)
    assert quantile_of_axis(law, 0.8413447) - np.log10(axis) == pytest.approx(sigma, rel=1e-5)


def test_modern_joins_the_bins_of_offner_without_steps():
    """Without metallicity the middles of the bins are met, and no step between them is larger than a rounding."""
    model = dataclasses.replace(MULTIPLICITY["modern"], metallicity="none", eccentricity="circular")
    middles = np.sqrt([row.mass_lo * row.mass_hi for row in Offner2023.table])
    assert model.companions(middles).multiplicity_fraction == pytest.approx([0.19, 0.23, 0.30, 0.46, 0.68])
    fine = model.companions(np.geomspace(0.08, 1.5, 2000))
    assert np.abs(np.diff(fine.multiplicity_fraction)).max() < 0.0025
    assert np.abs(np.diff(fine.log_a)).max() < 0.003


def test_numbers_of_raghavan():
    """Median period 293 years, 50 au (their Sect. 5.3.3), 44 % multiple, 0.58 companions a star, mean e of 0.5."""
    model = Raghavan2010(eccentricity="circular")
    law = model.companions(np.array([1.0]))
    assert law.multiplicity_fraction[0] == pytest.approx(1 - 0.56)
    assert model.table[0].companion_frequency == pytest.approx(0.33 + 2 * 0.08 + 3 * 0.03)
    years = np.sqrt((10 ** quantile_of_axis(law)) ** 3 / 1.5)
    assert np.log10(365.25 * years) == pytest.approx(5.03, abs=0.01)
    assert 1.5 * law.log_a_sigma == pytest.approx([2.28])


def test_numbers_of_winters():
    """Separations on the sky, drawn about the axes of the law, have the median and the scatter of the paper."""
    rng = np.random.Generator(np.random.Philox(1))
    for eccentricity, e in (("circular", 0.0), ("thermal", 1.0)):
        law = Winters2019(eccentricity=eccentricity).companions(np.array([0.3]))
        assert law.multiplicity_fraction[0] == 0.268
        of = rng.choice(law.star.size, 200_000, p=law.share / law.share.sum())
        log_s = law.log_a[of] + law.log_a_sigma[of] * rng.standard_normal(of.size)
        log_s += 0.5 * np.log10(1 - rng.uniform(-1, 1, of.size) ** 2)
        assert log_s.mean() == pytest.approx(np.log10(20), abs=5 * 1.16 / np.sqrt(of.size)), e
        assert log_s.std() == pytest.approx(1.16, rel=5 / np.sqrt(2 * of.size)), e
    circles = Winters2019().companions(np.array([0.3]))
    assert 10 ** circles.log_a[0] / 20 == pytest.approx(1.36, abs=0.005)


def test_numbers_of_susemiehl_and_meyer():
    """0.229 +- 0.028 companions with q > 0.6 within 10 000 au, from the fraction with any q."""
    law = SusemiehlMeyer2022().companions(np.array([0.3]))
    assert 10 ** quantile_of_axis(law) == pytest.approx(10**1.43)
    g = law.mass_ratio_exponent[0] + 1
    similar = law.multiplicity_fraction[0] * (1 - 0.6**g) / (1 - 0.1**g)
    assert similar == pytest.approx(0.229, abs=0.006)


@pytest.mark.parametrize(
    ("name", "share"), [("raghavan10", "66.7%"), ("winters19", "33.3%"), ("mds17", "66.7%")]
)
def test_stars_outside_the_masses_of_a_model_are_counted(name, share):
    model = MULTIPLICITY[name]
    with pytest.warns(MassRangeWarning, match=f"{share} of the stars lie outside .* range of {name}"):
        law = model.companions(np.array([0.1, 0.3, 1.0]))
    if name != "mds17":  # whose orbits follow from the period and the star's own mass
        assert len(set(law.log_a[law.first])) == 1


def test_compilations_hold_for_nearly_all_stars():
    for name in COMPILATIONS:
        low, high = MULTIPLICITY[name].mass_range
        assert low <= 0.08
        assert high >= 1.5


@pytest.mark.parametrize(
    ("option", "value"), [("gap_rule", "lower"), ("mass_ratio_min", 1.0), ("metallicity", "low")]
)
def test_bad_options_are_named(option, value):
    with pytest.raises(ValueError, match=f"{option} must be .* got {value}"):
        Offner2023(**{option: value})
