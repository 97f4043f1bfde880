import numpy as np
import pytest
from astropy import units as u

from porrima.errors import InputError
from porrima.moments import INDICES
from porrima.multiplicity import MULTIPLICITY
from porrima.photometry import PHOTOMETRY
from porrima.stars import Stars
from porrima.systems import Population, Systems


def moment(systems, a, b):
    return systems.kernel_moments().values[0, INDICES.index((a, b))]


def test_a_pair_is_seen_about_its_flux_centroid():
    systems = Systems.from_pairs([0.5, 0.0], [0.03, 0.0], [-0.01, 0.0])
    np.testing.assert_allclose(np.sum(systems.flux, axis=1), 1.0)
    np.testing.assert_allclose(np.sum(systems.flux * systems.x, axis=1), 0.0, atol=1e-18)
    np.testing.assert_allclose(systems.x[0, 1] - systems.x[0, 0], 0.03)


def test_moments_are_weighted_means():
    both = Systems.from_pairs([0.5, 1.0], [0.03, 0.0], [0.0, 0.02], [1.0, 3.0])
    assert moment(both, 2, 0) == pytest.approx(0.25 * 0.5 / 1.5**2 * 0.03**2)
    assert moment(both, 0, 2) == pytest.approx(0.75 * 0.25 * 0.02**2)


def test_a_stack_of_single_stars_has_no_moments():
    assert not np.any(Systems.from_pairs(np.zeros(5), np.ones(5), np.ones(5)).kernel_moments().values)


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (([1.5], [0.0], [0.0]), r"flux_ratio must be in \[0, 1\], got 1.5"),
        (([np.nan], [0.0], [0.0]), r"flux_ratio must be in \[0, 1\], got nan"),
        (([0.5], [np.inf], [0.0]), "dx must be finite, got inf"),
        (([0.5], [0.0], [0.0], [-1.0]), "weight must be finite and not negative, got -1.0"),
        (([0.5], [0.0], [0.0], [0.0]), "weight must have a positive sum, got 0.0"),
    ],
)
def test_bad_pairs_are_refused(arguments, message):
    with pytest.raises(ValueError, match=message):
        Systems.from_pairs(*arguments)


def test_a_population_needs_stars_in_range_and_a_cut():
    models = {"multiplicity": MULTIPLICITY["dk13"], "photometry": PHOTOMETRY["main-sequence"]}
    star = Stars.from_columns(mass=[0.8], distance=[1000.0], magnitude=[18.5], source="here")
    with pytest.raises(InputError, match="here: no star is left after selection"):
        Population.of(star.select(magnitude=(1, 2)), **models)
    with pytest.raises(InputError, match=r"cut: must be positive and finite \[arcsec\], got 0"):
        Population.of(star, cut=0, **models)
    light = Stars.from_columns(mass=[0.05], distance=[100.0], magnitude=[18.5])
    with pytest.raises(InputError, match=r"mass must be in \[0.08, 1.5\] M_sun for main-sequence, got 0.05"):
        Population.of(light, **models)


def test_offsets_may_be_quantities():
    bare = Systems.from_pairs([0.5], [0.03], [0.0])
    milli = Systems.from_pairs([0.5], [30] * u.mas, [0] * u.mas)
    np.testing.assert_allclose(bare.x, milli.x)
