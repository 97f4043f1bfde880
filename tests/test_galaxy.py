"""The analytic Galaxy: limits, symmetries, and drawn stars against the integral of the same law."""

import numpy as np
import pytest

from porrima import star_figures as figures
from porrima.dust import WAVELENGTHS, Place, extinction_ratio
from porrima.galaxy import Robin2003
from porrima.photometry import MainSequence, magnitudes
from porrima.populations import COMPONENTS, LOG_MASS, main_sequence_end
from porrima.star_experiments import galaxy_against_catalog, population
from porrima.stars import COMPONENTS as NAMES
from statistics_helpers import assert_within_sigma

EDGES = np.arange(16.0, 24.0)
SUN = Place.towards(0.0, 0.0, np.array([0.0]))
DIRECTIONS = [(0.0, 90.0, 30.0), (90.0, 12.0, 2.0), (200.0, -59.0, 30.0)]  # l, b, area in deg²


def generator(seed=20261122):
    return np.random.Generator(np.random.Philox(seed))


@pytest.fixture(scope="module", params=DIRECTIONS, ids=lambda p: f"l{p[0]:g}b{p[1]:g}")
def drawn(request):
    lon, lat, area = request.param
    stars = Robin2003().draw(lon, lat, area, "i", (16.0, 23.0), generator())
    return lon, lat, area, stars, Robin2003().star_counts(lon, lat, EDGES)


@pytest.mark.parametrize("component", COMPONENTS, ids=lambda c: c.name)
def test_density_at_the_sun_is_the_published_one(component):
    np.testing.assert_allclose(Robin2003().density(component.name, SUN), component.rho0, rtol=1e-12)


def test_components_are_those_of_stars_in_their_order():
    assert tuple(c.name for c in COMPONENTS) == NAMES[: len(COMPONENTS)]


@pytest.mark.parametrize("component", COMPONENTS[7:], ids=lambda c: c.name)
def test_living_stars_of_the_old_components_weigh_the_published_density(component):
    age = np.array([np.log10(component.age[0]) + 9.0])
    end = main_sequence_end(np.array([component.metallicity]), age)[0]
    mass = 10 ** (0.5 * (LOG_MASS[1:] + LOG_MASS[:-1]))
    alive = np.clip((np.log10(end) - LOG_MASS[:-1]) / np.diff(LOG_MASS), 0.0, 1.0)
    weight = np.sum(component.number_density() * alive * mass)
    np.testing.assert_allclose(weight, component.rho0, rtol=5e-3)  # masses at the centres of cells


def test_nearby_stars_are_the_local_density_times_the_volume():
    """Every star within 20 pc is seen when the range of magnitude is wide enough."""
    near = Robin2003(distance_max=20.0, extinction_per_kpc=0.0)
    counts = near.star_counts(30.0, 20.0, np.array([-10.0, 40.0]))
    volume = 20.0**3 / 3.0 * (np.pi / 180.0) ** 2
    halo = COMPONENTS[8]
    end = main_sequence_end(np.full(1, halo.metallicity), np.full(1, np.log10(13e9)))
    number = halo.number_density()[10 ** LOG_MASS[1:] < end].sum()
    np.testing.assert_allclose(counts.by_component[8, 0], number * volume, rtol=0.03)  # ends vary with [M/H]


def test_counts_are_symmetric_about_the_centre_without_warp():
    model = Robin2003(warp=False)
    np.testing.assert_allclose(model.counts(70.0, 8.0, EDGES), model.counts(290.0, 8.0, EDGES), rtol=1e-10)


def test_the_warp_lifts_the_disc_towards_l_90():
    warped = Robin2003(extinction_per_kpc=0.0)
    up, down = warped.counts(90.0, 5.0, EDGES), warped.counts(270.0, 5.0, EDGES)
    assert np.all(up[4:] > 1.02 * down[4:])


def test_longitude_does_not_matter_at_the_pole():
    a, b = (Robin2003().counts(lon, 90.0, EDGES) for lon in (0.0, 133.0))
    np.testing.assert_allclose(a, b, rtol=1e-12)


def test_bins_add_up():
    model = Robin2003()
    np.testing.assert_allclose(
        model.counts(200.0, 30.0, EDGES).sum(), model.counts(200.0, 30.0, EDGES[[0, -1]])[0], rtol=2e-3
    )  # both start at the same distance cell, so only the binning differs


def test_tables_of_counts_hold_the_same_stars():
    counts = Robin2003().star_counts(200.0, 30.0, EDGES)
    for table in (
        counts.by_component.sum(axis=0),
        counts.by_distance.sum(axis=1),
        counts.by_mass.sum(axis=1),
    ):
        np.testing.assert_allclose(table, counts.per_deg2, rtol=1e-12)
    np.testing.assert_allclose(counts.mean(np.ones(counts.mass.size)), 1.0)


@pytest.mark.parametrize(("lon", "lat", "total"), [(0.0, 90.0, 0.06), (293.0, -40.0, 0.13)])
def test_extinction_to_infinity_is_that_of_the_besancon_model(lon, lat, total):
    assert abs(Robin2003().extinction(lon, lat, np.array([1e5]))[0] - total) < 0.005


def test_extinction_starts_at_the_published_slope():
    slope = Robin2003().extinction(180.0, 0.0, np.array([1.0]))[0]
    np.testing.assert_allclose(slope, 0.70e-3, rtol=0.01)


def test_every_band_has_its_extinction_and_the_law_is_one_at_v():
    assert set(MainSequence().bands) <= set(WAVELENGTHS)
    assert abs(extinction_ratio("V") - 1.0) < 0.01
    by_wavelength = sorted(WAVELENGTHS, key=lambda band: WAVELENGTHS[band])
    assert np.all(np.diff([extinction_ratio(band) for band in by_wavelength]) < 0)


@pytest.mark.parametrize(
    ("wavelength", "published"),
    [(0.70, 0.751), (0.90, 0.479), (1.25, 0.282), (1.6, 0.190), (2.2, 0.114)],
    ids=["R", "I", "J", "H", "K"],
)
def test_extinction_law_is_the_published_table(wavelength, published, monkeypatch):
    """Cardelli, Clayton & Mathis (1989), Table 3."""
    monkeypatch.setitem(WAVELENGTHS, "test", wavelength)
    assert abs(extinction_ratio("test") - published) < 0.002


@pytest.mark.parametrize(
    ("band", "documented"),
    [
        ("g", 1.19), ("r", 0.87), ("i", 0.65), ("z", 0.47), ("gaia_G", 0.87), ("euclid_VIS", 0.73),
        ("roman_F106", 0.37), ("roman_F129", 0.27), ("roman_F158", 0.19), ("roman_F184", 0.15),
    ],
)  # fmt: skip
def test_extinction_of_each_band_is_the_documented_one(band, documented):
    model, far = Robin2003(), np.array([5000.0])
    ratio = model.extinction(30.0, 10.0, far, band)[0] / model.extinction(30.0, 10.0, far)[0]
    assert abs(ratio - documented) < 0.008


def test_dust_hides_stars():
    with_dust, without = (Robin2003(extinction_per_kpc=k).counts(30.0, 3.0, EDGES) for k in (0.7, 0.0))
    assert np.all(with_dust < without)


@pytest.mark.parametrize("band", MainSequence().bands)
def test_drawn_counts_agree_in_other_bands(band):
    area = 4.0
    n = len(Robin2003().draw(180.0, 45.0, area, band, (18.0, 20.0), generator()))
    expected = area * Robin2003().counts(180.0, 45.0, np.array([18.0, 20.0]), band)[0]
    assert_within_sigma(n, expected, np.sqrt(expected), n_sigma=5.0)


def test_drawn_counts_agree_with_the_integral(drawn):
    _, _, area, stars, counts = drawn
    expected = area * counts.per_deg2
    n, _ = np.histogram(stars.magnitude, EDGES)
    assert_within_sigma(n, expected, np.sqrt(expected), n_sigma=5.0)  # Poisson


def test_drawn_components_agree_with_the_integral(drawn):
    _, _, area, stars, counts = drawn
    expected = area * counts.by_component.sum(axis=1)
    n = np.array([np.sum(stars.component == c.name) for c in COMPONENTS])
    assert_within_sigma(n, expected, np.sqrt(expected + 1.0), n_sigma=5.0)


def test_drawn_distances_and_masses_agree_with_the_integral(drawn):
    *_, stars, counts = drawn
    for k in range(EDGES.size - 1):
        here = stars.select(magnitude=(EDGES[k], EDGES[k + 1]))
        nearer = np.mean(here.distance < counts.median_distance[k])
        assert_within_sigma(nearer, 0.5, 0.5 / np.sqrt(len(here)), n_sigma=5.0)
        stderr = here.mass.std() / np.sqrt(len(here))
        assert_within_sigma(here.mass.mean(), counts.mean_mass[k], stderr, n_sigma=5.0)


def test_drawn_stars_carry_what_gives_their_magnitude(drawn):
    lon, lat, _, stars, _ = drawn
    tracks = MainSequence().tracks(stars.mass, stars.metallicity, stars.log_age, "i")
    apparent = magnitudes(tracks, stars.mass[:, None])[:, 0] + 5 * np.log10(stars.distance / 10.0)
    apparent += Robin2003().extinction(lon, lat, stars.distance, "i")
    np.testing.assert_allclose(stars.magnitude, apparent, atol=2e-3)  # extinction between its nodes


def test_drawn_stars_are_continuous_and_within_the_model(drawn):
    _, _, area, stars, _ = drawn
    assert np.unique(stars.mass).size == np.unique(stars.distance).size == len(stars)
    assert stars.magnitude.min() >= 16.0
    assert stars.magnitude.max() < 23.0
    assert 0.08 <= stars.mass.min() < stars.mass.max() <= 1.5
    assert stars.distance.max() <= 50_000.0
    assert np.all(stars.mass <= main_sequence_end(stars.metallicity, stars.log_age))
    assert stars.area == area
    assert "Robin2003" in stars.source
    for component in COMPONENTS:
        age = 10 ** (stars.log_age[stars.component == component.name] - 9.0)
        assert np.all((age <= component.age[1] + 1e-9) & (age >= component.age[0] - 1e-9))


def test_a_narrow_range_draws_the_stars_of_a_wide_one():
    """The bounds that choose the cells lose no star at the edges of the range."""
    area = 60.0
    rng = generator()
    wide = Robin2003().draw(90.0, 50.0, area, "i", (17.0, 21.0), rng).select(magnitude=(18.9, 19.1))
    narrow = Robin2003().draw(90.0, 50.0, area, "i", (18.9, 19.1), rng)
    both = len(wide) + len(narrow)
    assert_within_sigma(len(wide) - len(narrow), 0.0, np.sqrt(both), n_sigma=5.0)
    stderr = wide.mass.std() * np.sqrt(1 / len(wide) + 1 / len(narrow))
    assert_within_sigma(narrow.mass.mean(), wide.mass.mean(), stderr, n_sigma=5.0)


def test_a_number_of_stars_is_kept_exactly_and_follows_the_same_law():
    stars = Robin2003().draw(200.0, 59.0, 1.0, "i", (18.0, 20.0), generator(), n=30_000)
    counts = Robin2003().star_counts(200.0, 59.0, np.array([18.0, 19.0, 20.0])).per_deg2
    share = counts[0] / counts.sum()
    assert len(stars) == 30_000
    stderr = np.sqrt(share * (1 - share) / 30_000)
    assert_within_sigma(np.mean(stars.magnitude < 19.0), share, stderr, n_sigma=5.0)


def test_drawn_stars_are_in_random_order():
    stars = Robin2003().draw(200.0, 59.0, 1.0, "i", (18.0, 20.0), generator(), n=20_000)
    order = np.corrcoef(np.arange(len(stars)), stars.magnitude)[0, 1]
    assert_within_sigma(order, 0.0, 1.0 / np.sqrt(len(stars)), n_sigma=5.0)


def test_no_stars_where_none_are_asked_for():
    stars = Robin2003().draw(200.0, 59.0, 1.0, "i", (18.0, 20.0), generator(), n=0)
    assert len(stars) == 0
    assert len(Robin2003().draw(0.0, 90.0, 1e-9, "i", (18.0, 18.1), generator())) == 0


def test_the_same_generator_gives_the_same_stars():
    a, b = (Robin2003().draw(10.0, 40.0, 1.0, "r", (19.0, 20.0), generator(7)) for _ in range(2))
    np.testing.assert_array_equal(a.distance, b.distance)
    np.testing.assert_array_equal(a.component, b.component)


def test_old_components_are_enhanced_in_alpha_elements():
    for component, enhancement in zip(COMPONENTS, [0.0] * 7 + [0.214] * 2, strict=True):
        np.testing.assert_allclose(component.metallicity - component.iron, enhancement, atol=1e-3)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"l": 360.0}, r"l must be in \[0, 360\) deg, got 360.0"),
        ({"l": float("nan")}, r"l must be in \[0, 360\) deg, got nan"),
        ({"b": -90.5}, r"b must be in \[-90, 90\] deg, got -90.5"),
        ({"area": 0.0}, "area must be positive and finite, got 0.0"),
        ({"area": float("inf")}, "area must be positive and finite, got inf"),
        ({"band": "K"}, "band must be one of g, r, i, .*, got K"),
        ({"magnitude_range": (20.0, 18.0)}, r"magnitudes must be .* increasing .*, got \[20.0, 18.0\]"),
        ({"magnitude_range": (20.0, float("inf"))}, "magnitudes must be .* finite"),
        ({"n": -1}, "n must be 0 or more, got -1"),
        ({"n": 5, "magnitude_range": (80.0, 81.0)}, "magnitude_range must hold stars of the model"),
    ],
    ids=lambda value: next(iter(value)) if isinstance(value, dict) else "",
)
def test_bad_input_is_named(change, message):
    good = {
        "l": 10.0,
        "b": 40.0,
        "area": 1.0,
        "band": "i",
        "magnitude_range": (18.0, 19.0),
        "rng": generator(),
    }
    with pytest.raises(ValueError, match=message):
        Robin2003().draw(**(good | change))


@pytest.mark.parametrize(
    ("make", "message"),
    [
        (lambda: Robin2003(extinction_per_kpc=-1.0), "extinction_per_kpc must be 0 or more, got -1.0"),
        (lambda: Robin2003(distance_max=0.0), "distance_max must be positive and finite, got 0.0"),
        (lambda: Robin2003().density("bulge", SUN), "component must be one of thin1, .*, got bulge"),
        (lambda: Robin2003().counts(0.0, 90.0, np.array([18.0])), "magnitudes must be two or more"),
        (lambda: Robin2003().extinction(-1.0, 0.0, np.ones(1)), "l must be in"),
        (lambda: extinction_ratio("K"), "band must be one of V, .*, got K"),
    ],
)
def test_bad_models_and_places_are_named(make, message):
    with pytest.raises(ValueError, match=message):
        make()


@pytest.mark.parametrize("component", COMPONENTS, ids=lambda c: c.name)
def test_the_mass_function_has_the_stated_slopes_and_no_step(component):
    width = np.diff(10**LOG_MASS)
    mass = 10 ** (0.5 * (LOG_MASS[1:] + LOG_MASS[:-1]))
    log_density = np.log(component.number_density() / width)
    slope = -np.diff(log_density) / np.diff(np.log(mass))
    expected = component.slopes(mass)
    same = expected[1:] == expected[:-1]
    np.testing.assert_allclose(slope[same], expected[1:][same], atol=0.01)  # means over cells
    between = (np.minimum(expected[1:], expected[:-1]) - 0.01 <= slope) & (
        slope <= np.maximum(expected[1:], expected[:-1]) + 0.01
    )
    assert np.all(between)


@pytest.fixture(scope="module")
def sky():
    return population((16.0, 24.0))


def test_shares_of_mass_classes_add_up(sky):
    share = sky["share"].dropna("angle", how="all")
    parts = share.sel(mass_class=["0.5-0.7", "0.7-1.5"]).sum("mass_class", skipna=False)
    np.testing.assert_allclose(parts, share.sel(mass_class="0.5-1.5"), rtol=1e-12)
    whole = share.sel(mass_class=["below 0.1", "0.1-0.5", "0.5-1.5"]).sum("mass_class", skipna=False)
    np.testing.assert_allclose(whole.to_numpy()[np.isfinite(whole)], 1.0, rtol=1e-12)


def test_binary_fractions_follow_from_the_shares(sky):
    """The model's rows: 0.22, 0.26, 0.44, with the gap from 0.5 to 0.7 M_sun on either side."""
    share = {str(name): sky["share"].sel(mass_class=name) for name in sky["mass_class"].to_numpy()}
    low = 0.22 * share["below 0.1"] + 0.26 * share["0.1-0.5"]
    np.testing.assert_allclose(
        sky["binary_fraction"].sel(gap_rule="solar"), low + 0.44 * share["0.5-1.5"], rtol=1e-9
    )


def test_scans_of_the_sky_meet_where_they_cross(sky):
    crossing = sky["share"].sel(scan="l = 180", angle=45.0)
    np.testing.assert_allclose(sky["share"].sel(scan="b = 45", angle=180.0), crossing, rtol=1e-12)


def test_stars_above_the_photometry_are_next_to_none_at_these_magnitudes(sky):
    limit = sky["bright_limit"].to_numpy()
    assert np.all(limit[np.isfinite(limit)] >= 0)
    assert np.nanmax(limit) < 1e-3


def test_population_figure_has_named_axes_and_all_scans(sky):
    axes = figures.population(sky).axes
    assert len(axes) == 6
    assert axes[0].get_ylabel() == "share of the stars"
    assert axes[3].get_ylabel() == "mean binary fraction"
    assert [axis.get_xlabel().split(" [")[1] for axis in axes[3:]] == ["deg]"] * 3
    assert all(len(axis.lines) == 5 for axis in axes[:3])


def test_stars_of_the_model_agree_with_itself_as_a_catalogue():
    stars = Robin2003().draw(200.0, 59.0, 4.0, "i", (16.0, 23.0), generator())
    data = galaxy_against_catalog(stars, Robin2003(), (200.0, 59.0), EDGES, generator())
    assert_within_sigma(data["galaxy"].to_numpy(), data["catalog"].to_numpy(), data["stderr"].to_numpy())
    axes = figures.galaxy_against_catalog([data, data]).axes
    assert len(axes) == 8
    assert axes[0].get_ylabel() == "stars per deg² and mag"
    assert axes[-1].get_xlabel() == "$i$ [mag]"
