import numpy as np
import pytest
from astropy import units as u

from porrima.stars import Stars


def three(**changes):
    columns = {"mass": [0.3, 0.8, 1.5], "distance": [100.0, 900.0, 3000.0], "magnitude": [18.0, 18.5, 19.0]}
    return Stars.from_columns(**(columns | changes))


def test_magnitude_ranges_are_half_open():
    assert three().select(magnitude=(18, 19)).magnitude.tolist() == [18.0, 18.5]


def test_the_largest_mass_is_kept():
    assert len(three().select(mass_max=1.5)) == 3
    assert len(three().select(mass_max=1.49)) == 2


def test_missing_columns_take_the_stated_values():
    stars = three()
    assert set(stars.metallicity) == {0.0}
    assert set(stars.log_age) == {9.7}
    assert set(stars.component) == {"unknown"}


def test_selection_by_component():
    stars = three(component=["thin1", "halo", "thin1"])
    assert stars.select(component="halo").mass.tolist() == [0.8]


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"mass": [0.3, -0.8, 1.5]}, "mass must be positive, got -0.8"),
        ({"distance": [100.0, 0.0, 1.0]}, "distance must be positive, got 0.0"),
        ({"magnitude": [18.0, np.nan, 18.0]}, "magnitude must be finite, got nan"),
        ({"mass_ratio": [0.5, 1.2, 0.0]}, "mass_ratio must be .* in .* or NaN"),
        ({"distance": [100.0, 900.0]}, r"distance must be an array of shape \(3,\), got \(2,\)"),
    ],
)
def test_bad_stars_are_refused(changes, message):
    with pytest.raises(ValueError, match=message):
        three(**changes)


def test_counts_add_up_and_know_their_area():
    counts = three(area=2.0).counts((18.0, 20.0), np.array([0.2, 0.4, 0.5]))
    assert [c["n"] for c in counts] == [2, 1]
    assert counts[0]["n_per_deg2"] == 1.0
    assert counts[0]["median_distance_pc"] == 500.0
    assert counts[0]["mean_mass"] == pytest.approx(0.55)
    assert counts[0]["mean_multiplicity_fraction"] == pytest.approx(0.3)


def test_an_empty_bin_has_no_mean():
    counts = three().counts((10.0, 11.0), np.zeros(3))
    assert counts[0]["n"] == 0
    assert counts[0]["mean_mass"] is None
    assert counts[0]["n_per_deg2"] is None


@pytest.mark.parametrize("low", np.arange(14.0, 16.0, 0.1))
def test_no_bin_is_empty_of_width(low):
    edges = [(c["mag_lo"], c["mag_hi"]) for c in three().counts((low, low + 2.0), np.zeros(3))]
    assert len(edges) == 2
    assert all(hi - lo > 0.5 for lo, hi in edges)


def test_mass_ratios_follow_their_stars():
    stars = three(mass_ratio=[0.5, 0.0, np.nan])
    assert stars.select(mass_max=1.0).mass_ratio.tolist() == [0.5, 0.0]
    assert three().select(mass_max=1.0).mass_ratio is None


def test_some_stars_taken_evenly_are_of_all_masses_and_distances():
    mass, distance = np.repeat([0.1, 0.4, 1.0], 4), np.tile([4.0, 1.0, 3.0, 2.0], 3)
    stars = Stars.from_columns(mass=mass, distance=distance, magnitude=np.full(12, 18.0))
    some = stars.evenly(6)
    assert some.mass.tolist() == [0.1, 0.1, 0.4, 0.4, 1.0, 1.0]
    assert some.distance.tolist() == [2.0, 4.0] * 3
    assert sorted(stars.evenly(12).distance) == sorted(distance)


def test_quantities_are_taken_in_any_unit():
    stars = three(mass=np.array([0.3, 0.8, 1.5]) * u.solMass, distance=np.array([0.1, 0.9, 3.0]) * u.kpc)
    np.testing.assert_allclose(stars.distance, three().distance)
    with pytest.raises(ValueError, match="distance must be in a unit convertible to pc, got kg"):
        three(distance=np.ones(3) * u.kg)
