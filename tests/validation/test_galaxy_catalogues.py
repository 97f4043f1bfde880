"""The analytic Galaxy against catalogues of the Besançon model of 2003, its own figures, and observed counts."""

import numpy as np
import pytest
from scipy.special import ndtri

from data_files import data_file
from porrima.catalogs import read_catalog
from porrima.galaxy import Robin2003
from porrima.photometry import MainSequence, magnitudes
from porrima.populations import COMPONENTS, LOG_MASS, METALLICITY, magnitude_table

POLE = "catalogues/besancon_l200_b90.dat"  # i of MegaCam (AB), as the file gives it
JOHNSON = "catalogues/besancon_l200_b59.csv"  # i (AB) of SDSS from V and V-I
LOW_DUST = 0.06  # mag/kpc: the second catalogue was made with A_V = 0.006 mag

# b = 90°, main sequence, 16-17 … 22-23 mag: count, median distance in pc, mean mass, mean MF
POLE_BINS = [
    (167, 726, 0.620, 0.397),
    (282, 1026, 0.569, 0.373),
    (336, 976, 0.487, 0.341),
    (438, 1350, 0.444, 0.327),
    (585, 2025, 0.420, 0.327),
    (770, 4725, 0.445, 0.339),
    (954, 10125, 0.454, 0.345),
]
ALLEN = {  # latitude: log10 of all stars per deg² brighter than V = 16, 18, 20, 22, 24
    30.0: (2.875, 3.349, 3.748, 4.046, 4.286),
    60.0: (2.458, 2.869, 3.226, 3.538, 3.772),
    90.0: (2.347, 2.744, 3.092, 3.382, 3.604),
}


def multiplicity_fraction(mass):
    """Duchêne & Kraus (2013), gaps closed as in the authors' code."""
    return np.select([mass < 0.0999, mass < 0.4999], [0.22, 0.26], 0.44)


def sampling_error_of_median(values, rng):
    n = values.size
    return np.std([np.median(values[rng.integers(0, n, n)]) for _ in range(200)])


def catalogue(name, edges):
    """Stars of each bin of a real catalogue."""
    stars = read_catalog(data_file(name)).stars
    return [stars.select(magnitude=(low, low + 1.0), mass_max=1.5) for low in edges[:-1]]


@pytest.mark.parametrize(
    ("name", "lat", "model", "faintest"),
    [(POLE, 90.0, Robin2003(), 23.0), (JOHNSON, 59.0, Robin2003(extinction_per_kpc=LOW_DUST), 21.0)],
    ids=["b90", "b59"],
)
def test_counts_distances_and_masses_are_those_of_the_catalogue(name, lat, model, faintest):
    """Within 15 %, 10 %, 10 % and 0.01, or three standard errors of the catalogue where they are larger."""
    rng = np.random.Generator(np.random.Philox(20261122))
    edges = np.arange(16.0, faintest + 1.0)
    counts = model.star_counts(200.0, lat, edges)
    fractions = counts.mean(multiplicity_fraction(counts.mass))
    for k, stars in enumerate(catalogue(name, edges)):
        n, median = len(stars), np.median(stars.distance)
        assert abs(counts.per_deg2[k] - n) < max(0.15 * n, 3 * np.sqrt(n))
        error = sampling_error_of_median(stars.distance, rng)
        assert abs(counts.median_distance[k] - median) < max(0.10 * median, 3 * error)
        mean, error = stars.mass.mean(), stars.mass.std() / np.sqrt(n)
        assert abs(counts.mean_mass[k] - mean) < max(0.10 * mean, 3 * error)
        fraction = multiplicity_fraction(stars.mass)
        assert abs(fractions[k] - fraction.mean()) < max(0.01, 3 * fraction.std() / np.sqrt(n))


def test_counts_at_the_pole_are_those_of_the_figures_on_record():
    edges = np.arange(16.0, 24.0)
    counts = Robin2003().star_counts(200.0, 90.0, edges)
    n, _, mass, fraction = np.array(POLE_BINS).T
    assert np.all(np.abs(counts.per_deg2 - n) < np.maximum(0.15 * n, 3 * np.sqrt(n)))
    assert np.all(np.abs(counts.mean_mass / mass - 1) < 0.10)
    assert np.all(np.abs(counts.mean(multiplicity_fraction(counts.mass)) - fraction) < 0.015)


@pytest.mark.parametrize(
    ("name", "lat", "model"),
    [(POLE, 90.0, Robin2003()), (JOHNSON, 59.0, Robin2003(extinction_per_kpc=LOW_DUST))],
    ids=["b90", "b59"],
)
def test_faint_counts_agree_above_a_fifth_of_the_sun(name, lat, model):
    """Between 21 and 23 mag what differs is stars below 0.2 M_sun, whose i the two catalogues give by 0.5 mag apart."""
    edges = np.arange(21.0, 24.0)
    counts = model.star_counts(200.0, lat, edges)
    expected = counts.by_mass[:, counts.mass >= 0.2].sum(axis=1)
    for k, stars in enumerate(catalogue(name, edges)):
        n = np.sum(stars.mass >= 0.2)
        assert abs(expected[k] - n) < max(0.15 * n, 3 * np.sqrt(n))
        assert abs(counts.per_deg2[k] / len(stars) - 1) < 0.25


def number_brighter_than_eight(component):
    """Main-sequence stars of a component with M_V < 8, per pc³, at the Sun."""
    g, r = (magnitude_table(component, band) for band in ("g", "r"))
    v = g.centre - 0.5784 * (g.centre - r.centre) - 0.0038  # Lupton (2005)
    total = 0.0
    for deviate in ndtri((np.arange(40) + 0.5) / 40):
        k = np.argmin(np.abs(METALLICITY - component.metallicity - component.scatter * deviate))
        alive = np.clip((g.turn_off[:, k, None] - LOG_MASS[:-1]) / np.diff(LOG_MASS), 0.0, 1.0)
        total += np.mean(np.sum(component.number_density() * alive * (v[:, k] < 8.0), axis=1)) / 40
    return total


@pytest.mark.parametrize(
    ("components", "published"),
    [(COMPONENTS[:7], 0.0154), (COMPONENTS[7:8], 0.00103), (COMPONENTS[8:], 7.94e-6)],
    ids=["thin", "thick", "halo"],
)
def test_number_densities_are_those_of_the_besancon_model(components, published):
    """Its header counts all stars with M_V < 8; 4 to 9 % of them have left the main sequence."""
    ratio = sum(number_brighter_than_eight(c) for c in components) / published
    assert 0.90 < ratio < 1.0


@pytest.mark.parametrize("lat", ALLEN)
def test_counts_follow_allens_table_of_observed_counts(lat):
    """Main sequence against all stars, averaged over longitude: within 0.1 dex, mostly below."""
    rng = np.random.Generator(np.random.Philox(20261122))
    longitudes = np.arange(15.0, 360.0, 30.0) if lat < 90 else np.zeros(1)
    area, limits = 6.0 / longitudes.size, np.arange(16.0, 25.0, 2.0)
    brighter = np.zeros(5)
    for lon in longitudes:
        stars = Robin2003().draw(lon, lat, area, "r", (5.0, 24.5), rng)
        g, r = (
            magnitudes(
                MainSequence().tracks(stars.mass, stars.metallicity, stars.log_age, band), stars.mass[:, None]
            )[:, 0]
            for band in ("g", "r")
        )
        v = g - 0.5784 * (g - r) - 0.0038 + 5 * np.log10(stars.distance / 10)
        v += Robin2003().extinction(lon, lat, stars.distance)
        brighter += np.sum(v[:, None] < limits, axis=0) / (area * longitudes.size)
    np.testing.assert_allclose(np.log10(brighter), ALLEN[lat], atol=0.1)
